"""Matched-noise control: whether a defense leaks less than Gaussian noise on raw descriptors at the same utility.

The control of a defense is the setting of the defense `noise` whose utility is nearest to its own, and counts as equal to it
(`get_tolerance`). The utility is the recall of localization, or else the matching score: the recall of the task `matching`. Both
are measured for both defenses in one comparison group of the same features. `tools/match_noise.py` finds such settings.

The leakage of a defense, and of the noise, is the greatest mean over its attacks in the group, baselines included, oracles
excluded. The two are paired by sample and compared by Student's t in both directions, with Holm's correction over all comparisons
of a group. A defense that is not shown to leak less is marked.

Both leakages are lower bounds. A stronger attack on the defense can refute "less", and one on the noise can refute "more". So
"less" needs the results of a whole suite on the defense and an attack with a signal, and "more" a network for the noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import MIN_SAMPLES, Estimate, Interval, correct_holm, estimate_mean
from leaderboard.measures import UTILITY, Measure, list_measures
from leaderboard.signal import METRICS, SIGNIFICANCE, Verdict, collect_values, get_attack, is_oracle
from leaderboard.tradeoff import drop_files, list_shared_settings
from leaderboard.worst_case import SuiteResult, WorstCase, find_worst

CONTROL = "noise"  # the name of the defense
ADAPTED = "dia"  # the attack whose network is trained for a defense
TOLERANCE, RELATIVE = 0.02, 0.2  # greatest difference of the utilities, and as a fraction of the defense's
LESS, MORE, NOT_LESS = "leaks less than noise", "leaks more than noise", "not shown to leak less than noise"


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """Noise at the utility of a defense."""

    label: str  # of the noise
    utility: Measure
    utilities: tuple[float, float]  # of the defense and of the noise
    experiments: tuple[GroupedExperiment, ...]  # attacks on the noise, without oracles


@dataclass(frozen=True, kw_only=True, eq=False)
class Utility:
    """The utility of a defense for a server."""

    measure: Measure
    mean: float
    group: ComparisonGroup  # in which it was measured


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseComparison:
    """The worst case of a defense and that of its control, by one measure."""

    control: Control
    score: Interval  # of the noise
    experiment: GroupedExperiment  # the attack that reached it
    verdict: str | None  # `LESS`, `MORE` or `NOT_LESS`; None for measures that are not compared, and with too few samples


Pair = tuple[GroupedExperiment, GroupedExperiment, Measure]  # attacks on a defense and on the noise, and the measure compared


def compare_with_noise(
    group: ComparisonGroup, groups: Sequence[ComparisonGroup], results: Iterable[SuiteResult]
) -> dict[WorstCase, NoiseComparison]:
    """Return the comparison of each worst case whose defense has a control in the group. `groups` hold the utilities."""
    found = {
        worst: (result, control, (own, other, worst.measure))
        for result in results
        if (control := find_control(group, groups, result))
        for worst in result.worst_cases
        if (own := _find_strongest(group, _list_attacks(group, worst), worst.measure))
        if (other := _find_strongest(group, control.experiments, worst.measure))
    }
    verdicts = _judge(group, dict.fromkeys(pair for _, _, pair in found.values()))
    compared = {}
    for worst, (result, control, pair) in found.items():
        own, other, measure = pair
        score, verdict = group.average(other, measure), verdicts.get(pair)
        assert score is not None  # `_find_strongest` selects among those with a score
        if (verdict == LESS and not _is_evident(group, result, own)) or (verdict == MORE and not _has_network(control)):
            verdict = NOT_LESS
        compared[worst] = NoiseComparison(control=control, score=score, experiment=other, verdict=verdict)
    return compared


def _judge(group: ComparisonGroup, pairs: Iterable[Pair]) -> dict[Pair, str]:
    """Return the verdict of each pair that can be compared. Rows of several suites share a pair, which is one hypothesis."""
    tested = {pair: estimate for pair in pairs if (estimate := _estimate_difference(group, pair))}
    below = correct_holm([estimate.p_below(0.0) for estimate in tested.values()])
    above = correct_holm([estimate.p_above(0.0) for estimate in tested.values()])
    return {
        pair: LESS if less < SIGNIFICANCE else MORE if more < SIGNIFICANCE else NOT_LESS
        for pair, less, more in zip(tested, below, above, strict=True)
    }


def _is_evident(group: ComparisonGroup, result: SuiteResult, attack: GroupedExperiment) -> bool:
    """Return whether the score of the attack says how much the defense leaks."""
    signal = group.signals.get(attack)
    return result.version is not None and signal is not None and signal.verdict is Verdict.SIGNAL


def _has_network(control: Control) -> bool:
    """Return whether a network was trained for the noise."""
    return any(get_attack(one.metadata) == ADAPTED for one in control.experiments)


def _list_attacks(group: ComparisonGroup, worst: WorstCase) -> list[GroupedExperiment]:
    """Return the attacks on the defense of a worst case that have all samples, also those outside its suite, without oracles."""
    defense = worst.experiment.metadata["defense"]
    return [one for one in _list_complete(group) if one.metadata["defense"] == defense]


def _list_complete(group: ComparisonGroup) -> list[GroupedExperiment]:
    return [
        one
        for one in group.experiments
        if one.reason is None and one.metadata["attack"] and not is_oracle(one.metadata) and not group.count_missing(one)
    ]


def find_control(group: ComparisonGroup, groups: Sequence[ComparisonGroup], result: SuiteResult) -> Control | None:
    """Return the control of a defense; None if no noise in the group has its utility, or the defense is noise itself."""
    defense = result.metadata["defense"]
    noises: dict[str, list[GroupedExperiment]] = {}
    for one in _list_complete(group):
        if one.metadata["defense"]["name"] == CONTROL:
            noises.setdefault(one.defense, []).append(one)
    if defense["name"] == CONTROL:
        return None
    for utility in _list_utilities(group, groups, defense):
        others = {
            label: score
            for label, each in noises.items()
            if (score := _average_utility(utility.group, utility.measure, each[0].metadata["defense"])) is not None
        }
        label = min(others, key=lambda label: abs(others[label] - utility.mean), default=None)
        if label is not None and abs(others[label] - utility.mean) <= get_tolerance(utility.mean):
            utilities = utility.mean, others[label]
            return Control(label=label, utility=utility.measure, utilities=utilities, experiments=tuple(noises[label]))
    return None


def get_tolerance(utility: float) -> float:
    """Return the greatest difference at which the utility of noise counts as equal to that of a defense."""
    return min(TOLERANCE, RELATIVE * utility)


def find_utility(group: ComparisonGroup, groups: Sequence[ComparisonGroup], defense: dict[str, object]) -> Utility | None:
    """Return the utility of a defense of the group from `groups` of the same features, on the same dataset if it was measured."""
    return next(_list_utilities(group, groups, defense), None)


def _list_utilities(group: ComparisonGroup, groups: Sequence[ComparisonGroup], defense: dict[str, object]) -> Iterator[Utility]:
    """Yield the utilities of a defense from groups of the same features, by measure, first on the dataset of `group`."""
    content = group.metadata["dataset"]["hash"]
    alike = [one for one in groups if list_shared_settings(one) == list_shared_settings(group)]
    alike.sort(key=lambda one: one.metadata["dataset"]["hash"] != content)
    for measure in list_measures(UTILITY):
        for served in alike:
            mean = _average_utility(served, measure, defense) if measure in served.measures else None
            if mean is not None:
                yield Utility(measure=measure, mean=mean, group=served)


def _average_utility(group: ComparisonGroup, utility: Measure, defense: dict[str, object]) -> float | None:
    """Return the mean utility of a defense that has completed all samples; files such as dictionaries may differ."""
    alike = [one for one in group.experiments if drop_files(one.metadata["defense"]) == drop_files(defense)]
    scores = [group.average(one, utility) for one in alike if one.reason is None and not group.count_missing(one)]
    return scores[0].mean if len(scores) == 1 and scores[0] else None


def _find_strongest(
    group: ComparisonGroup, experiments: Iterable[GroupedExperiment], measure: Measure
) -> GroupedExperiment | None:
    scores = {one: score for one in experiments if (score := group.average(one, measure))}
    return find_worst(measure, scores) if scores else None


def _estimate_difference(group: ComparisonGroup, pair: Pair) -> Estimate | None:
    """Return the leakage of the defense minus that of the noise, by sample; None if it is not compared."""
    *experiments, measure = pair
    if measure.name not in METRICS:
        return None
    own, other = (
        collect_values([record for sample in group.complete_samples(one) for record in sample])[measure.metric]
        for one in experiments
    )
    differences = [value - other[sample] for sample, value in own.items() if sample in other]
    return estimate_mean(differences) if len(differences) >= MIN_SAMPLES else None
