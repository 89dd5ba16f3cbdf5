"""Synthetic features and dictionaries, for tests and audits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.codebook import dictionary
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import SIDE
from bench.settings import Asset
from bench.types import Features


def draw_features(count: int = 50, seed: int = 0, length: int = 128) -> Features:
    """Draw synthetic features in the format of upright SIFT."""
    rng = np.random.default_rng(seed)
    codes = np.minimum(rng.gamma(0.6, 40.0, (count, length)), 255).astype(np.uint8)
    codes[:, 0] |= 1  # no row is zero
    keypoints = rng.uniform(0, SIDE, (count, 2)).astype(np.float32)
    return Features(keypoints=keypoints, descriptors=unit_rows(codes), codes=codes, size=(SIDE, SIDE))


def write_dictionary(folder: Path, words: int = 512, seed: int = 1) -> Asset:
    """Write a dictionary of synthetic words and return it as the value of an asset field."""
    codes = draw_features(words, seed).codes
    assert codes is not None
    path = folder / f"dictionary-{words}-{seed}.safetensors"
    dictionary.save(path, codes, {"photographs": [], "extractor": {"name": "made-up"}})
    return Asset(path)
