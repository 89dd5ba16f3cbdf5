"""Measures: label, better direction for the defender, and kind of average of each number in records."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bench.registry import discovery
from leaderboard.chance import IDENTIFICATION, IDENTIFIED, label_bits, label_identified, label_rank_1, name_bits, name_rank_1
from leaderboard.identification import measure_bits, measure_reciprocal, replace_ties
from leaderboard.intervals import Interval, interval, proportion
from leaderboard.tables import MEDIAN_METRICS, PAPER_METRICS

PRIVACY = "ssim"  # the measure of plots, and the first of `RANKING`
RANKING = (PRIVACY, IDENTIFIED)  # the measures that rank defenses
# The utility is the first of these with values: the recall of localization, otherwise that of matching (the matching score).
UTILITY = ("recall_0.25m_2deg", "recall")

PARTS = ("foreground", "background")  # parts of an image for which records have additional values of some metrics


@dataclass(frozen=True)
class Measure:
    """One number of a record."""

    name: str
    label: str
    better: int  # for the defender: 1 if larger is better, -1 if smaller, 0 if neither
    # A fraction is that of the samples that succeed. For a median, a sample without a value counts as the worst.
    # Bits are those of the ranks of all samples.
    kind: Literal["mean", "fraction", "median", "bits"] = "mean"
    explanation: str = ""
    is_fraction: bool = False  # of a sample's parts, such as its faces; Wilson's interval where all values are 0 or 1
    derived_from: str | None = None  # the metric in records; None: the measure's name
    convert: Callable[[float], float] = float  # from the value in records

    @property
    def metric(self) -> str:
        """The metric in records."""
        return self.derived_from or self.name


def list_measures(names: Iterable[str]) -> list[Measure]:
    """Return the measures of these metrics. The measure of a metric that is not installed has a name alone."""
    known = {measure.name: measure for measure in (*_TASK_MEASURES, *_list_plugin_measures())}
    for measure, part in itertools.product(list(known.values()), PARTS):
        name = f"{measure.name}_{part}"
        known[name] = dataclasses.replace(measure, name=name, label=f"{measure.label}, {part}", explanation="")
    return [known.get(name) or _parse_measure(name) for name in names]


def expand_measures(names: Iterable[str]) -> list[Measure]:
    """Return the measures of these metrics. A metric of identification has three: the mean reciprocal rank, rank 1, and bits."""
    return [part for measure in list_measures(names) for part in _expand(measure)]


def _expand(measure: Measure) -> list[Measure]:
    metric = measure.name
    if metric not in IDENTIFICATION:
        return [measure]
    return [
        measure,
        Measure(name_rank_1(metric), label_rank_1(metric), -1, is_fraction=True, derived_from=metric, convert=_is_first),
        Measure(name_bits(metric), label_bits(metric), -1, "bits", derived_from=metric),
    ]


def _is_first(reciprocal: float) -> float:
    return float(reciprocal == 1)


def summarize_bits(values: Sequence[tuple[float, ...]]) -> Interval | None:
    """Return the bits of the reciprocal ranks of each sample, one per seed; None if no sample has a value."""
    return _summarize_bits(tuple(values))


@functools.lru_cache(maxsize=1 << 10)
def _summarize_bits(values: tuple[tuple[float, ...], ...]) -> Interval | None:
    return measure_bits(values) if values else None


def summarize(measure: Measure, values: Sequence[float | None]) -> Interval | None:
    """Return the average of a measure over samples; None if no sample has a value.

    `values` has one value per sample, None for a sample without one. A median has no interval, so its ends are infinite.
    """
    return _summarize(measure, tuple(values))


@functools.lru_cache(maxsize=1 << 14)  # tables, ranks and plots need the same averages
def _summarize(measure: Measure, values: tuple[float | None, ...]) -> Interval | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    if measure.kind == "median":
        middle = float(np.median([math.inf if value is None else value for value in values]))
        return Interval(middle, -math.inf, math.inf, len(values))
    if measure.name in IDENTIFICATION:
        return measure_reciprocal(known)
    if (measure.kind == "fraction" or measure.is_fraction) and set(known) <= {0.0, 1.0}:
        return proportion(known)
    return interval(known)  # also for a fraction, once each sample has its mean over several seeds


_TASK_MEASURES = (
    *(
        Measure(name, name.replace("_", " "), -1, "median", f"median over queries, in {unit}; ∞ if not localized")
        for name, unit in zip(MEDIAN_METRICS, ("scene units", "degrees"), strict=True)
    ),
    Measure("precision", "precision", 1, "mean", "fraction of matches that are right"),
    Measure("recall", "recall", 1, "mean", "fraction of the right matches that are found"),
    Measure("registered", "registered images", 1, "mean", "images of the scene that structure from motion registers"),
    Measure("right_poses", "right poses", 1, "mean", "registered images within 5% of the scene's extent and 5° of the truth"),
    Measure("points", "sparse points", 1, "mean", "points of the map"),
    Measure("track_length", "track length", 1, "mean", "images that see a point of the map"),
    Measure("reprojection_error", "reprojection error", -1, "mean", "in pixels"),
)


def _list_plugin_measures() -> Iterator[Measure]:
    for plugin in discovery.load_plugins(discovery.METRIC):
        name = plugin.name()
        better = -1 if plugin.higher_is_better_for == "attacker" else 1
        if name in IDENTIFICATION:
            yield Measure(name, label_identified(name), better, convert=_replace_tie)
        else:
            label = name.upper() if name in PAPER_METRICS else name
            yield Measure(name, label, better, "mean", plugin.description(), is_fraction=plugin.unit == "fraction")


def _replace_tie(value: float) -> float:
    return float(replace_ties([value])[0])


def _parse_measure(name: str) -> Measure:
    """Return the measure of a metric whose name states a threshold."""
    if match := re.fullmatch(r"recall_([\d.]+)m_([\d.]+)deg", name):
        metres, degrees = match.groups()
        explanation = f"fraction of queries localized within {metres} m and {degrees}°, with Wilson's interval"
        return Measure(name, f"recall ({metres} m, {degrees}°)", 1, "fraction", explanation)
    if match := re.fullmatch(r"accuracy_([\d.]+)px", name):
        return Measure(name, f"accuracy ({match[1]} px)", 1, "mean", f"matching accuracy at {match[1]} pixels")
    return Measure(name, name, 0)
