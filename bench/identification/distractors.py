"""Distractors: thumbnails of other photographs, among which a reconstruction has to identify the right one.

They are photographs of the training set, drawn at random once (`tools/make_distractors.py`). The shipped file holds 256: the 255
distractors of a photograph, and a spare for a photograph that is a distractor itself.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from bench.codebook.public import ASSETS
from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.identification.thumbnails import Doubles, compare_thumbnails, compute_thumbnail, rank_first
from bench.types import Floats

FILE = ASSETS / "distractors.safetensors"
KIND = "distractors"
# The distractors are part of the definition of a score, so the content of their file is fixed.
DIGEST = "sha256:da3420e77a46c0ec23a2b93d1739ab0fbc112b3ef6caa74ea983345477e74699"
COUNT = 255  # distractors of each photograph
# Photographs of greater similarity count as the same one. The similarity of two distractors is below MOST_SIMILAR, the cosine of
# twice that angle. So no photograph is the same as two distractors.
DUPLICATE = 0.99
MOST_SIMILAR = 2 * DUPLICATE**2 - 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Distractors:
    """Thumbnails and mean colours of photographs."""

    names: tuple[str, ...]  # of the photographs, 256
    thumbnails: Doubles  # (256, 16, 16) luminance in [0, 1]
    colours: Floats  # (256, 3) RGB in [0, 1]

    def mean_colour(self) -> Floats:
        """Return the constant colour of least squared error over all photographs. -> (3,) in [0, 1]"""
        return np.asarray(self.colours.mean(axis=0, dtype=np.float64), np.float32)


@functools.cache
def load_distractors() -> Distractors:
    """Return the shipped distractors.

    Raises
    ------
    UserError
        if the file is missing or damaged, or has another content.
    """
    arrays, meta, digest = tensor_file.load(FILE, KIND)
    if digest != DIGEST:
        raise UserError(f"{FILE}: holds other distractors ({digest}) than this version uses ({DIGEST}); reinstall")
    return Distractors(names=tuple(meta["photographs"]), thumbnails=arrays["thumbnails"] / 255.0, colours=arrays["colours"])


def rank_photograph(truth: Floats | Doubles, estimate: Floats | Doubles, distractors: Distractors) -> float:
    """Return the rank of a photograph among itself and 255 distractors, by their similarity to an estimate of it.

    A distractor with a similarity of 0.99 or more to the photograph is the same photograph, and the spare replaces it.

    Parameters
    ----------
    truth, estimate : (H, W, 3) in [0, 1] each

    Returns
    -------
    rank from 1 to 256; equal similarities have their mean rank, so a constant estimate has rank 128.5
    """
    own = compute_thumbnail(truth)
    different = compare_thumbnails(own, distractors.thumbnails) < DUPLICATE
    candidates = np.concatenate([own[None], distractors.thumbnails[different][:COUNT]])  # (256, 16, 16), the true one first
    return rank_first(compare_thumbnails(candidates, compute_thumbnail(estimate)))
