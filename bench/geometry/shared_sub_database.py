"""Which releases share the words that a release's subspaces go through, and where its subspaces meet theirs.

The adversarial words of a photograph come from one of n sub-databases. So one in n of all others can meet it, and that one does
often: N N' a² / S times, for N and N' subspaces through a words each, of S. A sample of each release tells.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.geometry.intersections import Doubles, Meetings, joined, meetings, meetings_within
from bench.types import Subspaces

BATCH = 16  # releases that are looked at together
TELLING = 8.0  # meetings with the sample of a release that shares, on average: one in 3,000 has none
PAIRS = 1024  # meetings that are measured at a time
APART = 1e-5  # points whose images on a line are nearer than this are one


@dataclass(frozen=True, eq=False)
class Company:
    """The subspaces that share a target's sub-database, and where the target's own meet them."""

    subspaces: Subspaces  # the target's first, then those of the releases that share
    meetings: Meetings  # of the target's subspaces (`first`) with others of these (`second`); two of its own stand there twice
    asked: int  # other releases that were looked at
    kept: int  # of these, those that share
    coverage: float  # share of the words in the target's subspaces that another of these goes through, too

    def summary(self) -> str:
        return f"coverage {self.coverage:.3f}: {self.kept} of {self.asked} other releases share the sub-database"


def company(target: Subspaces, others: Iterator[Subspaces], words: int, enough: float) -> Company:
    """Look at other releases until `enough` of the words in the target's subspaces have been met, or there are no more.

    Parameters
    ----------
    others : made by the same defense
    words : that a subspace goes through
    enough : share, from 0 to 1
    """
    own = meetings_within(target)
    met = [own, replace(own, first=own.second, second=own.first)]
    parts, asked, size = [target], 0, len(target)
    pairs, found = len(target) * (len(target) - 1) // 2, len(own)
    while (coverage := _coverage(joined(met), words * len(target))) < enough:
        batch = list(itertools.islice(others, BATCH))
        if not batch:
            break
        asked += len(batch)
        for part in _sharing(target, batch, found / max(pairs, 1)):
            more = meetings(target, part)
            met.append(replace(more, second=more.second + size))
            parts.append(part)
            size += len(part)
            pairs, found = pairs + len(target) * len(part), found + len(more)
    return Company(stacked(parts), joined(met), asked, len(parts) - 1, coverage)


def stacked(releases: Sequence[Subspaces]) -> Subspaces:
    """The subspaces of at least one release, one after the other."""
    return replace(
        releases[0],
        keypoints=np.concatenate([release.keypoints for release in releases]),
        origins=np.concatenate([release.origins for release in releases]),
        bases=np.concatenate([release.bases for release in releases]),
    )


def _sharing(target: Subspaces, releases: Sequence[Subspaces], chance: float) -> list[Subspaces]:
    """Those of the releases of which a sample meets the target, where `chance` is that of two subspaces that share."""
    # Any rows will do: words are drawn for each keypoint afresh.
    size = math.ceil(TELLING / (chance * len(target))) if chance else max(map(len, releases))
    samples = [release.take(np.arange(min(size, len(release)))) for release in releases]
    owners = np.repeat(np.arange(len(releases)), [len(sample) for sample in samples])
    hits = np.bincount(owners[meetings(target, stacked(samples)).second], minlength=len(releases))
    return [release for release, hit in zip(releases, hits, strict=True) if hit]


def _coverage(met: Meetings, words: int) -> float:
    """Share of `words` words in the subspaces of `first` at which there is a meeting; several at one word count once."""
    certain = met.take(met.single)
    line = np.random.default_rng(0).normal(size=certain.points.shape[1])
    images = certain.points @ line
    order = np.lexsort((images, certain.first))
    again = (np.diff(certain.first[order]) == 0) & (np.diff(images[order]) < APART)
    return (len(certain) - int(again.sum())) / words


def nearest_that_meet(points: Doubles, shared: Company) -> Doubles:
    """From points of each of the target's subspaces to the nearest of those that meet it; infinite where none does.

    min_j dist(x_i, Q'_j) in the paper's terms. (N, p, D) -> (N, p)
    """
    nearest = np.full(points.shape[:2], np.inf)
    for start in range(0, len(shared.meetings), PAIRS):
        pairs = shared.meetings.take(np.arange(start, min(start + PAIRS, len(shared.meetings))))
        other = shared.subspaces.take(pairs.second)
        offsets = points[pairs.first] - other.origins[:, None]  # (P, p, D)
        outside = offsets - (offsets @ other.bases.transpose(0, 2, 1)) @ other.bases
        np.minimum.at(nearest, pairs.first, np.linalg.norm(outside, axis=2))
    return nearest
