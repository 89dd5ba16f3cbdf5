"""The server: retrieves references for what a client released, matches it with them, and estimates the client's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from bench.api import Defense
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import REFERENCES, Public
from bench.core.randomness import randomness
from bench.geometry.subspaces import guesses
from bench.localization import map_matching, pose
from bench.localization.map_matching import Correspondences, Retrieved
from bench.localization.pose import Estimate
from bench.localization.retrieval import TOP
from bench.localization.scene_index import Place
from bench.registry import spec
from bench.types import Bytes, Descriptors, Features, Floats, Indices, Release, Subspaces, WordSets

VOCABULARY = 16_000  # words that retrieval by descriptors uses, if the references have four times as many
CHECKED = 1000  # trials of RANSAC on raw features, which mostly match rightly


@dataclass(frozen=True, kw_only=True, eq=False)
class Localized:
    """What a server found out of one release."""

    correspondences: Correspondences
    estimate: Estimate | None  # None where there were too few correspondences, or no pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Server:
    """A place that is served to one client."""

    public: Public
    camera: pycolmap.Camera  # of the client: intrinsics are sent with the release

    @property
    def place(self) -> Place:
        """Raises ValueError where there is none."""
        if self.public.place is None:
            raise ValueError("a server serves a place, and there is none")
        return self.public.place

    def dictionary(self, defense: Defense) -> Dictionary | None:
        """That whose words a defense releases, if it has one."""
        if defense.dictionary_field is None:
            return None
        words = 0 if defense.word_count_field is None else getattr(defense, defense.word_count_field)
        return self.public.dictionary(getattr(defense, defense.dictionary_field), words)

    def seen_by(self, query: Features, count: int = TOP) -> Indices:
        """The references that look most like a query, by its raw descriptors: the same for every defense. -> (count,)"""
        return self._alike(query.descriptors if query.codes is None else query.codes, count)

    def seen_in(self, release: Release, defense: Defense, count: int = TOP) -> Indices:
        """The references that look most like a release, by nothing else than what was released. -> (count,)"""
        known = self.dictionary(defense)
        if isinstance(release, WordSets) and release.words is not None and known is not None:
            return self.place.bags(known).rank(release.words, count)
        return self._alike(looks(release), count)

    def localize(
        self, release: Release, defense: Defense | None, references: Indices, matcher: str, trials: int, seed: int
    ) -> Localized:
        """Match a release with references, and estimate the pose of its camera.

        Parameters
        ----------
        defense : that the release is from, for matchers of words or of references that are lifted as well
        matcher : one of matching.MATCHERS that applies to the release
        trials : of RANSAC, at most
        """
        how = map_matching.MATCHERS[matcher]()
        known = self.dictionary(defense) if how.by_words and defense is not None else None
        retrieved = Retrieved(
            map=self.place.map,
            references=references,
            words=None if known is None else self.place.words(known),
            lifted=None if defense is None else lambda reference: self._lifted(defense, reference),
        )
        found = how.match(release, retrieved)
        estimate = pose.estimate(*self._pairs(release, found), self.camera, trials=trials, seed=seed)
        return Localized(correspondences=found, estimate=estimate)

    def misfit(self, query: Features) -> float | None:
        """The focal length that a query's raw features ask for, relative to the camera's, if it is another beyond doubt."""
        raw = Descriptors(keypoints=query.keypoints, size=query.size, descriptors=query.descriptors)
        found = self.localize(raw, None, self.seen_by(query), "mutual-nn", CHECKED, seed=0)
        if found.estimate is None:
            return None
        return pose.misfit(*self._pairs(raw, found.correspondences), self.camera, found.estimate)

    def _lifted(self, defense: Defense, reference: int) -> Subspaces:
        """The keypoints of a reference as that defense releases them: once and for all, whatever the client's seed."""
        rng = randomness("lifted reference", self.place.digest, reference, spec.configuration(defense, self.public))
        lifted = defense.protect(self.place.references[reference], self.public, rng)
        if not isinstance(lifted, Subspaces):
            raise TypeError(f"{defense.name()} lifts nothing")
        return lifted

    def _pairs(self, release: Release, found: Correspondences) -> tuple[np.ndarray, np.ndarray]:
        """Pixels and points. -> (C, 2), (C, 3) float64"""
        return release.keypoints[found.keypoints].astype(np.float64), self.place.map.xyz[found.points]

    def _alike(self, descriptors: Bytes | Floats, count: int) -> Indices:
        known = self.public.dictionary(REFERENCES, min(VOCABULARY, len(self.place.map.keypoints) // 4))
        return self.place.bags(known).rank(known.index.nearest(descriptors), count)


def looks(release: Release) -> Floats:
    """Descriptors that a release looks like: its own, all candidates, or the best guess of a subspace. -> (R, D)

    Raises
    ------
    TypeError
        if it is of another kind.
    """
    if isinstance(release, Descriptors):
        return release.descriptors
    if isinstance(release, WordSets):
        return release.candidates.reshape(-1, release.candidates.shape[2])
    if isinstance(release, Subspaces):
        return guesses(release)
    raise TypeError(f"{type(release).__name__} look like no descriptors")
