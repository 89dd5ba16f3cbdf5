"""Division of a photograph's ε among its descriptors, and the yield of the ω-subset mechanism at that ε."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.core.errors import UserError
from bench.core.table import Table, build_table
from bench.mechanisms.composition import DELTA, UNCOVERED, compose_basic, compose_optimal, solve_epsilon
from bench.mechanisms.subset import log10_chance, most_accurate_size, most_informative_size, mutual_information

SIZES = (1, 2, 4)  # subset sizes shown beside the best ones


@dataclass(frozen=True)
class Budget:
    """The ε of a photograph and the resulting ε of a descriptor."""

    image: float
    keypoints: int
    releases: int
    words: int
    basic_epsilon: float
    optimal_epsilon: float

    @property
    def epsilon(self) -> float:
        """The larger ε of a descriptor."""
        return max(self.basic_epsilon, self.optimal_epsilon)


@dataclass(frozen=True)
class SubsetYield:
    """Statistics of sets of one size."""

    size: int  # m
    inclusion: float  # probability that a set contains the true word
    true_words: float  # expected number of true words in all sets of one release
    bits: float  # information of a set about the true word


def divide_budget(image: float, keypoints: int, releases: int, words: int) -> Budget:
    """Return the ε of a descriptor: that of a photograph divided among its descriptors, each released `releases` times.

    Raises
    ------
    UserError
        if a number is out of range.
    """
    if not image >= 0:
        raise UserError(f"--image-epsilon: must be at least 0, got {image}")
    if keypoints < 1 or releases < 1:
        raise UserError(f"--keypoints and --releases must be at least 1, got {keypoints} and {releases}")
    if words < 2:
        raise UserError(f"--words: must be at least 2, got {words}")
    answers = keypoints * releases
    return Budget(
        image,
        keypoints,
        releases,
        words,
        solve_epsilon(image, answers, compose_basic),
        solve_epsilon(image, answers, compose_optimal),
    )


def compute_yields(plan: Budget) -> list[SubsetYield]:
    """Return the yield at the ε of a descriptor, for a few sizes and the best ones."""
    optima = most_accurate_size(plan.epsilon, plan.words), most_informative_size(plan.epsilon, plan.words)
    sizes = sorted({*(size for size in SIZES if size < plan.words), *optima})
    bits = mutual_information(plan.epsilon, plan.words, np.array(sizes)) / math.log(2)
    inclusions = [10 ** log10_chance(plan.epsilon, plan.words, size) for size in sizes]
    return [
        SubsetYield(size, inclusion, plan.keypoints * inclusion, float(information))
        for size, inclusion, information in zip(sizes, inclusions, bits, strict=True)
    ]


def select_nearest_records(records: Sequence[Mapping[str, Any]], epsilon: float) -> list[Mapping[str, Any]]:
    """Return the records whose ε of a descriptor is nearest to `epsilon`.

    Raises
    ------
    UserError
        if no record has a guarantee.
    """
    claims = [record["privacy"]["epsilon_descriptor"] for record in records]
    distances = np.abs(np.array([math.nan if value is None else float(value) for value in claims]) - epsilon)
    if np.isnan(distances).all():
        raise UserError("--results: no record claims an epsilon")
    return [record for record, distance in zip(records, distances, strict=True) if distance == np.nanmin(distances)]


def report(plan: Budget) -> Iterator[Table | str]:
    """Yield the budget as terminal output."""
    released = "released once" if plan.releases == 1 else f"released {plan.releases} times"
    yield (
        f"ε = {plan.image:g} for a photograph of {plan.keypoints} keypoints, {released}:\n"
        f"- basic composition leaves ε = {plan.basic_epsilon:.4g} for a descriptor\n"
        f"- the optimal one (Kairouz, Oh and Viswanath) at δ = {DELTA:g} leaves ε = {plan.optimal_epsilon:.4g}\n"
        f"- not covered: {', '.join(UNCOVERED)}\n"
    )
    symbols = {most_accurate_size(plan.epsilon, plan.words): " †"}
    symbols[most_informative_size(plan.epsilon, plan.words)] = " *"
    rows = [
        (
            f"{row.size}{symbols.get(row.size, '')}",
            f"{row.inclusion:.4g}",
            f"{row.inclusion / row.size:.4g}",
            f"{row.true_words:.4g} of {plan.keypoints}",
            f"{row.bits:.3g} of {math.log2(plan.words):.3g}",
        )
        for row in compute_yields(plan)
    ]
    columns = ("words in a set", "Pr(true)", "Pr(a word of it is true)", "true words in all", "bits")
    remark = (
        "Pr(a word of it is true): the chance that a guess of an attacker or a matching server is right; "
        f"without any release it is {1 / plan.words:.3g}.\n"
        "* most information about the true word † most accurate word frequencies"
    )
    yield build_table(columns, rows, heading=f"At ε = {plan.epsilon:.4g}, of {plan.words} words", remarks=[remark])
