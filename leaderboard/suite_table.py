"""Table of a comparison group under a suite of attacks: a row for each defense and measure, with the worst case and its flags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.core.table import NOT_APPLICABLE, Column, Row, Table
from bench.runner.records import Record
from leaderboard import chance
from leaderboard.attack_flags import Flag, flag_attacks
from leaderboard.comparison import ComparisonGroup, LocatedRecord, build_groups
from leaderboard.group_tables import INTERVAL_REMARK
from leaderboard.intervals import Interval
from leaderboard.measures import RANKING, Measure
from leaderboard.noise_control import LESS, NoiseComparison, compare_with_noise
from leaderboard.signal import BASELINES
from leaderboard.tables import format_fraction, format_interval
from leaderboard.worst_case import SuiteResult, WorstCase, list_results

INCOMPLETE = "incomplete"
REMARKS = (
    "Suite: the version whose attacks were all run with its settings, or do not apply. "
    f"A defense whose results are {INCOMPLETE} has no version, and its worst case may be greater.",
    "Worst case: the greatest leakage by the mean of an attack of the suite, baselines included. The oracle is a reference and "
    "not among them. The interval has no correction for the choice of the attack.",
    "Flags: attacks whose score says little. They are at the baselines, or score significantly lower than an attack with less "
    "knowledge, or score significantly lower at a larger ε, or report that they reached their budget before they converged.",
    INTERVAL_REMARK,
)
NOISE_REMARK = (
    "Noise: the worst case over the attacks on Gaussian noise at the same utility. A defense that is not shown to leak less than "
    "this noise is flagged. The score of the noise is a lower bound, too."
)
_LABELS = ("defense", "suite", "measure", "worst case", "attack", "signal", *BASELINES, "oracle", "flags")
_NOISE = "noise"
_TEXTS = ("defense", "suite", "measure", "attack", "signal", "flags")


def build_suite_table(group: ComparisonGroup, groups: Sequence[ComparisonGroup] = (), *, brief: bool = False) -> Table | None:
    """Return the table of all defenses with results under a suite of attacks; None if there are none.

    `groups` may hold the utilities of the defenses, for the matched-noise control. A `brief` table has the measures that rank
    defenses alone.
    """
    return _build_table(group, list_results(group), brief, groups)


def build_run_tables(records: Sequence[Record], *, brief: bool = False) -> list[Table]:
    """Return the tables of a run whose records have every attack of a suite for at least one defense.

    `brief` tables are for a terminal: they have the measures that rank defenses alone.
    """
    groups = build_groups([LocatedRecord(record, Path()) for record in records])
    results = [(group, list_results(group)) for group in groups]
    tables = [_build_table(group, each, brief) for group, each in results if any(one.is_complete_run for one in each)]
    return [table for table in tables if table]


def _build_table(
    group: ComparisonGroup, every: Sequence[SuiteResult], brief: bool = False, groups: Sequence[ComparisonGroup] = ()
) -> Table | None:
    results = [result for result in every if result.worst_cases]
    if not results:
        return None
    flags = {
        suite: flag_attacks(group, [result for result in results if result.suite == suite])
        for suite in {result.suite for result in results}
    }
    noise = compare_with_noise(group, groups, results)
    labels = (*_LABELS[:-1], _NOISE, *_LABELS[-1:]) if noise else _LABELS
    return Table(
        heading=f"Worst case over a suite of attacks. {', '.join([group.title, *group.facts])}",
        columns=tuple(Column(label=label, text=label in _TEXTS) for label in labels),
        rows=tuple(
            _build_row(group, result, worst, flags[result.suite], noise)
            for result in results
            for worst in result.worst_cases
            if not brief or worst.measure.name in RANKING
        ),
        remarks=(*REMARKS, NOISE_REMARK) if noise else REMARKS,
        note_column=_LABELS.index("suite"),
    )


def _build_row(
    group: ComparisonGroup,
    result: SuiteResult,
    worst: WorstCase,
    flags: Sequence[Flag],
    noise: Mapping[WorstCase, NoiseComparison],
) -> Row:
    signal, measure = group.signals.get(worst.experiment), worst.measure
    own = [flag for flag in flags if flag.experiment in result.applicable and flag.metric == measure.metric]
    texts = list(dict.fromkeys(flag.text for flag in own))
    control = noise.get(worst)
    if control and control.verdict not in (None, LESS):
        texts.append(f"{control.verdict} of equal utility: {control.control.label}")
    values = {
        "defense": result.defense,
        "suite": result.version or f"{INCOMPLETE}: {result.suite}",
        "measure": measure.name,
        "worst_case": worst.score,
        "attack": worst.experiment.attack,
        "signal": signal.word if signal else None,
        **{name: worst.baselines.get(name) for name in BASELINES},
        "oracle": worst.oracle,
        "flags": "; ".join(texts),
        "missing": "; ".join(result.missing),
        **(_describe_noise(control) if noise else {}),
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
            *([_format_noise(measure, control)] if noise else []),
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
