"""Worst case of a defense over the attacks of a versioned suite, and whether the defense has the results of that version.

A defense has the results of a version if each attack of the suite was run with exactly its settings, files aside, on all samples
of the comparison group, or does not apply. An attack that lacks a network for the defense or for the features is missing: it
applies, and nobody trained it. All other attacks of the records are left out.

The worst case of a measure is the greatest leakage by the mean of an attack, baselines included, oracles excluded. It is chosen
from several attacks, and its interval is that of the one attack, without a correction for the choice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from bench.core.hashing import canonical_json
from bench.runner import attack_suite
from bench.runner.attack_suite import AttackSuite
from bench.runner.records import Record
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import Interval
from leaderboard.measures import Measure
from leaderboard.signal import BASELINES, get_attack, is_oracle

UNTRAINED = ("no adapted attacker", "trained for ")  # in the reason of an attack that lacks a network
INVERSION = "inversion"  # entry of a record's attack: the network that inverts its result; None if there is none


@dataclass(frozen=True, kw_only=True, eq=False)
class WorstCase:
    """The greatest leakage of one measure."""

    measure: Measure
    score: Interval
    experiment: GroupedExperiment  # the attack that reached it
    baselines: Mapping[str, Interval]  # baseline -> its score
    oracle: Interval | None  # the greatest leakage of a reference
    reference: GroupedExperiment | None  # the oracle that reached it

    @property
    def is_bracketed(self) -> bool:
        """Whether an oracle leaks more than the attack. An oracle that leaks less is no ceiling."""
        return self.oracle is not None and self.measure.better * (self.score.mean - self.oracle.mean) > 0


@dataclass(frozen=True, kw_only=True, eq=False)
class SuiteResult:
    """The results of one defense under one suite of attacks."""

    suite: str
    defense: str  # label
    experiments: Mapping[
        str, tuple[GroupedExperiment, ...]
    ]  # attack of the suite -> its experiments, also those that do not apply
    missing: tuple[str, ...]  # attacks without results, with the reason
    worst_cases: tuple[WorstCase, ...]  # per measure

    @property
    def metadata(self) -> Record:
        """A record, for the fields that are equal in all records of the defense."""
        return next(one.metadata for each in self.experiments.values() for one in each)

    @property
    def version(self) -> str | None:
        """The suite, with its version, if the defense has all its results."""
        return None if self.missing else self.suite

    @property
    def is_complete_run(self) -> bool:
        """Whether there are records of every attack, whatever they show."""
        return all(self.experiments.values())

    @property
    def applicable(self) -> list[GroupedExperiment]:
        """The experiments that apply."""
        return [one for each in self.experiments.values() for one in each if one.reason is None]


def list_results(group: ComparisonGroup) -> list[SuiteResult]:
    """Return the results of each defense under all suites that it has the results of; if there are none, under the latest suite.

    Defenses without a record of an attack of the latest suite are left out then.
    """
    suites = [attack_suite.find(name) for name in attack_suite.list_attack_suites()]
    by_defense: dict[str, list[GroupedExperiment]] = {}
    for experiment in group.experiments:
        if experiment.metadata["attack"] is not None:
            by_defense.setdefault(canonical_json(experiment.metadata["defense"]), []).append(experiment)
    chosen: list[SuiteResult] = []
    for experiments in by_defense.values():
        results = [build_result(group, suite, experiments) for suite in suites]
        chosen += [one for one in results if one.version] or [one for one in results[-1:] if any(one.experiments.values())]
    return chosen


def build_result(group: ComparisonGroup, suite: AttackSuite, experiments: Sequence[GroupedExperiment]) -> SuiteResult:
    """Return the results of a defense, whose experiments are given, under a suite."""
    by_attack: dict[str, list[GroupedExperiment]] = {text: [] for text in suite.specs}
    for experiment in experiments:
        if text := suite.find_spec(experiment.metadata["attack"]):
            by_attack[text].append(experiment)
    missing = {text: _explain_missing(group, each) for text, each in by_attack.items()}
    return SuiteResult(
        suite=suite.name,
        defense=experiments[0].defense,
        experiments={text: tuple(each) for text, each in by_attack.items()},
        missing=tuple(f"{text} ({reason})" for text, reason in missing.items() if reason),
        worst_cases=tuple(_find_worst_cases(group, [one for each in by_attack.values() for one in each])),
    )


def _explain_missing(group: ComparisonGroup, experiments: Sequence[GroupedExperiment]) -> str | None:
    """Return the reason why the results of an attack are missing; None if they exist, or if it does not apply.

    One of several experiments suffices, such as the one with the network that was trained for the defense.
    """
    reasons = [_explain_gap(group, experiment) for experiment in experiments]
    return None if None in reasons else reasons[0] if reasons else "not run"


def _explain_gap(group: ComparisonGroup, experiment: GroupedExperiment) -> str | None:
    if experiment.reason is not None:
        return experiment.reason if any(words in experiment.reason for words in UNTRAINED) else None
    if experiment.metadata["attack"].get(INVERSION, "") is None:
        return "no network inverts what it recovers"
    missing = group.count_missing(experiment)
    return f"{missing} of {len(group.samples)} samples missing" if missing else None


def _find_worst_cases(group: ComparisonGroup, experiments: Sequence[GroupedExperiment]) -> Iterable[WorstCase]:
    for measure in group.measures:
        scores = {one: score for one in experiments if measure.better and (score := group.average(one, measure))}
        attacks = {one: score for one, score in scores.items() if not is_oracle(one.metadata)}
        if not attacks:
            continue
        worst = find_worst(measure, attacks)
        references = {one: score for one, score in scores.items() if one not in attacks}
        reference = find_worst(measure, references) if references else None
        yield WorstCase(
            measure=measure,
            score=attacks[worst],
            experiment=worst,
            baselines={name: score for name in BASELINES for one, score in attacks.items() if get_attack(one.metadata) == name},
            oracle=references[reference] if reference else None,
            reference=reference,
        )


def find_worst(measure: Measure, scores: Mapping[GroupedExperiment, Interval]) -> GroupedExperiment:
    """Return the experiment with the greatest leakage, the first of equals. It has the least value if larger is better."""
    return max(scores, key=lambda one: -measure.better * scores[one].mean)
