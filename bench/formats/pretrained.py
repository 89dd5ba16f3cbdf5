"""Pretrained networks of other projects: their weights are a given file, or a file of an installed package.

The package is a container of its weights. It is not imported, and nothing is downloaded.
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.core.errors import SampleError, UserError
from bench.geometry.nearest_words import unit_rows
from bench.types import Features

if TYPE_CHECKING:
    from torch import Tensor

INSTALLED = Path("installed")  # value of a field `weights`


def find_weights(plugin: str, weights: Path, package: str, file: str, install: str) -> Path:
    """Return the path of a plugin's weights: `weights` itself, or for `INSTALLED` the file of a package.

    Raises
    ------
    UserError
        if there is no such file. The message names the command that installs the package.
    """
    if weights != INSTALLED:
        if not weights.is_file():
            raise UserError(f"{plugin}: {weights}: no such file")
        return weights
    try:
        path = Path(str(metadata.distribution(package).locate_file(file)))
    except metadata.PackageNotFoundError:
        raise UserError(f"{plugin} needs the weights of {package}: {install}; or give weights=FILE") from None
    if not path.is_file():
        raise UserError(f"{plugin}: {package} {metadata.version(package)} has no {file}; give weights=FILE")
    return path


def import_kornia(plugin: str) -> Any:
    """Return `kornia.feature`, in a version that has the networks of the extra `learned`."""
    try:
        import kornia.feature as feature

        _ = feature.XFeat, feature.ALIKED, feature.DISK
    except (ImportError, AttributeError):
        raise UserError(f"{plugin} needs kornia 0.9: pip install 'feature-privacy-bench[learned]'") from None
    return feature


def read_weights(plugin: str, path: Path) -> dict[str, Tensor]:
    """Read the tensors of a file that `torch.save` wrote. Code in the file is not executed."""
    import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        return {str(name): value for name, value in content.items()}
    except Exception as error:  # torch raises various errors for files of other formats
        raise UserError(f"{plugin}: {path}: not a file of PyTorch weights ({type(error).__name__})") from None


def to_tensor(image: np.ndarray) -> Tensor:
    """Return an image as the networks read it. (H, W, 3) uint8 -> (1, 3, H, W) float32 in [0, 1]"""
    import torch

    return torch.from_numpy(image.transpose(2, 0, 1).copy())[None].float() / 255


def build_features(image: np.ndarray, centres: Tensor, rows: Tensor) -> Features:
    """Return detected keypoints within the image, and their descriptors scaled to unit norm, as features.

    Parameters
    ----------
    centres : (N, 2) x, y in pixels; the centre of the top-left pixel is (0.5, 0.5)
    rows : (N, D)

    Raises
    ------
    SampleError
        if there is no keypoint.
    """
    height, width = image.shape[:2]
    xy = centres.numpy().astype(np.float32)
    descriptors = unit_rows(rows.numpy())
    keep = ((xy >= 0) & (xy < (width, height))).all(axis=1) & np.isfinite(descriptors).all(axis=1) & descriptors.any(axis=1)
    if not keep.any() or (image == image[0, 0]).all():  # on a flat image, what the networks find is their own padding
        raise SampleError("no keypoint was found: is the image flat?")
    return Features(keypoints=xy[keep], descriptors=descriptors[keep], codes=None, size=(width, height)).by_position()
