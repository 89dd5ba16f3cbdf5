"""Words that an OCR engine reads in an image: the program Tesseract, version 5, with its LSTM model (Smith, ICDAR 2007).

The program looks for sparse text, since photographs are no pages. It is given the image at twice its size: its models are trained
on larger letters than those of a photograph of 256 pixels.
"""

from __future__ import annotations

import csv
import difflib
import functools
import io
import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from PIL import Image

from bench.core.errors import SampleError
from bench.geometry.metric_inputs import Doubles
from bench.identification.faces import compute_overlap

PROGRAM = "tesseract"
MODEL = "eng.traineddata"
FOLDER = re.compile(r'"(.+)" \(\d+\)')  # of the models, in the answer to --list-langs; version 4 does not name it
LEVEL = "5"  # of words, in the program's table
READER: Mapping[str, Any] = MappingProxyType(
    {"mode": 11, "upsampled": 2, "confidence": 60, "characters": 3, "overlap": 0.25, "similarity": 0.8}
)


@dataclass(frozen=True, kw_only=True)
class Word:
    """A word of an image."""

    text: str  # letters and digits in lower case, not empty
    box: tuple[float, float, float, float]  # top, left, height, width in pixels
    confidence: float  # of the engine, 0 to 100


def find_model() -> Path | None:
    """Return the file of Tesseract's English model; None if the program, in version 5, or the model is not installed."""
    program = shutil.which(PROGRAM)
    return None if program is None else _find_model(program)


@functools.cache
def _find_model(program: str) -> Path | None:
    folder = FOLDER.search(subprocess.run([program, "--list-langs"], capture_output=True, text=True, check=False).stdout)
    path = folder and Path(folder[1]) / MODEL
    return path if path and path.is_file() else None


def read_words(image: Doubles, model: Path) -> tuple[Word, ...]:
    """Return the words of an image, (H, W, 3) in [0, 1].

    Raises
    ------
    SampleError
        if the program fails.
    """
    return _read_words(image.tobytes(), image.shape, model)


def select_legible(words: Sequence[Word]) -> list[Word]:
    """Return the words of at least 3 letters or digits that were read with a confidence of at least 60."""
    return [word for word in words if len(word.text) >= READER["characters"] and word.confidence >= READER["confidence"]]


def is_among(word: Word, others: Sequence[Word]) -> bool:
    """Return whether another word of similar text overlaps a word.

    The intersection over union of the boxes is at least 0.25. The similarity of the texts, of Ratcliff and Obershelp, is at least
    0.8: one wrong character of five.

    >>> word = Word(text="street", box=(0, 0, 10, 60), confidence=90)
    >>> is_among(word, [Word(text="streel", box=(2, 3, 10, 60), confidence=20)])
    True
    >>> is_among(word, [Word(text="street", box=(20, 0, 10, 60), confidence=90)])
    False
    """
    beside = (other.text for other in others if compute_overlap(np.array(word.box), np.array(other.box)) >= READER["overlap"])
    return any(difflib.SequenceMatcher(None, word.text, text).ratio() >= READER["similarity"] for text in beside)


# The cache lets all attacks on a photograph share its words.
@functools.lru_cache(maxsize=2)
def _read_words(pixels: bytes, shape: tuple[int, int, int], model: Path) -> tuple[Word, ...]:
    """Return the words of a float64 image."""
    scale, file = READER["upsampled"], io.BytesIO()
    picture = Image.fromarray(np.rint(np.frombuffer(pixels).reshape(shape) * 255).astype(np.uint8))
    picture.resize((scale * shape[1], scale * shape[0]), Image.Resampling.BICUBIC).save(file, "PNG", compress_level=1)
    options = ["--tessdata-dir", str(model.parent), "-l", model.stem, "--psm", str(READER["mode"]), "-c", "tessedit_create_tsv=1"]
    done = subprocess.run(
        [PROGRAM, "stdin", "stdout", *options],
        input=file.getvalue(),
        capture_output=True,
        check=False,
        env={**os.environ, "OMP_THREAD_LIMIT": "1"},
    )
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").split("\n")
        raise SampleError(f"{PROGRAM} failed: {' '.join(lines).strip() or done.returncode}")
    return tuple(_parse_table(done.stdout.decode(errors="replace"), scale))


def _parse_table(table: str, scale: int) -> Iterator[Word]:
    """Yield the words of the program's table, whose pixels are those of the image at `scale` times its size."""
    for row in csv.DictReader(table.splitlines(), delimiter="\t", quoting=csv.QUOTE_NONE):
        text = "".join(filter(str.isalnum, row["text"] or "")).lower()
        if row["level"] == LEVEL and text:
            top, left, height, width = (int(row[name]) / scale for name in ("top", "left", "height", "width"))
            yield Word(text=text, box=(top, left, height, width), confidence=float(row["conf"]))
