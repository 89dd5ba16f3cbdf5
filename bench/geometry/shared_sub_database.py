"""Search for releases with the same sub-database as a given release, and for intersections of their subspaces with its own.

The adversarial words of a photograph come from one of n sub-databases, so one release in n uses the same one. Two such releases
of N and N' subspaces, with a words each from S words, have about N N' a² / S intersections. A sample of each release decides.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.api import NOT_CONVERGED
from bench.geometry.intersections import (
    Doubles,
    SubspaceIntersections,
    concatenate_intersections,
    find_intersections,
    find_intersections_within,
    orthonormalize,
)
from bench.types import Points, Release, Subspaces

BATCH = 16  # releases per batch
SAMPLE_INTERSECTIONS = 8.0  # expected number for a sample of a release with the same sub-database: 1 sample in 3,000 has none
PAIRS = 1024  # intersections measured at a time


@dataclass(frozen=True, eq=False)
class SharedSubDatabase:
    """Subspaces from the same sub-database as a target's, and their intersections with the target's subspaces."""

    subspaces: Subspaces  # of the target, then of the sharing releases
    intersections: SubspaceIntersections  # of the target's subspaces (`first`) with any of these (`second`); its own pairs twice
    searched: int  # other releases searched
    sharing: int  # of these, the ones that share the sub-database
    coverage: float  # fraction of the words in the target's subspaces that another of these contains

    def list_notes(self, enough: float) -> list[str]:
        """Return a summary, and a note if the coverage is less than `enough`."""
        summary = f"coverage {self.coverage:.3f}: {self.sharing} of {self.searched} other releases share the sub-database"
        return [summary, *([f"{NOT_CONVERGED}: coverage below {enough:g}"] if self.coverage < enough else [])]


def find_shared_sub_database(target: Subspaces, others: Iterator[Release], words: int, enough: float) -> SharedSubDatabase:
    """Search other releases, until the intersections cover a fraction `enough` of the words in the target's subspaces.

    Parameters
    ----------
    others : releases of the same defense
    words : number of words per subspace
    enough : from 0 to 1

    Raises
    ------
    TypeError
        if another release holds no subspaces.
    """
    own = find_intersections_within(target)
    intersections = [own, replace(own, first=own.second, second=own.first)]
    parts, searched, size = [target], 0, len(target)
    pairs, found = len(target) * (len(target) - 1) // 2, len(own)
    while (coverage := _compute_coverage(concatenate_intersections(intersections), words * len(target))) < enough:
        batch = [_require_subspaces(release) for release in itertools.islice(others, BATCH)]
        if not batch:
            break
        searched += len(batch)
        for part in _select_sharing(target, batch, found / max(pairs, 1)):
            more = find_intersections(target, part)
            intersections.append(replace(more, second=more.second + size))
            parts.append(part)
            size += len(part)
            pairs, found = pairs + len(target) * len(part), found + len(more)
    return SharedSubDatabase(stack_subspaces(parts), concatenate_intersections(intersections), searched, len(parts) - 1, coverage)


def _require_subspaces(release: Release) -> Subspaces:
    if not isinstance(release, Subspaces):
        raise TypeError(f"expected Subspaces, got {type(release).__name__}")
    return release


def stack_subspaces(releases: Sequence[Subspaces]) -> Subspaces:
    """Return the subspaces of one or more releases as one release."""
    return replace(
        releases[0],
        positions=Points(keypoints=np.concatenate([release.keypoints for release in releases])),
        origins=np.concatenate([release.origins for release in releases]),
        bases=np.concatenate([release.bases for release in releases]),
    )


def _select_sharing(target: Subspaces, releases: Sequence[Subspaces], chance: float) -> list[Subspaces]:
    """Return the releases with a sample that intersects the target; `chance` is that of two subspaces to intersect."""
    # The choice of rows does not matter: words are drawn independently for each keypoint.
    size = math.ceil(SAMPLE_INTERSECTIONS / (chance * len(target))) if chance else max(map(len, releases))
    samples = [release.take(np.arange(min(size, len(release)))) for release in releases]
    owners = np.repeat(np.arange(len(releases)), [len(sample) for sample in samples])
    hits = np.bincount(owners[find_intersections(target, stack_subspaces(samples)).second], minlength=len(releases))
    return [release for release, hit in zip(releases, hits, strict=True) if hit]


def _compute_coverage(intersections: SubspaceIntersections, words: int) -> float:
    """Return the fraction of words in the `first` subspaces that lie in an intersection. `words` is their number.

    Points with images on a line that differ by less than their tolerance count as one.
    """
    points = intersections.take(intersections.single)
    line = np.random.default_rng(0).normal(size=points.points.shape[1])
    images = points.points @ line
    order = np.lexsort((images, points.first))
    tolerances = points.tolerances[order]
    again = (np.diff(points.first[order]) == 0) & (np.diff(images[order]) < np.maximum(tolerances[1:], tolerances[:-1]))
    return (len(points) - int(again.sum())) / words


def compute_intersection_distances(points: Doubles, shared: SharedSubDatabase) -> Doubles:
    """Return the distance from points of each target subspace to the nearest subspace that intersects it; infinite without one.

    min_j dist(x_i, Q'_j) in the paper's terms. (N, p, D) -> (N, p)
    """
    nearest = np.full(points.shape[:2], np.inf)
    for start in range(0, len(shared.intersections), PAIRS):
        pairs = shared.intersections.take(np.arange(start, min(start + PAIRS, len(shared.intersections))))
        other = shared.subspaces.take(pairs.second)
        offsets = points[pairs.first] - other.origins[:, None]  # (P, p, D)
        bases = orthonormalize(other.bases.astype(np.float64))
        outside = offsets - (offsets @ bases.transpose(0, 2, 1)) @ bases
        np.minimum.at(nearest, pairs.first, np.linalg.norm(outside, axis=2))
    return nearest
