"""Neighbourhood with the true neighbours: a reference. It is no attack: nobody has this knowledge.

Source: Chelani, Benbihi, Sattler, Kahl and Kukelova, 3DV 2025 (arXiv 2409.11536), who report medians of about 5 to 12 pixels.

Method: that of `neighbourhood`, with the nearest keypoints as neighbours, and without truncation.

Knowledge: the order of the other keypoints by their distance, which is part of the secret.

Limits: the error is a bound for attacks that estimate each position from lines of predicted neighbours alone. An attack that
combines the estimates of many keypoints can be better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import PositionAttack, View
from bench.geometry.lines import read_lines
from bench.positions.neighbourhood import recover_positions
from bench.threat_model import TrueNeighbours
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class NeighbourhoodOracle(PositionAttack):
    """Reference, not an attack: estimates positions on lines with the true neighbours."""

    accepts = (Descriptors, WordSets, Subspaces)
    needs = frozenset({TrueNeighbours})

    neighbours: int = 10

    def locate(self, view: View, rng: np.random.Generator) -> Floats:
        near = view.know(TrueNeighbours).order[:, : self.neighbours]
        return recover_positions(read_lines(view.release), near, np.ones(near.shape, np.float32), view.release.size)


PLUGIN = NeighbourhoodOracle
