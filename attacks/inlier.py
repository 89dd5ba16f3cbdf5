"""The inlier attack: the server keeps the keypoints that RANSAC verified, with the descriptors that their matches reveal.

The paper's supplement: what is static and in the map appears in the image, and what moves before it does not. It holds for any
release that a server can localize, whatever it promises of one descriptor: the map tells the rest.

Subspaces do not tell what a photograph looks like well enough to retrieve references by them, yet localize where they are matched
with the right ones. So they are matched with all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import Selection, SelectiveAttack, View
from bench.core.errors import SampleError
from bench.localization import map_matching
from bench.types import Descriptors, Knowledge, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Inlier(SelectiveAttack):
    """Paints from those keypoints that the server could verify, by the map's descriptors of the points that they are of."""

    accepts = (Descriptors, Subspaces, WordSets)
    needs = frozenset({Knowledge.MAP})

    retrieved: int = 20  # references that a query is matched with; of subspaces, all
    trials: int = 30_000  # of RANSAC, at most

    def select(self, view: View, rng: np.random.Generator) -> Selection:
        server = view.know(Knowledge.MAP)
        matcher = map_matching.default(view.defense)
        if matcher is None:
            raise SampleError(f"nothing matches {type(view.release).__name__}")
        if isinstance(view.release, Subspaces):
            references = np.arange(len(server.place.references))
        else:
            references = server.seen_in(view.release, view.defense, self.retrieved)
        seed = int(rng.integers(2**31))
        found = server.localize(view.release, view.defense, references, matcher, self.trials, seed)
        verified = np.zeros(len(found.correspondences), bool) if found.estimate is None else found.estimate.inliers
        keypoints = found.correspondences.keypoints[verified]
        seen = server.place.map.descriptors[found.correspondences.rows[verified]]
        rows, first = np.unique(keypoints, return_index=True)
        view.notes.append(f"{len(rows)} keypoints verified")
        return Selection(rows=rows, descriptors=seen[first])


PLUGIN = Inlier
