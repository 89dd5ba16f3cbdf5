"""Which points of the map the keypoints of a release may be images of. Which matcher applies is decided by the release's type.

All but `Vocabulary` compare the release with one retrieved reference at a time, as COLMAP and hloc match pairs of images, and
keep mutually nearest neighbours that have a point in the map.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from bench.api import Defense
from bench.core.device import pick_device
from bench.geometry.distances import mutual, points_to_points, subspaces_to_points, subspaces_to_subspaces
from bench.localization.maps import Map
from bench.types import Descriptors, Indices, Release, Subspaces, WordSets

RATIO = 0.8  # of Lowe's test


@dataclass(frozen=True, kw_only=True, eq=False)
class Retrieved:
    """What a query is matched with: some references of the map."""

    map: Map
    references: Indices  # (V',)
    words: Indices | None = None  # (T,) what all of the map's keypoints quantise to in the dictionary of the release
    lifted: Callable[[int], Subspaces] | None = None  # the keypoints of a reference, lifted as those of the release were

    @property
    def rows(self) -> Indices:
        """The keypoints of those references, as rows of the map."""
        parts = [np.arange(self.map.starts[each], self.map.starts[each + 1]) for each in self.references]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """C pairs of a keypoint of the release and a point of the map, each pair once, by keypoint and then by point."""

    keypoints: Indices  # (C,) of the release
    points: Indices  # (C,) of the map
    rows: Indices  # (C,) the keypoint of the map that the pair is due to; the first, if there are several

    def __len__(self) -> int:
        return len(self.keypoints)


class Matcher(ABC):
    """Matches a release with retrieved references."""

    accepts: ClassVar[tuple[type[Release], ...]]
    by_words: ClassVar[bool] = False  # whether it needs the words of the map's keypoints
    for_noise: ClassVar[bool] = False  # whether it is for descriptors that a defense buries in noise, and for no others

    @abstractmethod
    def match(self, release: Release, retrieved: Retrieved) -> Correspondences:
        """Raises TypeError if the release is none that it accepts."""


@dataclass(frozen=True, kw_only=True)
class Vocabulary(Matcher):
    """A keypoint matches every distinct point that one of its words is the word of, in any of the references.

    All of them, however many: with about as many words as retrieved points, few words have more than one.
    """

    accepts = (WordSets,)
    by_words = True

    def match(self, release: Release, retrieved: Retrieved) -> Correspondences:
        if not isinstance(release, WordSets) or release.words is None or retrieved.words is None:
            raise TypeError("matching by words needs a release of a dictionary's words, and the words of the map's keypoints")
        rows = retrieved.rows
        rows = rows[retrieved.map.points[rows] >= 0]
        rows = rows[np.argsort(retrieved.words[rows], kind="stable")]  # by word, and then as they were
        known = retrieved.words[rows]
        first, last = (np.searchsorted(known, release.words.ravel(), side) for side in ("left", "right"))  # (N m,)
        counts = last - first
        owners = np.repeat(np.arange(len(release)).repeat(release.subset_size), counts)
        places = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
        return distinct(owners, rows[places], retrieved.map)


@dataclass(frozen=True, kw_only=True)
class MutualNN(Matcher):
    """Mutually nearest descriptors; the candidates of a set count as if each had been seen."""

    accepts: ClassVar[tuple[type[Release], ...]] = (Descriptors, WordSets)

    ratio: float = RATIO

    def match(self, release: Release, retrieved: Retrieved) -> Correspondences:
        if not isinstance(release, (Descriptors, WordSets)):
            raise TypeError(f"mutual-nn matches descriptors, not {type(release).__name__}")
        sets = release.descriptors[:, None] if isinstance(release, Descriptors) else release.candidates  # (N, m, D)
        mine = torch.from_numpy(sets.reshape(-1, sets.shape[2])).to(pick_device())
        rows, seen = _nearest(retrieved, lambda reference: points_to_points(mine, _points(retrieved, reference)), self.ratio)
        return distinct(rows // sets.shape[1], seen, retrieved.map)


@dataclass(frozen=True, kw_only=True)
class NoisyNN(MutualNN):
    """The same without Lowe's test: what is buried in noise is nearly as far from its nearest as from its second nearest."""

    accepts = (Descriptors,)
    for_noise = True

    ratio: float = 1.0


@dataclass(frozen=True, kw_only=True)
class PointToSubspace(Matcher):
    """Mutually nearest by the distance of a reference's descriptor from a subspace (Dusmanu et al., CVPR 2021)."""

    accepts = (Subspaces,)

    ratio: float = 1.0

    def match(self, release: Release, retrieved: Retrieved) -> Correspondences:
        if not isinstance(release, Subspaces):
            raise TypeError(f"point-to-subspace matches subspaces, not {type(release).__name__}")
        found = _nearest(retrieved, lambda reference: subspaces_to_points(release, _points(retrieved, reference)), self.ratio)
        return distinct(*found, retrieved.map)


@dataclass(frozen=True, kw_only=True)
class SubspaceToSubspace(Matcher):
    """Mutually nearest by the distance of two subspaces, where references are lifted, too (Dusmanu et al., CVPR 2021).

    It serves worse than `PointToSubspace`, and is for servers that hold no descriptors either.
    """

    accepts = (Subspaces,)

    ratio: float = 1.0

    def match(self, release: Release, retrieved: Retrieved) -> Correspondences:
        if not isinstance(release, Subspaces) or (lifted := retrieved.lifted) is None:
            raise TypeError("subspace-to-subspace needs a release of subspaces, and references that are lifted")
        found = _nearest(retrieved, lambda reference: subspaces_to_subspaces(release, lifted(reference)), self.ratio)
        return distinct(*found, retrieved.map)


MATCHERS: dict[str, type[Matcher]] = {
    "vocabulary": Vocabulary,
    "noisy-nn": NoisyNN,
    "mutual-nn": MutualNN,
    "point-to-subspace": PointToSubspace,
    "subspace-to-subspace": SubspaceToSubspace,
}


def inapplicable(name: str, defense: Defense) -> str | None:
    """Why that matcher does not match what the defense releases; None if it does."""
    matcher = MATCHERS[name]
    if not issubclass(defense.releases, matcher.accepts):
        accepted = " or ".join(kind.__name__ for kind in matcher.accepts)
        return f"{name} matches {accepted}; {defense.name()} releases {defense.releases.__name__}"
    if matcher.by_words and defense.dictionary_field is None:
        return f"{name} matches words of a dictionary; {defense.name()} has none"
    if matcher.for_noise and not defense.noisy:
        return f"{name} matches descriptors that are buried in noise; those of {defense.name()} are not"
    return None


def default(defense: Defense) -> str | None:
    """The first matcher that applies; None if none does."""
    return next((name for name in MATCHERS if inapplicable(name, defense) is None), None)


def distinct(keypoints: Indices, rows: Indices, seen: Map) -> Correspondences:
    """Pairs of a keypoint and a row of the map as pairs of a keypoint and a point, each once."""
    keep = seen.points[rows] >= 0
    keypoints, rows = keypoints[keep], rows[keep]
    pairs, first = np.unique(np.stack([keypoints, seen.points[rows]], axis=1), axis=0, return_index=True)
    return Correspondences(keypoints=pairs[:, 0], points=pairs[:, 1], rows=rows[first])


def _points(retrieved: Retrieved, reference: int) -> Tensor:
    """The descriptors of a reference. -> (R, D)"""
    return torch.from_numpy(retrieved.map.descriptors[retrieved.map.rows(reference)]).to(pick_device())


def _nearest(retrieved: Retrieved, squared: Callable[[int], Tensor], ratio: float) -> tuple[Indices, Indices]:
    """Mutually nearest pairs of something released and a keypoint of a reference, one reference after the other.

    `squared` takes a reference of R keypoints to squared distances (n, R). -> (P,) rows of those, (P,) rows of the map
    """
    released, seen = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for reference in retrieved.references.tolist():
        rows, columns = mutual(squared(reference), ratio)
        released.append(rows)
        seen.append(retrieved.map.rows(reference).start + columns)
    return np.concatenate(released), np.concatenate(seen)
