"""What the numbers of records are: their names for people, which way is better for whoever defends, and how they are averaged."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bench.registry import discovery
from leaderboard.intervals import Interval, interval, proportion
from leaderboard.tables import MEDIANS, PAPER

PRIVACY = "ssim"  # what attacks are compared by: how much of the photograph comes back
# What a server can do, the first of these that was measured: its recall of localization, or else how well it matches.
UTILITY = ("recall_0.25m_2deg", "accuracy_3px")

PARTS = ("foreground", "background")  # of an image, over which some metrics are told as well


@dataclass(frozen=True)
class Measure:
    """One number of a record."""

    name: str
    label: str
    better: int  # 1: the defender likes more of it, -1: less, 0: neither
    # Shares are of units that did or did not succeed. Medians count a unit without a value as the worst.
    kind: Literal["mean", "share", "median"] = "mean"
    explanation: str = ""


def measures(names: Iterable[str]) -> list[Measure]:
    """What is known of these metrics; of one that is not installed here, nothing but its name."""
    known = {measure.name: measure for measure in (*_OF_TASKS, *_of_plugins())}
    for measure, part in itertools.product(list(known.values()), PARTS):
        name = f"{measure.name}_{part}"
        known[name] = dataclasses.replace(measure, name=name, label=f"{measure.label}, {part}", explanation="")
    return [known.get(name) or _family(name) for name in names]


def summary(of: Measure, values: Sequence[float | None]) -> Interval | None:
    """Averages the values of one measure, one a unit and None where there is none; None if there is nothing to average.

    A median has no interval: its ends are infinite.
    """
    return _summary(of, tuple(values))


@functools.lru_cache(maxsize=1 << 14)  # tables, ranks and plots ask for the same ones
def _summary(of: Measure, values: tuple[float | None, ...]) -> Interval | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    if of.kind == "median":
        middle = float(np.median([math.inf if value is None else value for value in values]))
        return Interval(middle, -math.inf, math.inf, len(values))
    if of.kind == "share" and set(known) <= {0.0, 1.0}:
        return proportion(known)
    return interval(known)  # of a share, too, once each unit has its mean over several seeds


_OF_TASKS = (
    *(
        Measure(name, name.replace("_", " "), -1, "median", f"median over queries, in {unit}; ∞ if not localized")
        for name, unit in zip(MEDIANS, ("scene units", "degrees"), strict=True)
    ),
    Measure("precision", "precision", 1, "mean", "share of matches that are right"),
    Measure("recall", "recall", 1, "mean", "share of right matches that are found"),
    Measure("registered", "registered images", 1, "mean", "images of the scene that structure from motion could place"),
    Measure("right_poses", "right poses", 1, "mean", "registered images within 5% of the place's extent and 5° of the truth"),
    Measure("points", "sparse points", 1, "mean", "points of the map"),
    Measure("track_length", "track length", 1, "mean", "images that see a point of the map"),
    Measure("reprojection_error", "reprojection error", -1, "mean", "in pixels"),
)


def _of_plugins() -> Iterator[Measure]:
    for plugin in discovery.everything(discovery.METRIC):
        name = plugin.name()
        better = -1 if plugin.higher_is_better_for == "attacker" else 1
        yield Measure(name, name.upper() if name in PAPER else name, better, "mean", plugin.description())


def _family(name: str) -> Measure:
    """A metric whose name tells a threshold."""
    if found := re.fullmatch(r"recall_([\d.]+)m_([\d.]+)deg", name):
        metres, degrees = found.groups()
        told = f"share of queries localized within {metres} m and {degrees}°, with Wilson's interval"
        return Measure(name, f"recall ({metres} m, {degrees}°)", 1, "share", told)
    if found := re.fullmatch(r"accuracy_([\d.]+)px", name):
        return Measure(name, f"accuracy ({found[1]} px)", 1, "mean", f"matching accuracy at {found[1]} pixels")
    return Measure(name, name, 0)
