"""Flags for attacks that failed: their scores say little about the defense.

- **At baseline**: the attack has no signal (`leaderboard.signal`).
- **Not converged**: a note of the attack says that it reached its budget first (`bench.api.NOT_CONVERGED`).
- **Weaker with more knowledge**: an attack scores significantly lower than one that knows less. An attacker who knows more could
  run the other attack. One attack knows less than another if its `needs` are a part of the other's, or if they are equal and it
  observes less. `PublicAssets` does not count, as everybody has public photographs. `blank` observes less than `keypoints`, and
  `keypoints` less than the others.
- **Not monotone in ε**: an attack scores significantly lower at a larger ε of the same defense, where the release says more.

The first two concern an attack by all metrics. The last two compare the values of `METRICS` by Student's t on differences that
are paired by sample, one-sided, with Holm's correction over all comparisons of the flag in a comparison group.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

from bench.api import NOT_CONVERGED, Attack
from bench.core.errors import UserError
from bench.core.hashing import canonical_json
from bench.registry import discovery
from bench.threat_model import Knowledge, PublicAssets
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import MIN_SAMPLES, Estimate, correct_holm, estimate_mean
from leaderboard.signal import BASELINES, METRICS, SIGNIFICANCE, SampleValues, collect_values
from leaderboard.worst_case import SuiteResult

WEAKER = "weaker with more knowledge"
NOT_MONOTONE = "not monotone in ε"


@dataclass(frozen=True, kw_only=True, eq=False)
class Flag:
    """An attack that failed."""

    experiment: GroupedExperiment
    metric: str | None  # None: by all metrics
    text: str


@dataclass(frozen=True, kw_only=True, eq=False)
class _Comparison:
    """Two experiments of which the first is expected to score at least as high."""

    experiment: GroupedExperiment
    other: GroupedExperiment
    metric: str
    difference: Estimate  # of the first minus the second


def flag_attacks(group: ComparisonGroup, results: Sequence[SuiteResult]) -> list[Flag]:
    """Return the flags of all attacks in the results of one suite."""
    values = {
        one: collect_values([record for sample in group.complete_samples(one) for record in sample])
        for result in results
        for one in result.applicable
    }
    return [
        *(
            Flag(experiment=one, metric=None, text=f"at baseline: {one.attack}")
            for one in values
            if (signal := group.signals.get(one)) and signal.is_absent
        ),
        *_flag_not_converged(values),
        *_flag_weaker(results, values),
        *_flag_not_monotone(results, values),
    ]


def _flag_not_converged(experiments: Iterable[GroupedExperiment]) -> Iterator[Flag]:
    for one in experiments:
        count = sum(any(note.startswith(NOT_CONVERGED) for note in record["notes"]) for record in one.completed)
        if count:
            text = f"{NOT_CONVERGED}: {one.attack} in {count} of {len(one.completed)} samples"
            yield Flag(experiment=one, metric=None, text=text)


def knows_less(one: type[Attack], other: type[Attack]) -> bool:
    """Return whether an attack has a part of the knowledge and of the observations of another, and not all of both."""
    (needs, observed), (more, others) = ((_list_knowledge(attack), _rank_observations(attack)) for attack in (one, other))
    return needs <= more and observed <= others and (needs, observed) != (more, others)


def _list_knowledge(attack: type[Attack]) -> frozenset[type[Knowledge]]:
    return frozenset(attack.needs) - {PublicAssets}


def _rank_observations(attack: type[Attack]) -> int:
    """Return 0 for the attack without observations, 1 for positions alone, 2 for releases."""
    return BASELINES.index(attack.name()) if attack.name() in BASELINES else len(BASELINES)


def _flag_weaker(results: Sequence[SuiteResult], values: Mapping[GroupedExperiment, SampleValues]) -> Iterator[Flag]:
    comparisons = [
        comparison
        for result in results
        for one, other in permutations(result.applicable, 2)
        if _knows_more(one, other)
        for comparison in _compare(one, other, values)
    ]
    for lower in _select_lower(comparisons):
        text = f"{WEAKER}: {lower.experiment.attack} than {lower.other.attack}"
        yield Flag(experiment=lower.experiment, metric=lower.metric, text=text)


def _knows_more(one: GroupedExperiment, other: GroupedExperiment) -> bool:
    attack, less = (_find_attack(each.metadata["attack"]["name"]) for each in (one, other))
    return attack is not None and less is not None and knows_less(less, attack)


@functools.cache
def _find_attack(name: str) -> type[Attack] | None:
    """Return the attack of that name, or None if it is not installed."""
    try:
        return discovery.load_plugin(discovery.ATTACK, name)
    except UserError:
        return None


def _flag_not_monotone(results: Sequence[SuiteResult], values: Mapping[GroupedExperiment, SampleValues]) -> Iterator[Flag]:
    """Yield one flag for each attack and metric of an ε, with the smaller ε of the greatest score."""
    series: dict[str, list[GroupedExperiment]] = {}
    for result in results:
        for text, experiments in result.experiments.items():
            for one in experiments:
                if one.reason is None and not math.isnan(get_epsilon(one)):
                    key = canonical_json([text, _omit_epsilon(one.metadata["defense"])])
                    series.setdefault(key, []).append(one)
    comparisons = [
        comparison
        for experiments in series.values()
        for one, other in permutations(experiments, 2)
        if get_epsilon(one) > get_epsilon(other)
        for comparison in _compare(one, other, values)
    ]
    for lower in _select_lower(comparisons):
        larger, smaller = get_epsilon(lower.experiment), get_epsilon(lower.other)
        text = f"{NOT_MONOTONE}: {lower.experiment.attack} scores lower at {larger:g} than at {smaller:g}"
        yield Flag(experiment=lower.experiment, metric=lower.metric, text=text)


def get_epsilon(experiment: GroupedExperiment) -> float:
    """Return the ε of a descriptor; NaN if the defense has none."""
    value = experiment.metadata["privacy"]["epsilon_descriptor"]
    return math.nan if value is None else float(value)


def _omit_epsilon(defense: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration of a defense without ε, also of a composed one."""
    parts = {"parts": [_omit_epsilon(part) for part in defense["parts"]]} if "parts" in defense else {}
    return {name: value for name, value in defense.items() if name != "epsilon"} | parts


def _compare(
    one: GroupedExperiment, other: GroupedExperiment, values: Mapping[GroupedExperiment, SampleValues]
) -> Iterator[_Comparison]:
    """Yield the comparison of each metric with enough samples that both have."""
    for metric in METRICS:
        scores, others = values[one][metric], values[other][metric]
        differences = [score - others[sample] for sample, score in scores.items() if sample in others]
        if len(differences) >= MIN_SAMPLES:
            yield _Comparison(experiment=one, other=other, metric=metric, difference=estimate_mean(differences))


def _select_lower(comparisons: Sequence[_Comparison]) -> Iterable[_Comparison]:
    """Return the comparisons whose first experiment scores significantly lower.

    Of several with the same first experiment and metric, only the one with the greatest difference is returned.
    """
    p_values = correct_holm([one.difference.p_below(0.0) for one in comparisons])
    lower = [one for one, p_value in zip(comparisons, p_values, strict=True) if p_value < SIGNIFICANCE]
    greatest: dict[tuple[GroupedExperiment, str], _Comparison] = {}
    for one in sorted(lower, key=lambda one: one.difference.mean):
        greatest.setdefault((one.experiment, one.metric), one)
    return greatest.values()
