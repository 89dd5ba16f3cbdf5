"""Denoise attack: estimates descriptors from noisy ones.

Source: not in the paper.

Method: the network for raw descriptors reads an estimate of each descriptor u:

- released: u itself. The network was not trained for noise.
- word: the word of Z with the greatest cosine.
- mean: the posterior mean over Z, scaled to unit norm. Each word w has the same prior probability, and u the density
  C(κ) e^(κ u·w) of a von Mises-Fisher distribution. κ is that of the greatest likelihood of the release, so neither kind nor size
  of the noise has to be known.

Knowledge: Z, a public database of the attacker's own.

Limits: a network that is trained for the noise (`bench train`) learns from neighbouring keypoints as well, and may be
stronger. Give it to `dia`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bench.api import Defense, DescriptorAttack, Extractor, View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.settings import Asset
from bench.threat_model import PublicDatabase
from bench.types import Descriptors, Floats

CONCENTRATIONS = 2.0 ** np.arange(1, 12.5, 0.5)  # κ
FITTED = 64  # descriptors that κ is fitted to
ROWS = 64  # descriptors at a time
ESTIMATES = ("released", "word", "mean")


@dataclass(frozen=True, kw_only=True)
class Denoise(DescriptorAttack):
    """Estimates each descriptor from the noisy one, with the words of a public database."""

    accepts = (Descriptors,)
    needs = frozenset({PublicDatabase})

    estimate: Literal["released", "word", "mean"] = "mean"
    database: Asset = Asset("shipped-public")

    def __post_init__(self) -> None:
        if self.estimate not in ESTIMATES:
            raise UserError(f"denoise: estimate must be {', '.join(ESTIMATES[:-1])} or {ESTIMATES[-1]}, got {self.estimate}")

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return None if defense.noisy else f"{defense.name()} adds no noise to descriptors"

    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        if not isinstance(release, Descriptors):
            raise TypeError(f"denoise attacks Descriptors, got {type(release).__name__}")
        u = unit_rows(release.descriptors)  # (N, D)
        if self.estimate == "released":
            return u
        words = unit_rows(view.know(PublicDatabase).words)  # (Z, D)
        if self.estimate == "word":
            return np.concatenate([words[(part @ words.T).argmax(axis=1)] for part in _split(u)])
        kappa = fit_concentration(u[np.linspace(0, len(u) - 1, min(FITTED, len(u))).astype(int)], words)
        view.notes.append(f"concentration {kappa:.3g}")
        return np.concatenate([average_words(part, words, kappa) for part in _split(u)])


def _split(u: Floats) -> list[Floats]:
    return [u[start : start + ROWS] for start in range(0, len(u), ROWS)]


def average_words(u: Floats, words: Floats, kappa: float) -> Floats:
    """Return the posterior mean of the words given each row of `u`, scaled to unit norm. (N, D), (Z, D) -> (N, D)"""
    logits = np.float32(kappa) * (u @ words.T)  # (N, Z)
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    return unit_rows(weights @ words)


def fit_concentration(u: Floats, words: Floats) -> float:
    """Return the κ of `CONCENTRATIONS` with the greatest likelihood of (N, D) rows, given (Z, D) words."""
    from scipy.special import logsumexp

    cosines = u @ words.T  # (N, Z)
    length = u.shape[1]
    scores = [
        len(u) * compute_log_normaliser(kappa, length) + float(logsumexp(np.float32(kappa) * cosines, axis=1).sum())
        for kappa in CONCENTRATIONS
    ]
    return float(CONCENTRATIONS[int(np.argmax(scores))])


def compute_log_normaliser(kappa: float, length: int) -> float:
    """Return ln C(κ) of the von Mises-Fisher distribution in `length` dimensions.

    C(κ) = κ^(D/2 − 1) / ((2π)^(D/2) I_{D/2 − 1}(κ))
    """
    from scipy.special import ive

    order = length / 2 - 1
    return order * math.log(kappa) - length / 2 * math.log(2 * math.pi) - math.log(float(ive(order, kappa))) - kappa


PLUGIN = Denoise
