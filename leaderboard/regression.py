"""Regression check: results against a baseline, one experiment at a time.

Experiments match if their configurations and inputs are equal except for the seed. Samples such as photographs are paired,
and each sample counts with its mean over the seeds. A mean difference over the samples is significant if it exceeds the
tolerance

    max(minimum, t · s · sqrt(Σ_u (1/n_u + 1/n'_u)) / U)

where s² is the variance between seeds within samples, pooled over the samples of both sides. n_u and n'_u are the numbers of
seeds of sample u on either side, and U is the number of samples. t is a quantile of Student's distribution with the degrees
of freedom of s: chance exceeds it in one of a thousand comparisons. With one seed on each side there is no such variance. The
tolerance is then Student's interval of the mean of the paired differences over samples, at the same level. The minimum covers
differences between machines and between versions of libraries.
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

Verdict = Literal["worse", "weaker", "missing", "better", "new", "same"]  # the most severe first
CONFIDENCE = 0.999
# Eight times the effect of bf16 instead of float32 on the shipped networks: 0.12% at most, of means over seven photographs.
RELATIVE_TOLERANCE = 0.01  # of the baseline's mean
ABSOLUTE_TOLERANCE = 0.001  # in the metric's unit
GUARANTEE = "epsilon_descriptor"

SampleValues = Mapping[str, Sequence[float]]  # sample -> its values, one per seed
SampleRecords = Mapping[str, list[Record]]  # sample -> its completed records


@dataclass(frozen=True, kw_only=True)
class RegressionResult:
    """The comparison of one metric of an experiment, or of the whole experiment where `metric` is empty."""

    verdict: Verdict
    defense: str  # labels
    attack: str
    metric: str = ""
    before: float = math.nan  # means over the samples that both sides have
    after: float = math.nan
    tolerance: float = math.nan
    note: str = ""


def compare(baseline: Iterable[Record], results: Iterable[Record]) -> list[RegressionResult]:
    """Compare each metric with a better direction, of all experiments of both sides. Returns the most severe results first.

    The verdict is `weaker` if an attack recovers less from a defense with unchanged source: then the attack got worse, and
    not the defense better. A source that the records lack counts as unchanged.
    """
    before, after = _group_experiments(baseline), _group_experiments(results)
    experiments = {**after, **before}
    labels = build_labels([(records[0]["defense"], records[0]["attack"]) for records in experiments.values()])
    comparisons: list[RegressionResult] = []
    for key, (defense, attack) in zip(experiments, labels, strict=True):
        build = functools.partial(RegressionResult, defense=defense, attack=attack)
        if key not in after:
            comparisons.append(build(verdict="missing", note="no results for this experiment of the baseline"))
        elif key not in before:
            comparisons.append(build(verdict="new", note="the baseline does not have this experiment"))
        else:
            comparisons += _compare_experiment(before[key], after[key], build)
    order = Verdict.__args__  # type: ignore[attr-defined]
    return sorted(comparisons, key=lambda result: order.index(result.verdict))


def compute_tolerance(before: SampleValues, after: SampleValues, minimum: float) -> float:
    """Return the tolerance of the difference between two means, by the rule at the top of this file.

    Both sides have the same samples, at least one. For one sample with one seed, which has no variance, it is the minimum.
    """
    sides = [[np.asarray(side[sample], np.float64) for sample in before] for side in (before, after)]
    values = [sample for side in sides for sample in side]
    freedom = sum(len(sample) - 1 for sample in values)
    if freedom > 0:
        variance = sum(float(np.square(sample - sample.mean()).sum()) for sample in values) / freedom
        error = math.sqrt(variance * sum(1 / len(sample) for sample in values)) / len(before)
        return max(minimum, float(stats.t.ppf((1 + CONFIDENCE) / 2, freedom)) * error)
    differences = [float(new[0] - old[0]) for old, new in zip(*sides, strict=True)]
    if len(differences) == 1:
        return minimum
    likely = interval(differences, CONFIDENCE)
    return max(minimum, likely.high - likely.mean, likely.mean - likely.low)


def _group_experiments(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Return the latest record of each sample and seed, grouped by experiment regardless of the seed."""
    latest = {(record["experiment_id"], record["sample"]): record for record in records}
    experiments: dict[str, list[Record]] = {}
    for record in latest.values():
        experiments.setdefault(_experiment_key(record), []).append(record)
    return experiments


def _experiment_key(record: Record) -> str:
    """Return the content that `experiment_id` hashes, without seed and metric settings: a new metric does not change it."""
    dataset = {name: value for name, value in record["dataset"].items() if name not in ("name", "spec")}
    parts = ("schema", "task", "task_settings", "defense", "attack")
    return canonical_json([dataset, *(record.get(part) for part in parts)])


def _compare_experiment(
    before: list[Record], after: list[Record], build: functools.partial[RegressionResult]
) -> Iterator[RegressionResult]:
    old, new = _group_completed(before), _group_completed(after)
    lost = sorted(old.keys() - new.keys())
    if lost:
        reasons = {record["sample"]: record["reason"] for record in after if record["status"] != "ok"}
        reason = f": {reasons[lost[0]]}" if reasons.get(lost[0]) else ""
        yield build(verdict="missing", note=f"{len(lost)} of {len(old)} samples: {lost[0]}{reason}")
    shared = [sample for sample in old if sample in new]
    if not shared:
        return
    has_attack = before[0]["attack"] is not None
    changed = [part for part in ("defense", "attack") if _get_source(before, part) != _get_source(after, part)]
    names = sorted({name for sample in shared for record in old[sample] for name in record["metrics"]})
    for metric in list_measures(names):
        old_values, new_values = (_collect_values(side, shared, metric.name) for side in (old, new))
        samples = [sample for sample in old_values if sample in new_values]
        if metric.better == 0 or not samples:
            continue
        if _get_settings(before, metric.name) != _get_settings(after, metric.name):
            yield build(verdict="missing", metric=metric.name, note="measured with other settings")
            continue
        old_values, new_values = ({sample: side[sample] for sample in samples} for side in (old_values, new_values))
        first, second = _mean(old_values), _mean(new_values)
        tolerance = compute_tolerance(old_values, new_values, ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(first))
        verdict = _judge(metric.better * (second - first), tolerance, has_attack, changed)
        note = _explain(verdict, has_attack, changed)
        yield build(verdict=verdict, metric=metric.name, before=first, after=second, tolerance=tolerance, note=note)
    yield from _compare_guarantee(old, new, shared[0], build)


def _compare_guarantee(
    before: SampleRecords, after: SampleRecords, sample: str, build: functools.partial[RegressionResult]
) -> Iterator[RegressionResult]:
    """Compare the guarantee of a descriptor, which has no variance and no tolerance."""
    old, new = (side[sample][0]["privacy"] for side in (before, after))
    first, second = (math.inf if side[GUARANTEE] is None else float(side[GUARANTEE]) for side in (old, new))
    if first == second and old["guarantee"] == new["guarantee"]:
        return
    verdict: Verdict = "better" if second < first else "worse"
    note = f"the guarantee was {old['guarantee']}, and is {new['guarantee']}"
    yield build(verdict=verdict, metric=GUARANTEE, before=first, after=second, tolerance=0.0, note=note)


def _group_completed(records: Iterable[Record]) -> dict[str, list[Record]]:
    completed: dict[str, list[Record]] = {}
    for record in records:
        if record["status"] == "ok":
            completed.setdefault(record["sample"], []).append(record)
    return completed


def _collect_values(records: SampleRecords, samples: Iterable[str], metric: str) -> dict[str, list[float]]:
    """Return the values of a metric for each sample that has any."""
    values = {
        sample: [value for record in records[sample] if (value := record["metrics"].get(metric)) is not None]
        for sample in samples
    }
    return {sample: known for sample, known in values.items() if known}


def _mean(values: SampleValues) -> float:
    return float(np.mean([np.mean(of_sample) for of_sample in values.values()]))


def _get_source(records: Sequence[Record], part: str) -> Any:
    return (records[-1].get("sources") or {}).get(part)


def _get_settings(records: Sequence[Record], metric: str) -> Any:
    return (records[-1].get("metric_settings") or {}).get(metric)


def _judge(gain: float, tolerance: float, has_attack: bool, changed: Sequence[str]) -> Verdict:
    """Return the verdict on a change. A positive `gain` favours the defender."""
    if abs(gain) <= tolerance:
        return "same"
    if gain < 0:
        return "worse"
    return "weaker" if has_attack and "defense" not in changed else "better"


def _explain(verdict: Verdict, has_attack: bool, changed: Sequence[str]) -> str:
    if verdict == "weaker":
        return "the attacker recovers less from a defense with unchanged source"
    if verdict == "worse" and has_attack:
        parts = " and ".join(changed)
        return f"the attacker recovers more; the source of the {parts} changed" if parts else "the attacker recovers more"
    return "the server can do less" if verdict == "worse" else ""
