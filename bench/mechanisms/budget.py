"""What an ε for a whole photograph leaves for each descriptor, and what the ω-subset mechanism gives for that."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.core.errors import UserError
from bench.mechanisms.composition import DELTA, UNCOVERED, basic, epsilon_left, optimal
from bench.mechanisms.subset import information, log10_chance, most_accurate_size, most_informative_size

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

SIZES = (1, 2, 4)  # subset sizes that are shown beside the best ones


@dataclass(frozen=True)
class Budget:
    """An ε for a photograph, and the ε of a descriptor that it leaves."""

    image: float
    keypoints: int
    releases: int
    words: int
    by_basic: float
    by_optimal: float

    @property
    def epsilon(self) -> float:
        """Of a descriptor: the larger of the two."""
        return max(self.by_basic, self.by_optimal)


@dataclass(frozen=True)
class Yield:
    """What sets of one size give."""

    size: int  # m
    told: float  # the probability that a set holds the true word
    true_words: float  # in all sets of one release, on average
    bits: float  # that a set tells of the true word


def budget(image: float, keypoints: int, releases: int, words: int) -> Budget:
    """Divide an ε among the descriptors of a photograph, each released so many times.

    Raises
    ------
    UserError
        if a number makes no sense.
    """
    if not image >= 0:
        raise UserError(f"--image-epsilon: must be at least 0, got {image}")
    if keypoints < 1 or releases < 1:
        raise UserError(f"a photograph has at least 1 keypoint and is released at least once, got {keypoints} and {releases}")
    if words < 2:
        raise UserError(f"--words: a dictionary has at least 2 words, not {words}")
    answers = keypoints * releases
    return Budget(image, keypoints, releases, words, epsilon_left(image, answers, basic), epsilon_left(image, answers, optimal))


def yields(plan: Budget) -> list[Yield]:
    """What is left gives, for a few sizes and the best ones."""
    optima = most_accurate_size(plan.epsilon, plan.words), most_informative_size(plan.epsilon, plan.words)
    sizes = sorted({*(size for size in SIZES if size < plan.words), *optima})
    bits = information(plan.epsilon, plan.words, np.array(sizes)) / math.log(2)
    found = []
    for size, told_bits in zip(sizes, bits, strict=True):
        told = 10 ** log10_chance(plan.epsilon, plan.words, size)
        found.append(Yield(size, told, plan.keypoints * told, float(told_bits)))
    return found


def nearest(records: Sequence[Mapping[str, Any]], epsilon: float) -> list[Mapping[str, Any]]:
    """Those of the records whose ε of a descriptor is nearest.

    Raises
    ------
    UserError
        if none claims one.
    """
    claimed = [record["privacy"]["epsilon_descriptor"] for record in records]
    distances = np.abs(np.array([math.nan if value is None else float(value) for value in claimed]) - epsilon)
    if np.isnan(distances).all():
        raise UserError("--results: no record there claims an epsilon")
    return [record for record, distance in zip(records, distances, strict=True) if distance == np.nanmin(distances)]


def report(plan: Budget) -> Iterator[Text | Table]:
    """The budget as people read it."""
    from rich.table import Table
    from rich.text import Text

    released = "released once" if plan.releases == 1 else f"released {plan.releases} times"
    yield Text(
        f"ε = {plan.image:g} for a photograph of {plan.keypoints} keypoints, {released}:\n"
        f"- basic composition leaves ε = {plan.by_basic:.4g} for a descriptor\n"
        f"- the optimal one (Kairouz, Oh and Viswanath) at δ = {DELTA:g} leaves ε = {plan.by_optimal:.4g}\n"
        f"- not covered: {', '.join(UNCOVERED)}\n"
    )
    table = Table(
        title=Text(f"At ε = {plan.epsilon:.4g}, of {plan.words} words"),
        caption=Text(
            "Pr(a word of it is true): what a guess is worth, to an attacker as to a server that matches; "
            f"without any release it is {1 / plan.words:.3g}.\n"
            "* tells most of the true word † tells most of how frequent words are"
        ),
        title_justify="left",
        caption_justify="left",
    )
    for column in ("words in a set", "Pr(true)", "Pr(a word of it is true)", "true words in all", "bits told"):
        table.add_column(column, justify="right")
    marks = {most_accurate_size(plan.epsilon, plan.words): " †"}
    marks[most_informative_size(plan.epsilon, plan.words)] = " *"
    for row in yields(plan):
        table.add_row(
            f"{row.size}{marks.get(row.size, '')}",
            f"{row.told:.4g}",
            f"{row.told / row.size:.4g}",
            f"{row.true_words:.4g} of {plan.keypoints}",
            f"{row.bits:.3g} of {math.log2(plan.words):.3g}",
        )
    yield table
