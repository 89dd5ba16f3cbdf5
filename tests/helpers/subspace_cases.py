"""Synthetic subspaces, and the distance of a point from a span."""

import numpy as np
from scipy.linalg import lstsq

from bench.codebook.examples import draw_features
from bench.types import Points, Subspaces

D = 128


def draw_subspaces(rng: np.random.Generator, count: int, dim: int) -> Subspaces:
    """Draw subspaces that contain a descriptor, similar to those of lifting."""
    points = draw_features(count, seed=int(rng.integers(1000))).descriptors.astype(np.float64)
    bases = np.linalg.qr(rng.normal(size=(count, D, dim)))[0].transpose(0, 2, 1)
    origins = points + (rng.normal(size=(count, 1, dim)) @ bases)[:, 0]
    keypoints = np.zeros((count, 2), dtype=np.float32)
    return Subspaces(
        positions=Points(keypoints=keypoints), size=(1, 1), origins=origins.astype(np.float32), bases=bases.astype(np.float32)
    )


def residual(columns: np.ndarray, target: np.ndarray) -> float:
    """Return the distance of the target from the span of the columns."""
    solution = lstsq(columns.astype(np.float64), target.astype(np.float64))[0]
    return float(np.linalg.norm(columns @ solution - target))
