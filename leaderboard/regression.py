"""Results against a baseline, cell by cell: what got better, what got worse, and what is no longer there.

Cells belong together if their configurations and inputs are equal but for the seed. Units, such as photographs, are paired, and a
unit counts with its mean over the seeds. A mean difference over the units is told from chance by a tolerance,

    max(floor, t · s · sqrt(Σ_u (1/n_u + 1/n'_u)) / U)

where s² is the variance from seed to seed within units, pooled over the units of both sides, n_u and n'_u are the seeds that a
unit has on either side, U counts the units, and t is the quantile of Student's distribution, for s's degrees of freedom, that
chance passes once in a thousand comparisons. Of one seed a side there is no such spread; then it is the bootstrap over the units
of the paired differences, at the same level. The floor is what a number may move between machines and versions of libraries.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from bench.core.hashing import canonical_json
from bench.runner.records import Record
from leaderboard.intervals import interval
from leaderboard.measures import list_measures
from leaderboard.tables import build_labels

Verdict = Literal["worse", "weaker", "missing", "better", "new", "same"]  # the gravest first
CONFIDENCE = 0.999
# Eight times what bf16 in the place of float32 made of the shipped networks: 0.12% at most, of means over seven photographs.
RELATIVE_TOLERANCE = 0.01  # of the baseline's mean
ABSOLUTE_TOLERANCE = 0.001  # in the metric's unit
GUARANTEE = "epsilon_descriptor"

SampleValues = Mapping[str, Sequence[float]]  # unit -> its values, one a seed


@dataclass(frozen=True, kw_only=True)
class RegressionResult:
    """One metric of one cell, or the whole cell where `metric` is empty."""

    verdict: Verdict
    defense: str  # labels
    attack: str
    metric: str = ""
    before: float = math.nan  # means over the units that both have
    after: float = math.nan
    compute_tolerance: float = math.nan
    note: str = ""  # what a reader should know of it


def compare(baseline: Iterable[Record], results: Iterable[Record]) -> list[RegressionResult]:
    """Every metric that has a better and a worse, of every cell that either side has, the gravest findings first.

    An attacker who recovers less of the same defense, its source being what it was, is a `weaker` attack: no defense gets better
    by that. Where records do not tell the source, it is taken to be the same.
    """
    before, after = _group_experiments(baseline), _group_experiments(results)
    heads = [(cells[0]["defense"], cells[0]["attack"]) for cells in {**after, **before}.values()]
    names = dict(zip({**after, **before}, build_labels(heads), strict=True))
    found: list[RegressionResult] = []
    for key, (defense, attack) in names.items():
        finding = functools.partial(RegressionResult, defense=defense, attack=attack)
        if key not in after:
            found.append(finding(verdict="missing", note="no results for this cell of the baseline"))
        elif key not in before:
            found.append(finding(verdict="new", note="the baseline does not have this cell"))
        else:
            found += _compare_experiment(before[key], after[key], finding)
    order = Verdict.__args__  # type: ignore[attr-defined]
    return sorted(found, key=lambda one: order.index(one.verdict))


def compute_tolerance(before: SampleValues, after: SampleValues, floor: float) -> float:
    """How far the means of two sides may be apart, by the rule at the top of this file. Both have the same units, at least one.

    One unit under one seed has no spread to be seen; there the floor alone decides.
    """
    sides = [[np.asarray(side[unit], np.float64) for unit in before] for side in (before, after)]
    samples = [sample for side in sides for sample in side]
    freedom = sum(len(sample) - 1 for sample in samples)
    if freedom > 0:
        variance = sum(float(np.square(sample - sample.mean()).sum()) for sample in samples) / freedom
        error = math.sqrt(variance * sum(1 / len(sample) for sample in samples)) / len(before)
        return max(floor, float(stats.t.ppf((1 + CONFIDENCE) / 2, freedom)) * error)
    differences = [float(new[0] - old[0]) for old, new in zip(*sides, strict=True)]
    if len(differences) == 1:
        return floor
    likely = interval(differences, CONFIDENCE)
    return max(floor, likely.high - likely.mean, likely.mean - likely.low)


def _group_experiments(records: Iterable[Record]) -> dict[str, list[Record]]:
    """The latest record of each unit and seed, by what all of a cell share but the seed."""
    latest = {(record["experiment_id"], record["sample"]): record for record in records}
    cells: dict[str, list[Record]] = {}
    for record in latest.values():
        cells.setdefault(_experiment_key(record), []).append(record)
    return cells


def _experiment_key(record: Record) -> str:
    """What `cell_id` hashes, without the seed; and without the metrics' settings, so that one more metric makes no other cell."""
    dataset = {name: value for name, value in record["dataset"].items() if name not in ("name", "spec")}
    parts = ("schema", "task", "task_settings", "defense", "attack")
    return canonical_json([dataset, *(record.get(part) for part in parts)])


def _compare_experiment(before: list[Record], after: list[Record], finding: functools.partial[RegressionResult]) -> Iterator[RegressionResult]:
    had, have = _group_completed(before), _group_completed(after)
    lost = sorted(had.keys() - have.keys())
    if lost:
        reasons = {record["sample"]: record["reason"] for record in after if record["status"] != "ok"}
        told = f"{len(lost)} of {len(had)} units: {lost[0]}" + (f": {reason}" if (reason := reasons.get(lost[0])) else "")
        yield finding(verdict="missing", note=told)
    shared = [unit for unit in had if unit in have]
    if not shared:
        return
    attacked = before[0]["attack"] is not None
    changed = [part for part in ("defense", "attack") if _get_source(before, part) != _get_source(after, part)]
    for metric in list_measures(sorted({name for unit in shared for record in had[unit] for name in record["metrics"]})):
        old, new = (_collect_values(side, shared, metric.name) for side in (had, have))
        units = [unit for unit in old if unit in new]
        if metric.better == 0 or not units:
            continue
        if _get_settings(before, metric.name) != _get_settings(after, metric.name):
            yield finding(verdict="missing", metric=metric.name, note="it is measured with other settings")
            continue
        old, new = ({unit: side[unit] for unit in units} for side in (old, new))
        first, second = _mean(old), _mean(new)
        allowed = compute_tolerance(old, new, ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(first))
        verdict = _judge(metric.better * (second - first), allowed, attacked, changed)
        told = _explain(verdict, attacked, changed)
        yield finding(verdict=verdict, metric=metric.name, before=first, after=second, tolerance=allowed, note=told)
    yield from _compare_guarantee(had, have, shared, finding)


def _compare_guarantee(
    had: Mapping[str, list[Record]], have: Mapping[str, list[Record]], shared: Sequence[str], finding: functools.partial[RegressionResult]
) -> Iterator[RegressionResult]:
    """What is promised of a descriptor: it has no spread, and no tolerance."""
    old, new = (side[shared[0]][0]["privacy"] for side in (had, have))
    first, second = (math.inf if side[GUARANTEE] is None else float(side[GUARANTEE]) for side in (old, new))
    if first == second and old["guarantee"] == new["guarantee"]:
        return
    verdict: Verdict = "better" if second < first else "worse"
    told = f"the guarantee was {old['guarantee']}, and is {new['guarantee']}"
    yield finding(verdict=verdict, metric=GUARANTEE, before=first, after=second, tolerance=0.0, note=told)


def _group_completed(records: Iterable[Record]) -> dict[str, list[Record]]:
    done: dict[str, list[Record]] = {}
    for record in records:
        if record["status"] == "ok":
            done.setdefault(record["sample"], []).append(record)
    return done


def _collect_values(side: Mapping[str, list[Record]], units: Iterable[str], metric: str) -> dict[str, list[float]]:
    """The known values of each unit that has any."""
    found = {unit: [value for record in side[unit] if (value := record["metrics"].get(metric)) is not None] for unit in units}
    return {unit: values for unit, values in found.items() if values}


def _mean(side: SampleValues) -> float:
    return float(np.mean([np.mean(values) for values in side.values()]))


def _get_source(records: Sequence[Record], part: str) -> Any:
    return (records[-1].get("sources") or {}).get(part)


def _get_settings(records: Sequence[Record], metric: str) -> Any:
    return (records[-1].get("metric_settings") or {}).get(metric)


def _judge(gain: float, allowed: float, attacked: bool, changed: Sequence[str]) -> Verdict:
    """`gain` is in the defender's favour."""
    if abs(gain) <= allowed:
        return "same"
    if gain < 0:
        return "worse"
    return "weaker" if attacked and "defense" not in changed else "better"


def _explain(verdict: Verdict, attacked: bool, changed: Sequence[str]) -> str:
    if verdict == "weaker":
        return "the attacker recovers less of a defense whose source is what it was"
    if verdict == "worse" and attacked:
        blamed = " and ".join(changed)
        return f"the attacker recovers more; the source of the {blamed} is another" if blamed else "the attacker recovers more"
    return "a server can do less" if verdict == "worse" else ""
