"""Identification of the scene of a photograph among 256, by another view of it, from a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.identification import distractors, thumbnails
from bench.types import Floats

SHIFT = 4  # rows and columns of a thumbnail: a quarter of its side


@dataclass(frozen=True, kw_only=True)
class IdentifiedScene(Metric):
    """Reciprocal rank of another view of the photograph's scene among itself and 255 views of others, by similarity.

    The similarity is the greatest normalised correlation of 16 x 16 blurred luminance over shifts of up to 4 rows and columns. A
    constant estimate has equal similarity to all, which scores 1 / 128.5.
    """

    compares: ClassVar[Literal["images", "descriptors", "views"]] = "views"
    unit: ClassVar[str] = "reciprocal rank"
    range: ClassVar[tuple[float, float]] = (1 / (distractors.COUNT + 1), 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"distractors": distractors.DIGEST, "shift": SHIFT, "sigma": thumbnails.SIGMA, "side": thumbnails.SIDE}
    )

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        # truth: (256, 16, 16) thumbnails, the other view of the scene first; estimate: (H, W, 3) in [0, 1]
        similarities = thumbnails.compare_shifted(thumbnails.compute_thumbnail(estimate), truth.astype(np.float64), SHIFT)
        return 1 / thumbnails.rank_first(similarities)


PLUGIN = IdentifiedScene
