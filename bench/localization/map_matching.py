"""Matches between keypoints of a release and points of the map. The type of the release determines the matcher.

All matchers except `Vocabulary` match the release with one retrieved reference at a time, as COLMAP and hloc match pairs of
images. They return mutually nearest neighbours with a point in the map. `two_view_matching` matches two images without a map.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from bench.api import Defense, Extractor
from bench.core.device import pick_device
from bench.geometry.distances import find_mutual_nearest, points_to_points, subspaces_to_points, subspaces_to_subspaces
from bench.localization.maps import Map
from bench.types import Descriptors, Indices, Release, Subspaces, WordSets

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class RetrievedReferences:
    """The references of the map that a query is matched with."""

    map: Map
    references: Indices  # (V',)
    words: Indices | None = None  # (T,) the nearest word of each of the map's keypoints, in the dictionary of the release
    lift: Callable[[int], Subspaces] | None = None  # lifts the keypoints of a reference with the release's defense

    @property
    def rows(self) -> Indices:
        """Keypoints of those references, as rows of the map."""
        parts = [np.arange(self.map.starts[each], self.map.starts[each + 1]) for each in self.references]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """C distinct pairs of a keypoint of the release and a point of the map, sorted by keypoint and then by point."""

    keypoints: Indices  # (C,) of the release
    points: Indices  # (C,) of the map
    rows: Indices  # (C,) the keypoint of the map that gave the pair; the first one if there are several

    def __len__(self) -> int:
        return len(self.keypoints)


class Matcher(ABC):
    """Matches a release with retrieved references."""

    release_types: ClassVar[tuple[type[Release], ...]]
    needs_words: ClassVar[bool] = False  # whether it needs the words of the map's keypoints
    needs_noise: ClassVar[bool] = False  # whether it applies to defenses with strong noise only

    @abstractmethod
    def match(self, release: Release, retrieved: RetrievedReferences) -> Correspondences:
        """Return the correspondences of a release. Raises TypeError if the release is of another type."""


@dataclass(frozen=True, kw_only=True)
class Vocabulary(Matcher):
    """Matches a keypoint with every point, in any of the references, whose word is one of the keypoint's words.

    If the dictionary has about as many words as there are retrieved points, few words have more than one point.
    """

    release_types = (WordSets,)
    needs_words = True

    def match(self, release: Release, retrieved: RetrievedReferences) -> Correspondences:
        if not isinstance(release, WordSets) or release.words is None or retrieved.words is None:
            raise TypeError("matching by words needs a release of a dictionary's words, and the words of the map's keypoints")
        rows = retrieved.rows
        rows = rows[retrieved.map.points[rows] >= 0]
        rows = rows[np.argsort(retrieved.words[rows], kind="stable")]  # by word, then by row
        words = retrieved.words[rows]
        first, last = (np.searchsorted(words, release.words.ravel(), side) for side in ("left", "right"))  # (N m,)
        counts = last - first
        owners = np.repeat(np.arange(len(release)).repeat(release.subset_size), counts)
        positions = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
        return deduplicate(owners, rows[positions], retrieved.map)


@dataclass(frozen=True, kw_only=True)
class MutualNN(Matcher):
    """Matches mutually nearest descriptors. Each candidate of a word set counts as a descriptor."""

    release_types: ClassVar[tuple[type[Release], ...]] = (Descriptors, WordSets)

    ratio: float = Extractor.match_ratio

    def match(self, release: Release, retrieved: RetrievedReferences) -> Correspondences:
        import torch

        if not isinstance(release, (Descriptors, WordSets)):
            raise TypeError(f"mutual-nn matches descriptors, not {type(release).__name__}")
        sets = release.descriptors[:, None] if isinstance(release, Descriptors) else release.candidates  # (N, m, D)
        released = torch.from_numpy(sets.reshape(-1, sets.shape[2])).to(pick_device())
        rows, map_rows = _match_mutually(
            retrieved, lambda reference: points_to_points(released, _load_descriptors(retrieved, reference)), self.ratio
        )
        return deduplicate(rows // sets.shape[1], map_rows, retrieved.map)


@dataclass(frozen=True, kw_only=True)
class NoisyNN(MutualNN):
    """`MutualNN` without Lowe's test: under strong noise, the nearest and the second nearest have about equal distances."""

    release_types = (Descriptors,)
    needs_noise = True

    ratio: float = 1.0


@dataclass(frozen=True, kw_only=True)
class PointToSubspace(Matcher):
    """Matches mutually nearest descriptors and subspaces, by point-to-subspace distance (Dusmanu et al., CVPR 2021)."""

    release_types = (Subspaces,)

    ratio: float = 1.0

    def match(self, release: Release, retrieved: RetrievedReferences) -> Correspondences:
        if not isinstance(release, Subspaces):
            raise TypeError(f"point-to-subspace matches subspaces, not {type(release).__name__}")
        rows = _match_mutually(
            retrieved, lambda reference: subspaces_to_points(release, _load_descriptors(retrieved, reference)), self.ratio
        )
        return deduplicate(*rows, retrieved.map)


@dataclass(frozen=True, kw_only=True)
class SubspaceToSubspace(Matcher):
    """Matches mutually nearest subspaces, by the distance of two subspaces (Dusmanu et al., CVPR 2021).

    References are lifted, too. It is less accurate than `PointToSubspace`, and is for servers that hold no descriptors.
    """

    release_types = (Subspaces,)

    ratio: float = 1.0

    def match(self, release: Release, retrieved: RetrievedReferences) -> Correspondences:
        if not isinstance(release, Subspaces) or (lift := retrieved.lift) is None:
            raise TypeError("subspace-to-subspace needs a release of subspaces, and lifted references")
        rows = _match_mutually(retrieved, lambda reference: subspaces_to_subspaces(release, lift(reference)), self.ratio)
        return deduplicate(*rows, retrieved.map)


MATCHERS: dict[str, type[Matcher]] = {
    "vocabulary": Vocabulary,
    "noisy-nn": NoisyNN,
    "mutual-nn": MutualNN,
    "point-to-subspace": PointToSubspace,
    "subspace-to-subspace": SubspaceToSubspace,
}


def explain_not_applicable(name: str, defense: Defense) -> str | None:
    """Return the reason why a matcher does not apply to the defense's releases; None if it applies."""
    matcher = MATCHERS[name]
    if not issubclass(defense.releases, matcher.release_types):
        types = " or ".join(kind.__name__ for kind in matcher.release_types)
        return f"{name} matches {types}; {defense.name()} releases {defense.releases.__name__}"
    if matcher.needs_words and defense.dictionary_field is None:
        return f"{name} matches words of a dictionary; {defense.name()} has none"
    if matcher.needs_noise and not defense.noisy:
        return f"{name} matches descriptors under strong noise; {defense.name()} adds none"
    return None


def build_matcher(name: str, ratio: float) -> Matcher:
    """Return a matcher. `ratio` is that of Lowe's test between raw descriptors of the extractor."""
    matcher = MATCHERS[name]
    return matcher(ratio=ratio) if matcher is MutualNN else matcher()


def select_matcher(defense: Defense) -> str | None:
    """Return the name of the first matcher that applies; None if there is none."""
    return next((name for name in MATCHERS if explain_not_applicable(name, defense) is None), None)


def deduplicate(keypoints: Indices, rows: Indices, scene_map: Map) -> Correspondences:
    """Return distinct pairs of a keypoint and a point, from pairs of a keypoint and a row of the map."""
    keep = scene_map.points[rows] >= 0
    keypoints, rows = keypoints[keep], rows[keep]
    pairs, first = np.unique(np.stack([keypoints, scene_map.points[rows]], axis=1), axis=0, return_index=True)
    return Correspondences(keypoints=pairs[:, 0], points=pairs[:, 1], rows=rows[first])


def _load_descriptors(retrieved: RetrievedReferences, reference: int) -> Tensor:
    """Return the descriptors of a reference. -> (R, D)"""
    import torch

    return torch.from_numpy(retrieved.map.descriptors[retrieved.map.rows(reference)]).to(pick_device())


def _match_mutually(
    retrieved: RetrievedReferences, squared_distances: Callable[[int], Tensor], ratio: float
) -> tuple[Indices, Indices]:
    """Return mutually nearest pairs of the n released rows and the keypoints of each reference, reference by reference.

    `squared_distances` maps a reference of R keypoints to (n, R). -> (P,) released rows, (P,) rows of the map
    """
    released, map_rows = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for reference in retrieved.references.tolist():
        rows, columns = find_mutual_nearest(squared_distances(reference), ratio)
        released.append(rows)
        map_rows.append(retrieved.map.rows(reference).start + columns)
    return np.concatenate(released), np.concatenate(map_rows)
