"""Localization: the server's error in the pose of a release's camera (the paper's Sec. 6.2).

Queries are privatised, references are not. For each query the server retrieves references, matches the release with them, and
estimates the pose with fixed intrinsics. A query without an estimate counts as not localized. So does a query whose intrinsics
the server rejects: its record has a note that begins with `REJECTED`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from bench.api import Attack, Dataset, Defense, Extractor
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.datasets.gallery import Gallery
from bench.formats import lists, pairs
from bench.images import samples
from bench.images.samples import Collection, Images
from bench.images.scene import SceneImage
from bench.localization import map_matching, pose
from bench.localization.server import Server
from bench.task_api import REJECTED, Outcome, Task, Trial
from bench.types import Features, Indices, Lines, Points, Positions

# Largest errors of a localized pose: units of length and degrees (Sattler et al., CVPR 2018).
THRESHOLDS = {"0.25m_2deg": (0.25, 2.0), "0.5m_5deg": (0.5, 5.0), "5m_10deg": (5.0, 10.0)}
COUNTS = ("matches", "inliers", "trials")


@dataclass(frozen=True, kw_only=True)
class Localization(Task):
    """Fraction of the queries of a scene that a server can localize from their releases.

    Retrieval `raw` uses the query's raw descriptors, so it is the same for every defense. The paper does so, and does not count
    this leak. Retrieval `released` uses the release alone. A file of `pairs` replaces retrieval.
    """

    judges_attacks: ClassVar[bool] = False
    needs_scene: ClassVar[bool] = True
    needs_map: ClassVar[bool] = True
    accepts_positions: ClassVar[tuple[type[Positions], ...]] = (Points, Lines)

    # auto: the best matcher for the release among those that do not lift references
    matcher: Literal["auto", "vocabulary", "noisy-nn", "mutual-nn", "point-to-subspace", "subspace-to-subspace"] = "auto"
    retrieval: Literal["raw", "released"] = "raw"
    retrieved: int = 20  # references per query
    trials: int = 30_000  # largest number of RANSAC trials
    pairs: Path | None = None  # a file of retrieved references in hloc's format

    def __post_init__(self) -> None:
        if self.retrieved < 1 or self.trials < 1:
            raise UserError("localization: retrieved and trials must be at least 1")

    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        if images is not None:
            raise UserError("localization takes the queries of a dataset and no images; give --dataset")
        return samples.collect_queries(dataset or Gallery())

    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        name = self._select_matcher(defense)
        return (
            f"nothing matches {defense.releases.__name__}" if name is None else map_matching.explain_not_applicable(name, defense)
        )

    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        return {}

    def evaluate(self, trial: Trial) -> Outcome:
        query: SceneImage = trial.sample.subject
        server = Server(public=trial.public, camera=query.camera)
        if (ratio := _find_focal_mismatch(server, trial.secret, query.name)) is not None:
            return _reject(query, ratio)
        matcher = self._select_matcher(trial.defense)
        if matcher is None:
            raise SampleError(f"nothing matches {type(trial.release).__name__}")
        references, seed = self._retrieve(server, trial, query), int(trial.rng.integers(2**31))
        result = server.localize(trial.release, trial.defense, references, matcher, self.trials, seed)
        estimate = result.estimate
        numbers = (0, 0) if estimate is None else (estimate.inliers.sum(), estimate.trials)
        counts = dict(zip(COUNTS, map(float, (len(result.correspondences), *numbers)), strict=True))
        cam_from_world = None if estimate is None else estimate.cam_from_world
        estimates = {
            "pose": None
            if cam_from_world is None
            else [*lists.to_wxyz(cam_from_world).tolist(), *cam_from_world.translation.tolist()],
            "retrieved": [server.scene_index.map.names[reference] for reference in references],
        }
        if query.cam_from_world is None:
            return Outcome(metrics=counts, estimates=estimates, notes=("its pose is withheld",))
        errors = None if cam_from_world is None else pose.compute_errors(cam_from_world, query.cam_from_world)
        return Outcome(metrics={**score_pose(errors), **counts}, estimates=estimates)

    def _select_matcher(self, defense: Defense) -> str | None:
        return map_matching.select_matcher(defense) if self.matcher == "auto" else self.matcher

    def _retrieve(self, server: Server, trial: Trial, query: SceneImage) -> Indices:
        if self.pairs is not None:
            return look_up_pairs(self.pairs, query.name, server.scene_index.map.names)[: self.retrieved]
        if self.retrieval == "raw":
            return server.retrieve_by_query(trial.secret, self.retrieved)
        return server.retrieve_by_release(trial.release, trial.defense, self.retrieved)


def _find_focal_mismatch(server: Server, secret: Features, query: str) -> float | None:
    """Return `Server.estimate_focal_mismatch`. Raw features decide, so that all defenses have the same queries rejected."""
    mismatches = server.scene_index.focal_mismatches
    if query not in mismatches:
        mismatches[query] = server.estimate_focal_mismatch(secret)
    return mismatches[query]


def _reject(query: SceneImage, ratio: float) -> Outcome:
    """Return the outcome of a query that counts as not localized because of its intrinsics. Its counts are not measured."""
    scores = {} if query.cam_from_world is None else score_pose(None)
    note = f"{REJECTED}: its raw features fit {ratio:.2f} times the focal length"
    return Outcome(metrics={**scores, **dict.fromkeys(COUNTS)}, notes=(note,))


def score_pose(errors: tuple[float, float] | None) -> dict[str, float | None]:
    """Return the metrics of a pose with these errors; None stands for a query that was not localized."""
    translation, rotation = (None, None) if errors is None else errors
    recalls = {
        f"recall_{name}": float(errors is not None and errors[0] <= length and errors[1] <= angle)
        for name, (length, angle) in THRESHOLDS.items()
    }
    return {**recalls, "translation_error": translation, "rotation_error": rotation}


def look_up_pairs(path: Path, query: str, names: tuple[str, ...]) -> Indices:
    """Return the references that a file of pairs lists for a query.

    Raises
    ------
    UserError
        if the file is damaged, or names an image that is no reference of the map.
    """
    rows = {name: row for row, name in enumerate(names)}
    wanted = pairs.read(path).get(query, [])
    missing = [name for name in wanted if name not in rows]
    if missing:
        raise UserError(f"{path}: {missing[0]} is no reference of the map")
    return np.array([rows[name] for name in wanted], dtype=np.int64)


PLUGIN = Localization
