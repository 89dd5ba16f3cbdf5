"""Choice of the subset size for a dictionary and an ε, by two criteria.

1. *Information*: the size of greatest mutual information of a set and its word (`bench.mechanisms.subset.mutual_information`).
2. *Localization*: the size for which RANSAC most likely finds the pose within its trials. The model:

   Of N keypoints, n have the same word as their point in one of the retrieved references. Each such word is released with the
   probability p of Eq. (5), so I ~ Binomial(n, p) matches are right. The references have R points. Each of the N m released words
   is also the word of R / |K| other points, so W = N m R / |K| matches are wrong. RANSAC draws T samples of s = 3 matches. The
   chance that one sample has only right matches, and yields the pose, is

       1 − (1 − C(I, s) / C(I + W, s))^T

   The inliers of a wrong pose are its own sample and Poisson(a W) other matches. Here a is the chance that a random point of the
   image is within RANSAC's threshold. The pose is selected if it has more inliers than each of T wrong poses. The probability is
   F(I − s − 1)^T, where F is Poisson's distribution function.

   p / m falls with m, so the fraction of right matches is greatest for m = 1, but the number of right matches may be too small.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bench.core.errors import UserError
from bench.core.exact import Exact
from bench.core.table import Table, build_table
from bench.mechanisms.subset import log10_chance, most_accurate_size, most_informative_size, mutual_information
from bench.types import Indices

Doubles = NDArray[np.float64]

SAMPLE = 3  # matches per sample of P3P
RECALL = "recall_0.25m_2deg"
EPSILON_TOLERANCE = 5e-4  # values of ε with a smaller difference, which agree to three digits, count as equal


@dataclass(frozen=True, kw_only=True)
class Workload:
    """Parameters of the localization model. The defaults are medians over the gallery's queries by day."""

    keypoints: int = 1000  # N, of a query
    repeatability: Sequence[float] = (0.27,)  # n / N of one query, or of several, over which success is averaged
    points: int = 5000  # R, in the retrieved references
    trials: int = 30_000  # T
    agreement: float = math.pi * 12**2 / (640 * 480)  # a: 12 pixels, in an image of that size


@dataclass(frozen=True)
class SizeEstimate:
    """Predictions for sets of one size."""

    size: int  # m
    inclusion: float  # p
    bits: float  # information of a set about its word
    right: float  # expected number of right matches of a query
    wrong: float
    success: float  # chance that RANSAC finds the pose


def estimate_sizes(epsilon: float, domain: int, sizes: Sequence[int], workload: Workload) -> list[SizeEstimate]:
    """Return predictions of information and localization for each size.

    Raises
    ------
    UserError
        if a number is out of range.
    """
    if not epsilon >= 0 or math.isinf(epsilon):
        raise UserError(f"--epsilon: must be at least 0 and finite, got {epsilon}")
    if domain < 2:
        raise UserError(f"--words: must be at least 2, got {domain}")
    if not sizes or not all(0 < size < domain for size in sizes):
        raise UserError(f"--sizes: must be at least 1 and less than the dictionary's {domain} words, got {list(sizes)}")
    if workload.keypoints < 1 or workload.points < 0 or workload.trials < 1:
        raise UserError("--keypoints and --trials must be at least 1, and --points at least 0")
    if not all(0 <= fraction <= 1 for fraction in (*workload.repeatability, workload.agreement)):
        raise UserError("--repeated (repeatability) and agreement must be from 0 to 1")
    bits = mutual_information(epsilon, domain, np.array(sizes)) / math.log(2)
    return [
        _estimate_size(epsilon, domain, size, float(information), workload) for size, information in zip(sizes, bits, strict=True)
    ]


def _estimate_size(epsilon: float, domain: int, size: int, bits: float, workload: Workload) -> SizeEstimate:
    inclusion = 10 ** log10_chance(epsilon, domain, size)
    wrong = workload.keypoints * size * workload.points / domain
    counts = np.rint(workload.keypoints * np.array(workload.repeatability)).astype(np.int64)
    chance = float(np.mean([estimate_success(int(n), inclusion, wrong, workload.trials, workload.agreement) for n in counts]))
    return SizeEstimate(size, inclusion, bits, float(counts.mean() * inclusion), wrong, chance)


def estimate_success(n: int, inclusion: float, wrong: float, trials: int, agreement: float) -> float:
    """Return the chance that RANSAC finds the pose, by the model at the top of this file. `wrong` is W."""
    right = np.arange(n + 1)
    return float(
        stats.binom.pmf(right, n, inclusion)
        @ (compute_sample_chance(right, wrong, trials) * compute_selection_chance(right, wrong, trials, agreement))
    )


def compute_sample_chance(right: Indices, wrong: float, trials: int) -> Doubles:
    """Return the chance that one sample has only right matches. (I,) -> (I,)"""
    steps = np.arange(SAMPLE)
    ratios = np.maximum(right[:, None] - steps, 0) / np.maximum(right[:, None] + wrong - steps, 1e-9)
    hit = np.where(right >= SAMPLE, ratios.clip(max=1).prod(axis=1), 0.0)
    with np.errstate(divide="ignore"):
        return -np.expm1(trials * np.log1p(-hit))


def compute_selection_chance(right: Indices, wrong: float, trials: int, agreement: float) -> Doubles:
    """Return the chance that the pose has more inliers than every wrong pose. (I,) -> (I,)"""
    return np.exp(trials * stats.poisson.logcdf(right - SAMPLE - 1, wrong * agreement))


def collect_recalls(
    records: Sequence[Mapping[str, Any]], epsilon: float, domain: int, trials: int, condition: str
) -> tuple[dict[int, list[float]], list[float]]:
    """Return localization results with `ldp`: size -> whether each query was localized, and n / N of each query.

    n / N is measured without a guarantee, with ε = ∞, m = 1 and the same dictionary: the number of inliers per keypoint.

    Raises
    ------
    UserError
        if there are no such results.
    """
    recalls: dict[int, list[float]] = {}
    repeatability = []
    for record in records:
        defense = record["defense"]
        if not _is_comparable(record, trials, condition) or defense["name"] != "ldp" or defense.get("words") != domain:
            continue
        value, metrics = _read_epsilon(defense.get("epsilon")), record["metrics"]
        if (
            math.isinf(value)
            and defense.get("subset_size") == 1
            and metrics.get("inliers") is not None
            and metrics.get("keypoints")
        ):
            repeatability.append(metrics["inliers"] / metrics["keypoints"])
        elif abs(value - epsilon) < EPSILON_TOLERANCE and metrics.get(RECALL) is not None:
            recalls.setdefault(defense.get("subset_size"), []).append(metrics[RECALL])
    if not recalls and not repeatability:
        raise UserError(f"--results: no localization with ldp:epsilon={epsilon:g} or inf, words={domain} found")
    return recalls, repeatability


def _read_epsilon(value: Any) -> float:
    """Return the ε of a record, which is a number, "inf" or a fraction as text; NaN for anything else."""
    try:
        return Exact(value)
    except (TypeError, ValueError):
        return math.nan


def _is_comparable(record: Mapping[str, Any], trials: int, condition: str) -> bool:
    """Return whether a record is of a query under that condition, with default matcher and retrieval and that many trials."""
    settings = record.get("task_settings") or {}
    return (
        record["task"] == "localization"
        and record["status"] == "ok"
        and record.get("condition") in (None, condition)
        and settings.get("matcher") == "auto"
        and settings.get("retrieval") == "raw"
        and settings.get("trials") == trials
    )


def report(rows: Sequence[SizeEstimate], epsilon: float, domain: int, recalls: dict[int, list[float]]) -> Table:
    """Return a table of the predictions."""
    best = max(rows, key=lambda row: row.success).size
    columns = ["m", "Pr(true)", "bits", "right matches", "wrong matches", "Pr(pose found)", *(["measured"] if recalls else [])]
    symbols = {most_accurate_size(epsilon, domain): " †", most_informative_size(epsilon, domain): " *"}
    texts = []
    for row in rows:
        symbol = symbols.get(row.size, "") + (" ‡" if row.size == best else "")
        numbers = [f"{row.inclusion:.4g}", f"{row.bits:.3g}", f"{row.right:.4g}", f"{row.wrong:.4g}", f"{row.success:.3f}"]
        values = recalls.get(row.size)
        measured = [] if not recalls else [f"{np.mean(values):.3f} of {len(values)}" if values else "n/a"]
        texts.append([f"{row.size}{symbol}", *numbers, *measured])
    remark = (
        f"‡ RANSAC finds the pose most likely * most information about its word: m = "
        f"{most_informative_size(epsilon, domain)} "
        f"† most accurate word frequencies: m = {most_accurate_size(epsilon, domain)}"
    )
    return build_table(columns, texts, heading=f"Sets of m of {domain} words at ε = {epsilon:g}", remarks=[remark])
