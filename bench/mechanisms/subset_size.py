"""How many words to release for a given dictionary and ε: by what a set tells, and by what a server can do with it.

1. *Information*: the size at which a set tells most of its word (`bench.mechanisms.subset.information`, exactly).
2. *Localization*: the size at which RANSAC most likely finds the pose in the trials that it is allowed. The model:

   Of N keypoints, n have the same word as the point that they are of, in one of the retrieved references. Each is told
   with the probability p of Eq. (5), so that I ~ Binomial(n, p) matches are right. Each of the N m words released is
   that of R / |K| other points, too, where the references show R: W = N m R / |K| matches are wrong. Of T samples of s = 3

       1 − (1 − C(I, s) / C(I + W, s))^T

   is the chance that one is all right, and finds the pose. A wrong pose is agreed with by its own sample and Poisson(a W) other
   matches, a being the chance that a point which is somewhere in the image is within RANSAC's threshold. The pose is kept if more
   agree with it than with the best of T wrong ones, which is so with probability F(I − s − 1)^T, F being Poisson's distribution.

   p / m falls with m, so that the share of right matches is greatest for m = 1; but of fewer right matches, too few may be left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bench.core.errors import UserError
from bench.mechanisms.subset import information, log10_chance, most_accurate_size, most_informative_size
from bench.types import Indices

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

Doubles = NDArray[np.float64]

SAMPLE = 3  # matches that P3P takes
WITHIN = "recall_0.25m_2deg"
SAME = 5e-4  # between values of ε that are one when they are written with three digits


@dataclass(frozen=True, kw_only=True)
class Service:
    """What a server has to do with. The defaults are those of the gallery: medians over its queries by day."""

    keypoints: int = 1000  # N, of a query
    repeated: Sequence[float] = (0.27,)  # n / N, of one query or of several that are averaged
    points: int = 5000  # R, of the retrieved references
    trials: int = 30_000  # T
    agreeing: float = math.pi * 12**2 / (640 * 480)  # a: 12 pixels, in an image of that size


@dataclass(frozen=True)
class Choice:
    """What sets of one size give."""

    size: int  # m
    told: float  # p
    bits: float  # that a set tells of its word
    right: float  # matches of a query that are right, on average
    wrong: float
    success: float  # the chance that RANSAC finds the pose


def choices(epsilon: float, domain: int, sizes: Sequence[int], service: Service) -> list[Choice]:
    """What each size gives.

    Raises
    ------
    UserError
        if a number makes no sense.
    """
    if not epsilon >= 0 or math.isinf(epsilon):
        raise UserError(f"--epsilon: must be at least 0 and finite, got {epsilon}")
    if domain < 2:
        raise UserError(f"--words: a dictionary has at least 2 words, not {domain}")
    if not sizes or not all(0 < size < domain for size in sizes):
        raise UserError(f"--sizes: a set has at least 1 word and fewer than the dictionary's {domain}, got {list(sizes)}")
    if service.keypoints < 1 or service.points < 0 or service.trials < 1:
        raise UserError("a query has at least 1 keypoint, references show no negative number of points, RANSAC makes a trial")
    if not all(0 <= share <= 1 for share in (*service.repeated, service.agreeing)):
        raise UserError("shares are from 0 to 1")
    bits = information(epsilon, domain, np.array(sizes)) / math.log(2)
    return [_choice(epsilon, domain, size, float(told_bits), service) for size, told_bits in zip(sizes, bits, strict=True)]


def _choice(epsilon: float, domain: int, size: int, bits: float, service: Service) -> Choice:
    told = 10 ** log10_chance(epsilon, domain, size)
    wrong = service.keypoints * size * service.points / domain
    counts = np.rint(service.keypoints * np.array(service.repeated)).astype(np.int64)
    found = float(np.mean([success(int(n), told, wrong, service.trials, service.agreeing) for n in counts]))
    return Choice(size, told, bits, float(counts.mean() * told), wrong, found)


def success(n: int, told: float, wrong: float, trials: int, agreeing: float) -> float:
    """The chance that RANSAC finds the pose, by the model at the top of this file. `wrong` is W."""
    right = np.arange(n + 1)
    return float(stats.binom.pmf(right, n, told) @ (drawn(right, wrong, trials) * kept(right, wrong, trials, agreeing)))


def drawn(right: Indices, wrong: float, trials: int) -> Doubles:
    """The chance that one of the samples is all right. (I,) -> (I,)"""
    steps = np.arange(SAMPLE)
    shares = np.maximum(right[:, None] - steps, 0) / np.maximum(right[:, None] + wrong - steps, 1e-9)
    hit = np.where(right >= SAMPLE, shares.clip(max=1).prod(axis=1), 0.0)
    with np.errstate(divide="ignore"):
        return -np.expm1(trials * np.log1p(-hit))


def kept(right: Indices, wrong: float, trials: int, agreeing: float) -> Doubles:
    """The chance that more matches agree with the pose than with any of the wrong ones. (I,) -> (I,)"""
    return np.exp(trials * stats.poisson.logcdf(right - SAMPLE - 1, wrong * agreeing))


def measured(
    records: Sequence[Mapping[str, Any]], epsilon: float, domain: int, trials: int, condition: str
) -> tuple[dict[int, list[float]], list[float]]:
    """What was measured by localization with `ldp`: of each size whether each query was localized; and n / N of each query.

    The latter is how many matches of a query were right when nothing was hidden, with ε = ∞ and m = 1 and the same dictionary.

    Raises
    ------
    UserError
        if there is neither.
    """
    found: dict[int, list[float]] = {}
    repeated = []
    for record in records:
        defense = record["defense"]
        if not _is_told(record, trials, condition) or defense["name"] != "ldp" or defense["words"] != domain:
            continue
        told = float(defense["epsilon"])
        if math.isinf(told) and defense["subset_size"] == 1:
            repeated.append(record["metrics"]["inliers"] / record["metrics"]["keypoints"])
        elif abs(told - epsilon) < SAME:
            found.setdefault(defense["subset_size"], []).append(record["metrics"][WITHIN])
    if not found and not repeated:
        raise UserError(f"--results: no localization with ldp:epsilon={epsilon:g} or inf, words={domain} is there")
    return found, repeated


def _is_told(record: Mapping[str, Any], trials: int, condition: str) -> bool:
    """Whether it is of a query under that condition, with what serves the release best, and so many trials."""
    settings = record.get("task_settings") or {}
    return (
        record["task"] == "localization"
        and record["status"] == "ok"
        and record.get("condition") in (None, condition)
        and settings.get("matcher") == "auto"
        and settings.get("retrieval") == "raw"
        and settings.get("trials") == trials
    )


def report(rows: Sequence[Choice], epsilon: float, domain: int, recalls: dict[int, list[float]]) -> Iterator[Text | Table]:
    """The choices as people read them."""
    from rich.table import Table
    from rich.text import Text

    best = max(rows, key=lambda row: row.success).size
    table = Table(
        title=Text(f"Sets of m of {domain} words at ε = {epsilon:g}"),
        caption=Text(
            f"‡ RANSAC finds the pose most likely * tells most of its word: m = {most_informative_size(epsilon, domain)} "
            f"† tells most of how frequent words are: m = {most_accurate_size(epsilon, domain)}"
        ),
        title_justify="left",
        caption_justify="left",
    )
    columns = ["m", "Pr(true)", "bits told", "right matches", "wrong matches", "Pr(pose found)"]
    for column in [*columns, *(["measured"] if recalls else [])]:
        table.add_column(column, justify="right")
    marks = {most_accurate_size(epsilon, domain): " †", most_informative_size(epsilon, domain): " *"}
    for row in rows:
        mark = marks.get(row.size, "") + (" ‡" if row.size == best else "")
        cells = [f"{row.told:.4g}", f"{row.bits:.3g}", f"{row.right:.4g}", f"{row.wrong:.4g}", f"{row.success:.3f}"]
        shares = recalls.get(row.size)
        seen = [] if not recalls else [f"{np.mean(shares):.3f} of {len(shares)}" if shares else "n/a"]
        table.add_row(f"{row.size}{mark}", *cells, *seen)
    yield table
