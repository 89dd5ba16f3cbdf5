"""Intersections: whether the words near a subspace match the descriptors in it (the paper's Table S3).

The paper: "for each subspace, we select the top N database descriptors closest to the subspace, and match them to the m/2 + 1
descriptors forming the subspace. Using the standard ratio test we report the percentage of successful matches."

Here the N words of the database nearest to the subspace, without the m/2 adversarial ones, are matched to d and the a_i. A match
succeeds if the nearest of those m/2 + 1 points is less than 0.8 times as far as the second nearest.

With the adversarial words among the N, success at N = 5 and m = 16 is 100% by construction: five of the eight words in the
subspace match themselves. The paper prints 94.38%. These fractions are recorded as `with_adversarial_top5` and so on.

The opposite direction matches each of the m/2 + 1 points to its nearest among the N words. Its success grows with m, because all
a_i are words and match themselves. The paper's success falls with m.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.api import Attack, Dataset, Defense, Extractor, Lifting, explain_no_words
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.images.samples import Collection, Images, collect_only_photographs
from bench.registry import fields
from bench.task_api import Outcome, Task, Trial
from bench.types import Features, Floats

COUNTS = (50, 20, 10, 5)  # N
BATCH = 64  # subspaces


@dataclass(frozen=True, kw_only=True)
class Intersections(Task):
    """Fraction of the words nearest to a subspace that match one of the descriptors in it. Computed by the owner.

    The descriptors of a photograph are lifted repeatedly until there are `subspaces` liftings. For 0, each is lifted once.
    """

    judges_attacks = False

    ratio: float = 0.8  # upper limit of the ratio of the distances to the nearest and the second nearest point
    subspaces: int = 0  # number of liftings per photograph; 0: one per descriptor

    def __post_init__(self) -> None:
        if not 0 < self.ratio <= 1:
            raise UserError(f"intersections: ratio must be above 0 and at most 1, got {self.ratio}")
        if self.subspaces < 0:
            raise UserError(f"intersections: subspaces must be at least 0, got {self.subspaces}")

    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        return collect_only_photographs(self, images, dataset)

    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        return explain_no_words(defense)

    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        return {}

    def evaluate(self, trial: Trial) -> Outcome:
        defense = trial.defense
        if not isinstance(defense, Lifting):
            raise SampleError("intersections needs subspaces through words of a database")
        words = trial.public.dictionary(fields.list_assets(defense)["database"]).words  # (K, D)
        count = self.subspaces or len(trial.secret)
        alone, among = [], []
        for secret in draw_rounds(trial.secret, count, trial.rng):
            lifting = defense.lift(secret, trial.public, trial.rng)
            near, _ = find_nearest_to_subspaces(lifting.release, words, max(COUNTS) + defense.adversarial)  # (n, N + a)
            for rows in np.array_split(np.arange(len(near)), -(-len(near) // BATCH)):
                points = np.concatenate(
                    [secret.descriptors[rows, None], unit_rows(words[lifting.words[rows]])], axis=1
                )  # (b, 1 + a, D)
                match = pass_ratio_test(unit_rows(words[near[rows]]), points, self.ratio)  # (b, N + a)
                among.append(match)
                alone.append(
                    drop_left_out(match, (near[rows][:, :, None] == lifting.words[rows][:, None]).any(axis=2), max(COUNTS))
                )
        return Outcome(
            metrics={
                **_compute_fractions("success", alone),
                **_compute_fractions("with_adversarial", among),
                "subspaces": float(count),
            }
        )


def draw_rounds(secret: Features, count: int, rng: np.random.Generator) -> Iterator[Features]:
    """Yield all descriptors repeatedly, and finally a random subset, so that there are `count` of them in total."""
    while count > 0:
        rows = np.sort(rng.permutation(len(secret))[:count])
        yield secret.take(rows)
        count -= len(rows)


def pass_ratio_test(words: Floats, points: Floats, ratio: float) -> NDArray[np.bool_]:
    """Return whether a word's nearest point is below `ratio` times the distance of its second. (n, N, D), (n, p, D) -> (n, N)"""
    distances = np.linalg.norm(words[:, :, None].astype(np.float64) - points[:, None], axis=3)  # (n, N, p)
    nearest, second = np.moveaxis(np.partition(distances, 1, axis=2)[:, :, :2], 2, 0)
    return nearest < ratio * second


def drop_left_out(match: NDArray[np.bool_], left_out: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """Return the first `count` of each row that are not left out. (n, N + a), (n, N + a) -> (n, count)"""
    order = np.argsort(left_out, axis=1, kind="stable")[:, :count]
    return np.take_along_axis(match, order, axis=1)


def _compute_fractions(name: str, match: list[NDArray[np.bool_]]) -> dict[str, float]:
    """Return the fraction of successes among the first N columns, for each N."""
    rows = np.concatenate(match)
    return {f"{name}_top{count}": float(rows[:, :count].mean()) for count in COUNTS}


PLUGIN = Intersections
