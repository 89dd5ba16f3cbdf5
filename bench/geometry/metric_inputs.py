"""Validation of the two arguments of every metric."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.types import Floats

if TYPE_CHECKING:
    from torch import Tensor

Doubles = NDArray[np.float64]


def validate_images(truth: Floats, estimate: Floats) -> tuple[Doubles, Doubles]:
    """Return two (H, W, 3) images in [0, 1] as float64.

    Raises
    ------
    ValueError
        if shapes or values are invalid.
    """
    _check_same_shape(truth, estimate)
    if truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(f"images must be (H, W, 3), got {truth.shape}")
    for name, image in (("truth", truth), ("estimate", estimate)):
        if not (image.min() >= 0 and image.max() <= 1):  # NaN is refused too
            raise ValueError(f"{name}: values must be in [0, 1] and no NaN, got {image.min()} to {image.max()}")
    return truth.astype(np.float64), estimate.astype(np.float64)


def to_tensors(truth: Floats, estimate: Floats) -> tuple[Tensor, Tensor]:
    """Validate two images, and return them as networks read them. (H, W, 3) twice -> (1, 3, H, W) float32 twice"""
    import torch

    one, other = (torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] for image in validate_images(truth, estimate))
    return one, other


def validate_descriptors(truth: Floats, estimate: Floats) -> tuple[Doubles, Doubles]:
    """Return two (N, D) arrays of descriptors, N at least 1, as float64.

    Raises
    ------
    ValueError
        if the shapes are invalid, or a number is not finite.
    """
    _check_same_shape(truth, estimate)
    if truth.ndim != 2 or len(truth) == 0:
        raise ValueError(f"descriptors must be (N, D) with N at least 1, got {truth.shape}")
    for name, rows in (("truth", truth), ("estimate", estimate)):
        if not np.isfinite(rows).all():
            raise ValueError(f"{name}: descriptors must be finite")
    return truth.astype(np.float64), estimate.astype(np.float64)


def normalize_rows(rows: Doubles) -> Doubles:
    """Scale each row to unit norm; a row of zeros stays zero. (N, D) -> (N, D)"""
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(norms > 0, norms, 1.0)


def _check_same_shape(truth: Floats, estimate: Floats) -> None:
    if truth.shape != estimate.shape:
        raise ValueError(f"truth and estimate differ in shape: {truth.shape} and {estimate.shape}")
