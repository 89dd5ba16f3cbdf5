"""Table of a comparison group under a suite of attacks: a row for each defense and measure, with the worst case and its flags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.core.table import NOT_APPLICABLE, Column, Row, Table
from bench.runner.records import Record
from leaderboard import chance
from leaderboard.attack_flags import Flag, flag_attacks
from leaderboard.comparison import ComparisonGroup, LocatedRecord, build_groups
from leaderboard.group_tables import INTERVAL_REMARK
from leaderboard.intervals import Interval
from leaderboard.measures import RANKING, Measure
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
    "knowledge, or score significantly lower at a larger ε. No attack reports convergence.",
    INTERVAL_REMARK,
)
_LABELS = ("defense", "suite", "measure", "worst case", "attack", "signal", *BASELINES, "oracle", "flags")
_TEXTS = ("defense", "suite", "measure", "attack", "signal", "flags")


def build_suite_table(group: ComparisonGroup) -> Table | None:
    """Return the table of all defenses with results under a suite of attacks; None if there are none."""
    return _build_table(group, list_results(group))


def build_run_tables(records: Sequence[Record], *, brief: bool = False) -> list[Table]:
    """Return the tables of a run whose records have every attack of a suite for at least one defense.

    `brief` tables are for a terminal: they have the measures that rank defenses alone.
    """
    groups = build_groups([LocatedRecord(record, Path()) for record in records])
    results = [(group, list_results(group)) for group in groups]
    tables = [_build_table(group, each, brief) for group, each in results if any(one.is_complete_run for one in each)]
    return [table for table in tables if table]


def _build_table(group: ComparisonGroup, every: Sequence[SuiteResult], brief: bool = False) -> Table | None:
    results = [result for result in every if result.worst_cases]
    if not results:
        return None
    flags = {
        suite: flag_attacks(group, [result for result in results if result.suite == suite])
        for suite in {result.suite for result in results}
    }
    return Table(
        heading=f"Worst case over a suite of attacks. {', '.join([group.title, *group.facts])}",
        columns=tuple(Column(label=label, text=label in _TEXTS) for label in _LABELS),
        rows=tuple(
            _build_row(group, result, worst, flags[result.suite])
            for result in results
            for worst in result.worst_cases
            if not brief or worst.measure.name in RANKING
        ),
        remarks=REMARKS,
        note_column=_LABELS.index("suite"),
    )


def _build_row(group: ComparisonGroup, result: SuiteResult, worst: WorstCase, flags: Sequence[Flag]) -> Row:
    signal, measure = group.signals.get(worst.experiment), worst.measure
    own = [flag for flag in flags if flag.experiment in result.applicable and flag.metric == measure.metric]
    texts = list(dict.fromkeys(flag.text for flag in own))
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
            str(values["flags"]),
        ),
        values=values,
        note=f"missing: {values['missing']}" if result.missing else "",
    )


def _format(measure: Measure, score: Interval | None) -> str:
    if score is None:
        return NOT_APPLICABLE
    return format_fraction(score) if measure.name in map(chance.name_rank_1, chance.IDENTIFICATION) else format_interval(score)
