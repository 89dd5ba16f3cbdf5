"""Detection rate of faces, by the cascade of local binary patterns in scikit-image's wheel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal

from bench.api import Metric
from bench.geometry.metric_inputs import validate_images
from bench.identification import faces
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class Face(Metric):
    """Fraction of the photograph's detected faces that are detected again at the same position; none if it has no face.

    A face is detected again if a detection in the estimate overlaps it by an intersection over union of at least `overlap`. So a
    hallucinated face at another position does not count. The metric detects faces and identifies nobody.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "fraction"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({**faces.DETECTOR, "overlap": faces.OVERLAP})

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        found = faces.detect_faces(true)
        if len(found) == 0:
            return None
        return float(faces.find_again(found, faces.detect_faces(estimated)).mean())


PLUGIN = Face
