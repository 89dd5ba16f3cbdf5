"""Inlier attack: reconstructs the photograph from the keypoints that the server verifies by RANSAC.

Source: the paper's supplement, "Sensitivity of Inlier Content".

Method:

1. Localize the release in the server's map. Subspaces are too ambiguous for image retrieval, but they localize when matched with
   the right references. So they are matched with all references.
2. Select the keypoints of the matches that RANSAC verifies, and give each the map's descriptor of its match.
3. The network for raw descriptors reconstructs the photograph from these keypoints alone.

Knowledge: the server's map.

Limits: the reconstruction shows static content that is in the map, and no moving objects in front of it. The attack applies to
any release that a server can localize, whatever its guarantee for one descriptor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.api import NOT_CONVERGED, Selection, SelectiveAttack, View
from bench.core.errors import SampleError
from bench.localization import map_matching
from bench.threat_model import ServerMap
from bench.types import Descriptors, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Inlier(SelectiveAttack):
    """Reconstructs the photograph from the keypoints that the server verifies, with the map's descriptors."""

    accepts = (Descriptors, Subspaces, WordSets)
    needs = frozenset({ServerMap})

    retrieved: int = 20  # references that a query is matched with; subspaces are matched with all
    trials: int = 30_000  # maximum number of RANSAC's trials

    def select(self, view: View, rng: np.random.Generator) -> Selection:
        server = view.know(ServerMap).server
        matcher = map_matching.select_matcher(view.defense)
        if matcher is None:
            raise SampleError(f"no matcher supports {type(view.release).__name__}")
        if isinstance(view.release, Subspaces):
            references = np.arange(len(server.scene_index.reference_features))
        else:
            references = server.retrieve_by_release(view.release, view.defense, self.retrieved)
        seed = int(rng.integers(2**31))
        localization = server.localize(view.release, view.defense, references, matcher, self.trials, seed)
        matches, pose = localization.correspondences, localization.estimate
        verified = np.zeros(len(matches), bool) if pose is None else pose.inliers
        keypoints = matches.keypoints[verified]
        descriptors = server.scene_index.map.descriptors[matches.rows[verified]]
        rows, first = np.unique(keypoints, return_index=True)
        view.notes.append(f"{len(rows)} keypoints verified")
        if pose is not None and pose.trials >= self.trials:
            view.notes.append(f"{NOT_CONVERGED}: RANSAC made all {self.trials} trials")
        return Selection(rows=rows, descriptors=descriptors[first])


PLUGIN = Inlier
