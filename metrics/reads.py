"""Text of the photograph that an OCR engine reads in its reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from bench.api import Metric
from bench.core.errors import UserError
from bench.formats.pretrained import INSTALLED
from bench.geometry.metric_inputs import validate_images
from bench.identification import words
from bench.types import Floats

INSTALL = "apt install tesseract-ocr"


@dataclass(frozen=True, kw_only=True)
class Reads(Metric):
    """Fraction of the photograph's words that Tesseract reads again at the same position; none if it reads no word there.

    Words have at least `characters` letters or digits, and are read in the photograph with at least `confidence`. A word is read
    again if a word of the estimate, of any confidence, overlaps it by an intersection over union of at least `overlap`, and the
    texts have a similarity of at least `similarity`.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "fraction"
    range: ClassVar[tuple[float, float]] = (0.0, 1.0)
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "attacker"
    parameters: ClassVar[Mapping[str, Any]] = words.READER
    programs: ClassVar[tuple[str, ...]] = (words.PROGRAM,)

    model: Path = INSTALLED  # Tesseract's English one, or a file LANGUAGE.traineddata; records hold the digest of the content

    def __post_init__(self) -> None:
        installed = words.find_model()
        if installed is None:
            raise UserError(f"reads: Tesseract 5 with {words.MODEL} is not on the PATH; install it, such as by {INSTALL}")
        path = installed if self.model == INSTALLED else self.model
        if not path.is_file():
            raise UserError(f"reads: {path}: no such file")
        object.__setattr__(self, "model", path)

    @classmethod
    def is_installed(cls) -> bool:
        return words.find_model() is not None

    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        # (H, W, 3) in [0, 1] each
        true, estimated = validate_images(truth, estimate)
        legible = words.select_legible(words.read_words(true, self.model))
        if not legible:
            return None
        others = words.read_words(estimated, self.model)
        return sum(words.is_among(word, others) for word in legible) / len(legible)

    def describe_truth(self, truth: Floats) -> str | None:
        count = len(words.select_legible(words.read_words(truth.astype(np.float64), self.model)))
        return f"words in the photograph: {count}"


PLUGIN = Reads
