"""Real descriptors, databases and lifted releases for the attacks on subspaces."""

from pathlib import Path
from typing import Any

import numpy as np

from bench.api import View
from bench.codebook import dictionary
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs
from bench.settings import Asset
from bench.types import Features, Points, Subspaces
from defenses.affine import Affine


def extract_sift(count: int, photograph: int = 0) -> Features:
    """Return the first keypoints of a built-in photograph."""
    features = Sift().extract(photographs.read(photographs.list_builtin()[photograph].path).pixels)
    return features.take(np.arange(count))


def build_features(codes: np.ndarray) -> Features:
    keypoints = np.zeros((len(codes), 2), np.float32)
    return Features(keypoints=keypoints, descriptors=unit_rows(codes), codes=codes, size=(64, 48))


def draw_centres(count: int, seed: int = 0) -> np.ndarray:
    """Draw words similar to the centres of large clusters, with few zeros and one greatest component."""
    rng = np.random.default_rng(seed)
    means = rng.gamma(2.0, 1.0, (count, 128)) + 0.1
    return np.rint(means / np.linalg.norm(means, axis=1, keepdims=True) * 512).clip(1, 255).astype(np.uint8)


def save_database(folder: Path, words: np.ndarray) -> Asset:
    path = folder / f"words-{len(list(folder.iterdir()))}.safetensors"
    dictionary.save(path, words, {"photographs": []})
    return Asset(path)


def lift_features(secret: Features, folder: Path, words: np.ndarray, seed: int = 0, **settings: Any) -> Subspaces:
    """Release the secret by affine lifting through these words."""
    defense = Affine(database=save_database(folder, words), **settings)
    return defense.protect(secret, Public(), np.random.default_rng(seed))


def create_view(release: Subspaces) -> View:
    return View(release=release, defense=Affine(dim=2), extractor=Sift())


def change_bases(release: Subspaces, rng: np.random.Generator) -> Subspaces:
    """Describe the subspaces by another point and another basis."""
    rotation = np.linalg.qr(rng.normal(size=(len(release), release.dim, release.dim))).Q
    away = rng.normal(size=(len(release), 1, release.dim)) @ release.bases
    origins = (release.origins + away[:, 0]).astype(np.float32)
    bases = (rotation @ release.bases).astype(np.float32)
    return Subspaces(positions=Points(keypoints=release.keypoints), size=release.size, origins=origins, bases=bases)


def measure_errors(estimates: np.ndarray, secret: Features) -> np.ndarray:
    """Return |estimate − descriptor| in float64. (N, D) -> (N,)"""
    return np.linalg.norm(estimates.astype(float) - secret.descriptors, axis=1)
