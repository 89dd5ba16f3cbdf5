"""HardNet descriptors (Mishchuk et al., NeurIPS 2017) of upright SIFT keypoints, through kornia (`pip install kornia`).

Nothing is downloaded. The weights are kornia's `checkpoint_liberty_with_aug.pth`: a given file, or torch.hub's copy in the folder
`torch.hub.get_dir()`/checkpoints. The first call of `kornia.feature.HardNet(pretrained=True)` stores that copy.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.api import Extractor
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.formats.pretrained import to_tensor
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import Source
from bench.types import Features, Floats

HUB = Path("hub")
WEIGHTS = "checkpoint_liberty_with_aug.pth"
RADIUS = 3.0  # of a patch, in diameters of a keypoint: six standard deviations, as in SIFT's own window and in kornia
BATCH = 256  # patches


@dataclass(frozen=True, kw_only=True)
class HardNet(Extractor):
    """HardNet at upright SIFT's keypoints."""

    weights: Path  # kornia's file, or `hub` for torch.hub's copy; records hold the digest of the content
    max_keypoints: int = 1000  # the keypoints with the strongest response

    def __post_init__(self) -> None:
        if self.weights == HUB:
            object.__setattr__(self, "weights", _find_weights())
        if not self.weights.is_file():
            raise UserError(f"hardnet: {self.weights}: no such file")
        if self.max_keypoints < 1:
            raise UserError(f"hardnet: max_keypoints must be at least 1, got {self.max_keypoints}")

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        sift_features = Sift(max_keypoints=self.max_keypoints).extract(image, source)
        assert sift_features.frames is not None
        rows = _describe(image, sift_features.keypoints, sift_features.frames[:, 0], self.weights)
        keep = np.asarray(rows.any(axis=1))
        return dataclasses.replace(sift_features, descriptors=unit_rows(rows), codes=None).take(keep)


def _find_weights() -> Path:
    import torch

    folder = Path(torch.hub.get_dir()) / "checkpoints"
    candidates = sorted(folder.glob(f"*{WEIGHTS}"))  # kornia prepends the name of its repository
    if not candidates:
        raise UserError(
            f"hardnet: no {WEIGHTS} in {folder}; call kornia.feature.HardNet(pretrained=True) once, or give weights=FILE"
        )
    return candidates[0]


def _describe(image: np.ndarray, keypoints: Floats, diameters: Floats, path: Path) -> Floats:
    """Compute descriptors. (H, W, 3), (N, 2), (N,) -> (N, 128)"""
    import torch

    kornia, network = _load_network(path, path.stat().st_mtime_ns)
    grey = kornia.color.rgb_to_grayscale(to_tensor(image))  # (1, 1, H, W)
    centres = torch.from_numpy(keypoints - np.float32(0.5))[None]  # kornia's centre of the first pixel is (0, 0)
    scales = torch.from_numpy(diameters * np.float32(RADIUS))[None, :, None, None]
    frames = kornia.feature.laf_from_center_scale_ori(centres, scales)  # (1, N, 2, 3)
    with torch.inference_mode():
        patches = kornia.feature.extract_patches_from_pyramid(grey, frames, network.patch_size)[0]  # (N, 1, 32, 32)
        return np.asarray(torch.cat([network(batch) for batch in patches.split(BATCH)]).numpy())


@lru_cache(maxsize=2)
def _load_network(path: Path, changed: int) -> tuple[Any, Any]:
    """Return kornia, and its network with the weights of the file; `changed`, the file's time, is part of the cache key."""
    import torch

    try:
        import kornia
    except ImportError:
        raise UserError("hardnet needs kornia: pip install 'feature-privacy-bench[hardnet]'") from None
    network = kornia.feature.HardNet(pretrained=False)
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True)["state_dict"])
    except Exception as error:  # torch raises various errors for files of other formats
        raise UserError(f"hardnet: {path}: not kornia's {WEIGHTS} ({type(error).__name__})") from None
    return kornia, network.eval()


PLUGIN = HardNet
