"""Identification of the photograph among 256, from a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

from bench.api import Metric
from bench.geometry.metric_inputs import validate_images
from bench.identification import distractors, thumbnails
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class Identified(Metric):
    """Reciprocal rank of the photograph among itself and 255 others, by the similarity of thumbnails to the estimate.

    A thumbnail is the luminance, blurred and averaged to 16 x 16. The similarity is the normalised correlation. The value is 1 if
    the estimate identifies the photograph. Equal similarities have their mean rank, so a constant estimate scores 1 / 128.5. The
    255 others are photographs of the training set, always the same. If the photograph is one of them, a spare replaces it.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "reciprocal rank"
    range: ClassVar[tuple[float, float]] = (1 / (distractors.COUNT + 1), 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {
            "distractors": distractors.DIGEST,
            "duplicate": distractors.DUPLICATE,
            "sigma": thumbnails.SIGMA,
            "side": thumbnails.SIDE,
        }
    )

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        return 1 / distractors.rank_photograph(true, estimated, distractors.load_distractors())


PLUGIN = Identified
