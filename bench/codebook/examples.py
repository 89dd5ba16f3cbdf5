"""Synthetic features and dictionaries, for tests and audits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.codebook import dictionary
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import SIDE
from bench.settings import Asset
from bench.types import Features


def draw_features(count: int = 50, seed: int = 0, length: int = 128, signed: bool = False) -> Features:
    """Draw synthetic features in the format of upright SIFT, or `signed` ones, in that of a learned extractor."""
    rng = np.random.default_rng(seed)
    if signed:
        keypoints = rng.uniform(0, SIDE, (count, 2)).astype(np.float32)
        rows = unit_rows(rng.normal(1.0, 1.0, (count, length)).astype(np.float32))
        return Features(keypoints=keypoints, descriptors=rows, codes=None, size=(SIDE, SIDE))
    codes = np.minimum(rng.gamma(0.6, 40.0, (count, length)), 255).astype(np.uint8)
    codes[:, 0] |= 1  # no row is zero
    keypoints = rng.uniform(0, SIDE, (count, 2)).astype(np.float32)
    return Features(keypoints=keypoints, descriptors=unit_rows(codes), codes=codes, size=(SIDE, SIDE))


def write_dictionary(folder: Path, words: int = 512, seed: int = 1, length: int = 128, signed: bool = False) -> Asset:
    """Write a dictionary of synthetic words and return it as the value of an asset field."""
    path = folder / f"dictionary-{words}-{seed}.safetensors"
    dictionary.save(
        path, dictionary.encode(draw_features(words, seed, length, signed)), {"photographs": [], "extractor": {"name": "made-up"}}
    )
    return Asset(path)
