"""The server: retrieval of references for a release, matching, and estimation of the client's pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.api import Defense
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import REFERENCES, Public
from bench.core.randomness import derive_generator
from bench.geometry.subspaces import guess_descriptors
from bench.localization import line_pose, map_matching, pose
from bench.localization.map_matching import Correspondences, RetrievedReferences
from bench.localization.pose import Estimate
from bench.localization.retrieval import TOP
from bench.localization.scene_index import SceneIndex
from bench.registry import spec
from bench.types import Bytes, Descriptors, Features, Floats, Indices, Lines, Points, Release, Subspaces, WordSets

if TYPE_CHECKING:
    import pycolmap

RETRIEVAL_WORDS = 16_000  # for retrieval by descriptors; at most a quarter of the number of keypoints of the references
CHECK_TRIALS = 1000  # of RANSAC on raw features, most of whose matches are correct


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalizationResult:
    """The correspondences and the pose of one release."""

    correspondences: Correspondences
    estimate: Estimate | None  # None if there are too few correspondences, or no pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Server:
    """The localization service for one client."""

    public: Public
    camera: pycolmap.Camera  # of the client, who sends the intrinsics with the release

    @property
    def scene_index(self) -> SceneIndex:
        """The index of the server's scene. Raises ValueError if there is none."""
        if self.public.scene_index is None:
            raise ValueError("a server needs a scene, and there is none")
        return self.public.scene_index

    def find_dictionary(self, defense: Defense) -> Dictionary | None:
        """Return the dictionary whose words a defense releases; None if there is none."""
        if defense.dictionary_field is None:
            return None
        words = 0 if defense.word_count_field is None else getattr(defense, defense.word_count_field)
        return self.public.dictionary(getattr(defense, defense.dictionary_field), words)

    def retrieve_by_query(self, query: Features, count: int = TOP) -> Indices:
        """Return the references most similar to a query's raw descriptors, the same for every defense. -> (count,)"""
        return self._rank_references(query.descriptors if query.codes is None else query.codes, count)

    def retrieve_by_release(self, release: Release, defense: Defense, count: int = TOP) -> Indices:
        """Return the references most similar to a release, from the release alone. -> (count,)"""
        dictionary = self.find_dictionary(defense)
        if isinstance(release, WordSets) and release.words is not None and dictionary is not None:
            return self.scene_index.build_bags(dictionary).rank(release.words, count)
        return self._rank_references(
            extract_descriptors(release, signed=bool((self.scene_index.map.descriptors < 0).any())), count
        )

    def localize(
        self, release: Release, defense: Defense | None, references: Indices, matcher: str, trials: int, seed: int
    ) -> LocalizationResult:
        """Match a release with references, and return the correspondences and the pose of the camera.

        Parameters
        ----------
        defense : of the release, for matchers that need words or lifted references
        matcher : one of map_matching.MATCHERS that applies to the release
        trials : largest number of RANSAC trials
        """
        method = map_matching.build_matcher(matcher, self.scene_index.extractor.match_ratio)
        dictionary = self.find_dictionary(defense) if method.needs_words and defense is not None else None
        retrieved = RetrievedReferences(
            map=self.scene_index.map,
            references=references,
            words=None if dictionary is None else self.scene_index.quantize_map(dictionary),
            lift=None if defense is None else lambda reference: self._lift_reference(defense, reference),
        )
        correspondences = method.match(release, retrieved)
        return LocalizationResult(
            correspondences=correspondences, estimate=self._estimate_pose(release, correspondences, trials, seed)
        )

    def _estimate_pose(self, release: Release, pairs: Correspondences, trials: int, seed: int) -> Estimate | None:
        """Return the pose from the released points or lines of the correspondences."""
        if isinstance(release.positions, Lines):
            lines = release.positions.lines[pairs.keypoints].astype(np.float64)
            xyz = self.scene_index.map.xyz[pairs.points]
            return line_pose.estimate(lines, xyz, self.camera, trials=trials, seed=seed)
        return pose.estimate(*self._gather_points(release, pairs), self.camera, trials=trials, seed=seed)

    def estimate_focal_mismatch(self, query: Features) -> float | None:
        """Return the focal length estimated from raw features, relative to the camera's; None unless they clearly differ."""
        raw = Descriptors(positions=Points(keypoints=query.keypoints), size=query.size, descriptors=query.descriptors)
        result = self.localize(raw, None, self.retrieve_by_query(query), "mutual-nn", CHECK_TRIALS, seed=0)
        if result.estimate is None:
            return None
        return pose.estimate_focal_mismatch(*self._gather_points(raw, result.correspondences), self.camera, result.estimate)

    def _lift_reference(self, defense: Defense, reference: int) -> Subspaces:
        """Return the keypoints of a reference, lifted with that defense. The result does not depend on the client's seed."""
        rng = derive_generator(
            "lifted reference", self.scene_index.digest, reference, spec.to_json_with_digests(defense, self.public)
        )
        subspaces = defense.protect(self.scene_index.reference_features[reference], self.public, rng)
        if not isinstance(subspaces, Subspaces):
            raise TypeError(f"{defense.name()} lifts nothing")
        return subspaces

    def _gather_points(self, release: Release, pairs: Correspondences) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels and 3D points. -> (C, 2), (C, 3) float64"""
        return release.keypoints[pairs.keypoints].astype(np.float64), self.scene_index.map.xyz[pairs.points]

    def _rank_references(self, descriptors: Bytes | Floats, count: int) -> Indices:
        dictionary = self.public.dictionary(REFERENCES, min(RETRIEVAL_WORDS, len(self.scene_index.map.keypoints) // 4))
        return self.scene_index.build_bags(dictionary).rank(dictionary.index.find_nearest(descriptors), count)


def extract_descriptors(release: Release, signed: bool) -> Floats:
    """Return the descriptors of a release, or all its candidates, or the best guess for each subspace. -> (R, D)

    `signed` is whether descriptors can have negative components.

    Raises
    ------
    TypeError
        if the release is of another type.
    """
    if isinstance(release, Descriptors):
        return release.descriptors
    if isinstance(release, WordSets):
        return release.candidates.reshape(-1, release.candidates.shape[2])
    if isinstance(release, Subspaces):
        return guess_descriptors(release, signed)
    raise TypeError(f"{type(release).__name__} holds nothing similar to descriptors")
