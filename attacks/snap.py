"""Snap: the server localizes the release, and the keypoints that it verifies fall onto known points of its map.

Source: not in the paper.

Method:

1. Localize the release in the server's map from its lines.
2. The position of a verified keypoint is the projection of its point.
3. The other keypoints are estimated as by `neighbourhood`, with the verified ones as neighbours at known positions.

Knowledge: the server's map, and the model of neighbours.

Limits: a server that can localize a release knows the positions of its inliers, whatever hides them. Objects in front of the
mapped scene have no inliers, and only their neighbours reveal them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.api import NOT_CONVERGED, Defense, Extractor, PositionAttack, View
from bench.codebook.public import Public
from bench.core.errors import SampleError
from bench.geometry.lines import read_lines
from bench.localization import map_matching
from bench.positions import neighbour_model
from bench.positions.neighbourhood import recover_positions
from bench.positions.prediction import predict_neighbours
from bench.threat_model import PublicAssets, ServerMap
from bench.types import Descriptors, Floats, WordSets


@dataclass(frozen=True, kw_only=True)
class Snap(PositionAttack):
    """Localizes the release, projects the points of verified keypoints, and estimates the others from their neighbours."""

    accepts = (Descriptors, WordSets)
    needs = frozenset({PublicAssets, ServerMap})

    neighbours: int = 30
    reach: float = 15.0  # pixels, as of `neighbourhood`
    retrieved: int = 20  # references that a query is matched with
    trials: int = 30_000  # maximum number of RANSAC's trials

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        return neighbour_model.load().explain_other_features(extractor, public)

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        return {"neighbour_model": neighbour_model.load().digest}

    def locate(self, view: View, rng: np.random.Generator) -> Floats:
        release, server = view.release, view.know(ServerMap).server
        matcher = map_matching.select_matcher(view.defense)
        if matcher is None:
            raise SampleError(f"no matcher supports {type(release).__name__}")
        references = server.retrieve_by_release(release, view.defense, self.retrieved)
        result = server.localize(release, view.defense, references, matcher, self.trials, int(rng.integers(2**31)))
        known = np.full((len(release), 2), np.nan)
        if result.estimate is not None:
            pairs, inliers = result.correspondences, result.estimate.inliers
            in_camera = result.estimate.cam_from_world * server.scene_index.map.xyz[pairs.points[inliers]]
            known[pairs.keypoints[inliers]] = server.camera.img_from_cam(in_camera)
        verified = ~np.isnan(known[:, 0])
        view.notes.append(f"{verified.sum()} keypoints verified")
        if result.estimate is not None and result.estimate.trials >= self.trials:
            view.notes.append(f"{NOT_CONVERGED}: RANSAC made all {self.trials} trials")
        near, weights = predict_neighbours(release, view.defense, view.know(PublicAssets).assets, self.neighbours)
        positions = recover_positions(read_lines(release), near, weights, release.size, self.reach, known)
        return np.where(verified[:, None], known, positions).astype(np.float32)


PLUGIN = Snap
