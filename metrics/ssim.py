"""Structural similarity of an image (Wang et al., 2004); one of the three metrics of the paper's Tables 1 and 4."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

from bench.api import LocalMetric
from bench.geometry.metric_inputs import validate_images
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class SSIM(LocalMetric):
    """Structural similarity, with the window and the constants of its authors, averaged over the channels."""

    unit: ClassVar[str] = "similarity"
    range: ClassVar[tuple[float, float]] = (-1.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    # SSIM depends on these settings. Both sides of an image must have at least 11 pixels, which is the window's width.
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "channel_axis": 2}
    )

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        from skimage.metrics import structural_similarity

        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        return float(structural_similarity(true, estimated, **self.parameters))

    def local(self, truth: Floats, estimate: Floats) -> Floats:
        from skimage.metrics import structural_similarity

        true, estimated = validate_images(truth, estimate)
        return structural_similarity(true, estimated, full=True, **self.parameters)[1].mean(axis=2)


PLUGIN = SSIM
