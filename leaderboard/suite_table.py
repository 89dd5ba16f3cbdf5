"""Tables of a comparison group under a suite of attacks: a row for each defense, and a row for each defense and measure.

At a fixed recall, defenses are compared at equal utility. Of several settings of one defense, the first table marks the one whose
recall of localization is nearest to `FIXED_RECALL`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.core.hashing import canonical_json
from bench.core.table import NOT_APPLICABLE, Column, Row, Table
from bench.runner.records import Record
from leaderboard import chance
from leaderboard.attack_cost import count_training_samples, measure_core_seconds
from leaderboard.attack_flags import NOT_MONOTONE, WEAKER, Flag, flag_attacks
from leaderboard.comparison import ComparisonGroup, LocatedRecord, build_groups
from leaderboard.group_tables import INTERVAL_REMARK, describe_guarantee
from leaderboard.intervals import MIN_SAMPLES, Interval
from leaderboard.measures import PRIVACY, RANKING, UTILITY, Measure, list_measures
from leaderboard.noise_control import LESS, NoiseComparison, Utility, compare_with_noise, find_utility
from leaderboard.signal import BASELINES, METRICS
from leaderboard.tables import format_fraction, format_interval, format_number
from leaderboard.worst_case import SuiteResult, WorstCase, list_results

INCOMPLETE = "incomplete"
NOT_STATED = "not stated"
FIXED_RECALL = 0.5  # about that of raw descriptors by night in the paper
SUITE_REMARK = (
    "Suite: the version whose attacks were all run with its settings, or do not apply. "
    f"A defense whose results are {INCOMPLETE} has no version, and its worst case may be greater."
)
FLAGS_REMARK = (
    "Flags: attacks whose score says little. They are at the baselines, or score significantly lower than an attack with less "
    "knowledge, or score significantly lower at a larger ε, or report that they reached their budget before they converged. "
    f"The comparisons with less knowledge and with other ε need {MIN_SAMPLES} samples with SSIM or {chance.IDENTIFIED}."
)
REMARKS = (
    SUITE_REMARK,
    "Worst case: the greatest leakage by the mean of an attack of the suite, baselines included. The oracle is a reference and "
    "not among them. The interval has no correction for the choice of the attack.",
    FLAGS_REMARK,
    INTERVAL_REMARK,
)
NOISE_REMARK = (
    "Noise: the worst case over the attacks on Gaussian noise at the same utility. A defense that is not shown to leak less than "
    "this noise is flagged. The score of the noise is a lower bound, too."
)
DEFENSE_MEASURES = (chance.IDENTIFIED, PRIVACY)
DEFENSE_REMARKS = (
    SUITE_REMARK,
    "Identified and SSIM: the greatest leakage by the mean of an attack of the suite, baselines included. The interval has no "
    "correction for the choice of the attack. After 'to': the score of the oracle, which knows a part of the secret. A stronger "
    "attack may reach any score in this bracket. There is none if no oracle applies, or if it scores no higher.",
    f"Utility: the mean recall, and its dataset. Of several settings of one defense, the one whose recall of localization is "
    f"nearest to {FIXED_RECALL} is marked. Compare defenses in these rows.",
    f"Training samples: of all networks of these attacks, over all stages; {NOT_STATED} if a file of the attack is not shipped.",
    "Core seconds a photograph: the median wall time of one photograph times the threads, without training. It includes the "
    "attack, the network that inverts its result, and the metrics.",
    FLAGS_REMARK,
    INTERVAL_REMARK,
)
_LABELS = ("defense", "suite", "measure", "worst case", "attack", "signal", *BASELINES, "oracle", "flags")
_NOISE = "noise"
_TEXTS = ("defense", "suite", "measure", "attack", "signal", "flags")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Judgement:
    """The results of a group, their flags, and their comparison with noise."""

    group: ComparisonGroup
    results: Sequence[SuiteResult]  # with worst cases
    latest: Sequence[SuiteResult]  # the last one of each defense
    flags: Mapping[SuiteResult, Sequence[Flag]]
    noise: Mapping[WorstCase, NoiseComparison]


def build_group_tables(
    group: ComparisonGroup, groups: Sequence[ComparisonGroup] = (), *, brief: bool = False
) -> dict[str, Table]:
    """Return the table `defenses` with a row for each defense, and `worst-case` with one for each measure. {} without results.

    `groups` may hold the utilities of the defenses. The value `latest` of a row is true under the latest suite that the defense
    has all results of, and in an incomplete row. `brief` tables have these rows alone. In them, the table of worst cases has the
    measures that rank defenses alone.
    """
    return _build_tables(group, list_results(group), groups, brief)


def build_run_tables(records: Sequence[Record], *, brief: bool = False) -> list[Table]:
    """Return both tables of each group of a run whose records have every attack of a suite for at least one defense.

    `brief` tables are for a terminal, as in `build_group_tables`.
    """
    groups = build_groups([LocatedRecord(record, Path()) for record in records])
    results = [(group, list_results(group)) for group in groups]
    complete = [(group, each) for group, each in results if any(one.is_complete_run for one in each)]
    return [table for group, each in complete for table in _build_tables(group, each, groups, brief).values()]


def _build_tables(
    group: ComparisonGroup, every: Sequence[SuiteResult], groups: Sequence[ComparisonGroup], brief: bool
) -> dict[str, Table]:
    judgement = _judge(group, every, groups)
    if not judgement.results:
        return {}
    if brief:  # flags compare the results of all defenses under a suite, shown or not
        judgement = dataclasses.replace(judgement, results=judgement.latest)
    return {"defenses": _build_defenses(judgement, groups), "worst-case": _build_worst_cases(judgement, brief)}


def _select_latest(results: Sequence[SuiteResult]) -> list[SuiteResult]:
    """Return the last result of each defense."""
    return list({canonical_json(result.metadata["defense"]): result for result in results}.values())


def _judge(group: ComparisonGroup, every: Sequence[SuiteResult], groups: Sequence[ComparisonGroup]) -> _Judgement:
    results = [result for result in every if result.worst_cases]
    flags = {
        suite: flag_attacks(group, [result for result in results if result.suite == suite])
        for suite in {result.suite for result in results}
    }
    return _Judgement(
        group=group,
        results=results,
        latest=_select_latest(results),
        flags={result: [one for one in flags[result.suite] if one.experiment in result.applicable] for result in results},
        noise=compare_with_noise(group, groups, results),
    )


def _build_defenses(judgement: _Judgement, groups: Sequence[ComparisonGroup]) -> Table:
    utilities = {
        result: utility
        for result in judgement.results
        if (utility := find_utility(judgement.group, groups, result.metadata["defense"]))
    }
    nearest = _find_fixed_recall(utilities)
    labels = (
        *("defense", "suite", *(measure.label for measure in list_measures(DEFENSE_MEASURES)), "utility", "guarantee"),
        *("training samples", "core seconds a photograph", "flags"),
    )
    return Table(
        heading=f"Worst case of each defense. {', '.join([judgement.group.title, *judgement.group.facts])}",
        columns=tuple(Column(label=label, text=True) for label in labels),
        rows=tuple(
            _build_defense_row(judgement, result, utilities.get(result), result in nearest) for result in judgement.results
        ),
        remarks=DEFENSE_REMARKS,
        note_column=labels.index("suite"),
    )


def _find_fixed_recall(utilities: Mapping[SuiteResult, Utility]) -> set[SuiteResult]:
    """Return the results whose recall is nearest to `FIXED_RECALL` among several settings of the same defense."""
    settings: dict[tuple[str, str], dict[SuiteResult, float]] = {}
    for result, utility in utilities.items():
        if utility.measure.name == UTILITY[0]:
            distances = settings.setdefault((result.metadata["defense"]["name"], utility.group.key), {})
            distances[result] = abs(utility.mean - FIXED_RECALL)
    several = [each for each in settings.values() if len({result.defense for result in each}) > 1]
    return {result for each in several for result, distance in each.items() if distance == min(each.values())}


def _build_defense_row(judgement: _Judgement, result: SuiteResult, utility: Utility | None, is_nearest: bool) -> Row:
    by_name = {one.measure.name: one for one in result.worst_cases}
    worst = {name: by_name[name] for name in DEFENSE_MEASURES if name in by_name}
    epsilon = result.metadata["privacy"]["epsilon_descriptor"]
    values = {
        "defense": result.defense,
        "suite": _name_suite(result),
        "latest": result in judgement.latest,
        **{
            name: value
            for measure in DEFENSE_MEASURES
            for name, value in _describe_worst(judgement, measure, worst.get(measure)).items()
        },
        "utility": utility and utility.mean,
        "utility_measure": utility and utility.measure.name,
        "utility_dataset": utility and utility.group.metadata["dataset"]["name"],
        "nearest_to_fixed_recall": is_nearest,
        "guarantee": describe_guarantee(result.metadata),
        "epsilon_descriptor": epsilon,
        "flags": "; ".join(_list_flags(judgement, result, list(worst.values()))),
        "missing": "; ".join(result.missing),
    }
    return Row(
        texts=(
            result.defense,
            str(values["suite"]),
            *(_format_worst(judgement, worst.get(measure)) for measure in DEFENSE_MEASURES),
            _format_utility(utility, is_nearest),
            str(values["guarantee"]) + ("" if epsilon is None else f", ε = {format_number(float(epsilon))} per descriptor"),
            _join_costs(worst, [_format_samples(values[f"{name}_training_samples"]) for name in worst]),
            _join_costs(worst, [_format_seconds(values[f"{name}_core_seconds"]) for name in worst]),
            str(values["flags"]),
        ),
        values=values,
        note=f"missing: {values['missing']}" if result.missing else "",
    )


def _describe_worst(judgement: _Judgement, name: str, worst: WorstCase | None) -> dict[str, Any]:
    """Return the values of a measure's worst case, for programs."""
    signal = judgement.group.signals.get(worst.experiment) if worst else None
    return {
        name: worst and worst.score,
        f"{name}_attack": worst and worst.experiment.attack,
        f"{name}_signal": signal and signal.word,
        f"{name}_oracle": worst and worst.oracle,
        f"{name}_oracle_attack": worst and worst.reference and worst.reference.attack,
        f"{name}_training_samples": worst and count_training_samples(worst.experiment.metadata["attack"]),
        f"{name}_core_seconds": worst and measure_core_seconds(worst.experiment.completed),
    }


def _format_worst(judgement: _Judgement, worst: WorstCase | None) -> str:
    """Return the worst case, its attack, and the bracket to the oracle."""
    if worst is None:
        return NOT_APPLICABLE
    signal = judgement.group.signals.get(worst.experiment)
    doubt = f" (signal: {signal.word})" if signal and (signal.is_absent or signal.is_untested) else ""
    text = f"{format_interval(worst.score)} by {worst.experiment.attack}{doubt}"
    if worst.oracle and worst.reference and worst.is_bracketed:
        return f"{text}, to {format_number(worst.oracle.mean)} by {worst.reference.attack}"
    return text


def _format_utility(utility: Utility | None, is_nearest: bool) -> str:
    if utility is None:
        return NOT_APPLICABLE
    text = f"{utility.measure.label} {format_number(utility.mean)} on {utility.group.metadata['dataset']['name']}"
    return f"{text}, nearest to {FIXED_RECALL}" if is_nearest else text


def _format_samples(count: int | None) -> str:
    return NOT_STATED if count is None else f"{count:,}" if count else "none"


def _format_seconds(seconds: float | None) -> str:
    return NOT_APPLICABLE if seconds is None else format_number(seconds)


def _join_costs(worst: Mapping[str, WorstCase], texts: Sequence[str]) -> str:
    """Return the costs of the attacks that reached the worst cases, one for each measure if they differ."""
    if len(set(texts)) < 2:
        return next(iter(texts), NOT_APPLICABLE)
    labels = (one.measure.label.partition(" (")[0] for one in worst.values())  # without the value of chance
    return "; ".join(f"{text} for {label}" for text, label in zip(texts, labels, strict=True))


def _list_flags(judgement: _Judgement, result: SuiteResult, worst_cases: Sequence[WorstCase]) -> list[str]:
    """Return the flags of the attacks on a defense by the measures of these worst cases, and those that were not tested."""
    metrics = {worst.measure.metric for worst in worst_cases}
    texts = [flag.text for flag in judgement.flags[result] if flag.metric is None or flag.metric in metrics]
    for worst in worst_cases:
        control = judgement.noise.get(worst)
        if control and control.verdict not in (None, LESS):
            texts.append(f"{control.verdict} of equal utility: {control.control.label}")
    if not metrics & METRICS.keys() or len(judgement.group.samples) < MIN_SAMPLES:
        texts.append(f"not tested: {WEAKER}, {NOT_MONOTONE}")
    return list(dict.fromkeys(texts))


def _name_suite(result: SuiteResult) -> str:
    return result.version or f"{INCOMPLETE}: {result.suite}"


def _build_worst_cases(judgement: _Judgement, brief: bool) -> Table:
    labels = (*_LABELS[:-1], _NOISE, *_LABELS[-1:]) if judgement.noise else _LABELS
    return Table(
        heading=f"Worst case over a suite of attacks. {', '.join([judgement.group.title, *judgement.group.facts])}",
        columns=tuple(Column(label=label, text=label in _TEXTS) for label in labels),
        rows=tuple(
            _build_row(judgement, result, worst)
            for result in judgement.results
            for worst in result.worst_cases
            if not brief or worst.measure.name in RANKING
        ),
        remarks=(*REMARKS, NOISE_REMARK) if judgement.noise else REMARKS,
        note_column=_LABELS.index("suite"),
    )


def _build_row(judgement: _Judgement, result: SuiteResult, worst: WorstCase) -> Row:
    signal, measure = judgement.group.signals.get(worst.experiment), worst.measure
    control = judgement.noise.get(worst)
    values = {
        "defense": result.defense,
        "suite": _name_suite(result),
        "latest": result in judgement.latest,
        "measure": measure.name,
        "worst_case": worst.score,
        "attack": worst.experiment.attack,
        "signal": signal.word if signal else None,
        **{name: worst.baselines.get(name) for name in BASELINES},
        "oracle": worst.oracle,
        "flags": "; ".join(_list_flags(judgement, result, [worst])),
        "missing": "; ".join(result.missing),
        **(_describe_noise(control) if judgement.noise else {}),
    }
    return Row(
        texts=(
            result.defense,
            str(values["suite"]),
            measure.label,
            _format(measure, worst.score),
            worst.experiment.attack,
            str(values["signal"] or NOT_APPLICABLE),
            *(_format(measure, worst.baselines.get(name)) for name in BASELINES),
            _format(measure, worst.oracle),
            *([_format_noise(measure, control)] if judgement.noise else []),
            str(values["flags"]),
        ),
        values=values,
        note=f"missing: {values['missing']}" if result.missing else "",
    )


def _describe_noise(control: NoiseComparison | None) -> dict[str, Any]:
    if control is None:
        return dict.fromkeys(("noise", "noise_defense", "noise_attack", "noise_verdict", "noise_utility", "utility"))
    return {
        "noise": control.score,
        "noise_defense": control.control.label,
        "noise_attack": control.experiment.attack,
        "noise_verdict": control.verdict,
        "noise_utility": control.control.utilities[1],
        "utility": control.control.utilities[0],
    }


def _format_noise(measure: Measure, control: NoiseComparison | None) -> str:
    if control is None:
        return NOT_APPLICABLE
    noise, (own, other) = control.control, control.control.utilities
    utility = f"{noise.utility.label} {other:.3f} for {own:.3f}"
    return f"{_format(measure, control.score)} by {control.experiment.attack} ({noise.label}, {utility})"


def _format(measure: Measure, score: Interval | None) -> str:
    if score is None:
        return NOT_APPLICABLE
    return format_fraction(score) if measure.name in map(chance.name_rank_1, chance.IDENTIFICATION) else format_interval(score)
