"""Oracle: a reference that knows which released words are true. It is no attack: nobody has this knowledge.

Source: not in the paper.

Method: keep the keypoints whose set contains the true word, with that word. The network for raw descriptors reconstructs the
photograph from them alone.

Knowledge: the true words, which are part of the secret.

Limits: the score is a ceiling for attacks that select words and reconstruct from the selected ones. An attack with a better
network can exceed it. The leakage of such attacks lies between the strongest of them and the oracle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Selection, SelectiveAttack, View
from bench.threat_model import TrueWords
from bench.types import WordSets


@dataclass(frozen=True, kw_only=True)
class Oracle(SelectiveAttack):
    """Reference, not an attack: knows which released words are true."""

    accepts = (WordSets,)
    needs = frozenset({TrueWords})

    def select(self, view: View, rng: np.random.Generator) -> Selection:
        release = view.release
        if not isinstance(release, WordSets):
            raise TypeError(f"oracle reads WordSets, got {type(release).__name__}")
        candidates = view.know(TrueWords).candidates
        rows = np.flatnonzero(candidates < release.subset_size)
        return Selection(rows=rows, descriptors=release.candidates[rows, candidates[rows]])


PLUGIN = Oracle
