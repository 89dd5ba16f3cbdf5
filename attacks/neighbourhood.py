"""Neighbourhood: estimates each keypoint's position on its line from the lines of its likeliest neighbours.

Source: Chelani, Benbihi, Sattler, Kahl and Kukelova, 3DV 2025 (arXiv 2409.11536). Its code is not published. The estimator and
the model of neighbours are ours.

Method:

1. Predict each keypoint's neighbours from the descriptors, by a small model trained on public photographs
   (`bench/positions/neighbour_model.py`). For word sets, the ratios of all pairs of candidates are averaged with the chance that
   both are the true words.
2. The estimate is the point of the line with the least weighted sum of truncated distances to the lines of its neighbours
   (`bench/positions/neighbourhood.py`).

Knowledge: the model of neighbours.

Limits: keypoints whose neighbours are not predicted are lost. `neighbourhood-oracle` is the upper bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.api import Defense, Extractor, PositionAttack, View
from bench.codebook.public import Public
from bench.geometry.lines import read_lines
from bench.positions import neighbour_model
from bench.positions.neighbourhood import recover_positions
from bench.positions.prediction import predict_neighbours
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Floats, WordSets


@dataclass(frozen=True, kw_only=True)
class Neighbourhood(PositionAttack):
    """Estimates each keypoint's position on its line from the lines of its likeliest neighbours."""

    accepts = (Descriptors, WordSets)
    needs = frozenset({PublicAssets})

    neighbours: int = 30  # the likeliest ones of a keypoint; tuned on tune.txt
    reach: float = 15.0  # pixels; a line farther away than this costs no more than one at this distance; tuned on tune.txt

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return neighbour_model.load().explain_other_features(extractor, public)

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"neighbour_model": neighbour_model.load().digest}

    def locate(self, view: View, rng: np.random.Generator) -> Floats:
        release = view.release
        near, weights = predict_neighbours(release, view.defense, view.know(PublicAssets).assets, self.neighbours)
        return recover_positions(read_lines(release), near, weights, release.size, self.reach)


PLUGIN = Neighbourhood
