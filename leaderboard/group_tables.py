"""Tables of a comparison group: a row for each experiment, or for each defense, with intervals and ranks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median

from bench.core.table import NOT_APPLICABLE, Column, Row, Table
from bench.mechanisms.composition import UNCOVERED
from bench.runner.records import Record
from leaderboard import chance, signal
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import LEVEL, Interval
from leaderboard.measures import Measure, list_measures
from leaderboard.ranking import Standing, rank_defenses
from leaderboard.tables import (
    COMPOSITION_REMARK,
    SEED_REMARK,
    format_chance,
    format_fraction,
    format_interval,
    format_number,
    list_rejected,
    spent_epsilon,
)

Value = Interval | float | int | str | None

RANK_1_COLUMNS = tuple(map(chance.name_rank_1, chance.IDENTIFICATION))  # a condition may follow

INTERVAL_REMARK = (
    f"In brackets: the {LEVEL:.0%} interval of Student's t over the samples, or Wilson's if each sample succeeds or fails. "
    "A single sample and a median have no interval."
)
NOT_APPLICABLE_REMARK = f"{NOT_APPLICABLE} without a note: the metric does not apply to the result of the attack."
RANK_REMARK = (
    "Rank: by the sum of the positions in SSIM and in identified, each of the attack with the greatest mean among those with a "
    "signal. Of equal sums, the lower identified comes first. The strongest attack is that of the greatest mean SSIM among those "
    "with a signal; of equal ones, that of the greater identified. The best values of ranked defenses are bold. A defense is "
    "unranked and comes last if no attacker was adapted to it, if an attack has not completed all samples, or if no attack has a "
    "signal: the benchmark cannot say how private it is."
)


@dataclass(frozen=True, kw_only=True)
class GroupColumn(Column):
    """A column with a name that programs use."""

    name: str
    better: int = 0  # 1: the greatest value is the best; -1: the least; 0: neither


@dataclass(frozen=True, kw_only=True, eq=False)
class GroupRow(Row):
    """The row of one experiment."""

    experiment: GroupedExperiment
    strongest: bool  # whether it is the strongest attack on its defense
    competes: bool  # whether its values can be the best of a column


@dataclass(frozen=True, kw_only=True, eq=False)
class GroupTable(Table):
    """A table of a comparison group."""

    columns: tuple[GroupColumn, ...]
    rows: tuple[GroupRow, ...]


def build_pairs_table(group: ComparisonGroup) -> GroupTable:
    """Return a table with a row for each experiment. With attacks, rows are in the order of rank, the strongest attack first."""
    columns = _build_columns(group)
    explanations = [f"{measure.label}: {measure.explanation}" for measure in group.measures if measure.explanation]
    rank = [RANK_REMARK, *_list_signal_remarks(group)] if group.has_attacks else []
    return GroupTable(
        heading=", ".join([group.title, *group.facts]),
        columns=columns,
        rows=_mark_best(columns, [_build_row(group, columns, *pair) for pair in _order_experiments(group)]),
        remarks=(*explanations, *rank, INTERVAL_REMARK, NOT_APPLICABLE_REMARK, COMPOSITION_REMARK, SEED_REMARK),
        note_column=1 if group.has_attacks else 0,  # the defense
    )


def build_ranking_table(group: ComparisonGroup) -> GroupTable:
    """Return a table with a row for each defense, with the strongest attack on it."""
    table = build_pairs_table(group)
    rows = tuple(row for row in table.rows if row.strongest)
    return dataclasses.replace(table, heading=f"Ranking. {table.heading}", rows=rows)


def comparable_number(value: Value) -> float | None:
    """Return a value as a number for comparisons; None for text."""
    if isinstance(value, Interval):
        return value.mean
    return float(value) if isinstance(value, int | float) else None


def describe_guarantee(record: Record) -> str:
    """Return the guarantee of a defense in words."""
    name, by_distance = str(record["privacy"]["guarantee"]), record["privacy"].get("epsilon_per_distance")
    words = _GUARANTEES.get(name, name)
    return words if by_distance is None else f"{words}, ε = {format_number(by_distance)} per unit of distance"


_GUARANTEES = {
    "epsilon-ldp": "ε-LDP",
    "epsilon-ldp-by-word": "ε-LDP of each word",
    "d-chi": "d_χ privacy",
}


def _list_signal_remarks(group: ComparisonGroup) -> list[str]:
    """Return the remarks on signals, chance and baselines that are missing."""
    metrics = [measure.name for measure in group.measures if measure.name in chance.IDENTIFICATION]
    chance_remark = [chance.explain_identification(metric) for metric in metrics]
    untested = signal.explain_untested(list(group.signals.values()))
    return [signal.REMARK, *chance_remark, *([untested] if untested else [])]


def _build_columns(group: ComparisonGroup) -> tuple[GroupColumn, ...]:
    rank = [GroupColumn(name="rank", label="rank")] if group.has_attacks else []
    attack = [GroupColumn(name=name, label=name, text=True) for name in ("attack", "signal")] if group.has_attacks else []
    return (
        *rank,
        GroupColumn(name="defense", label="defense", text=True),
        GroupColumn(name="guarantee", label="guarantee", text=True),
        GroupColumn(name="epsilon_descriptor", label="ε/descriptor"),
        GroupColumn(name="epsilon_image", label="ε/image"),
        *attack,
        *(
            GroupColumn(
                name=_join(measure.name, "_", condition), label=_join(measure.label, ", ", condition), better=measure.better
            )
            for measure, condition in _list_measured(group)
        ),
        GroupColumn(name="log10_true", label="Pr(true)"),
        GroupColumn(name="units", label="n"),
    )


def _list_measured(group: ComparisonGroup) -> list[tuple[Measure, str | None]]:
    """Return the measures that have a column: those with a better direction per condition, the others over all conditions."""
    judged = [(measure, condition) for condition in group.conditions for measure in group.measures if measure.better]
    return [*judged, *((measure, None) for measure in group.measures if not measure.better)]


def _join(name: str, separator: str, condition: str | None) -> str:
    return name if condition is None else f"{name}{separator}{condition}"


def _order_experiments(group: ComparisonGroup) -> Iterable[tuple[GroupedExperiment, Standing | None]]:
    """Yield the experiments by rank, the strongest attack on each defense first. Without attacks, the most useful comes first."""
    if group.has_attacks:
        for standing in rank_defenses(group):
            others = [experiment for experiment in standing.experiments if experiment is not standing.strongest]
            yield from ((experiment, standing) for experiment in ([standing.strongest] if standing.strongest else []) + others)
        return
    first = next((measure for measure in group.measures if measure.better), None)
    scores = [group.average(experiment, first, group.conditions[0]) if first else None for experiment in group.experiments]
    utilities = [-math.inf if score is None or first is None else first.better * score.mean for score in scores]
    order = sorted(range(len(utilities)), key=lambda index: -utilities[index])
    yield from ((group.experiments[index], None) for index in order)


def _build_row(
    group: ComparisonGroup, columns: Sequence[GroupColumn], experiment: GroupedExperiment, standing: Standing | None
) -> GroupRow:
    privacy, verdict = experiment.metadata["privacy"], group.signals.get(experiment)
    per_image = [value for record in experiment.completed if (value := spent_epsilon(record["privacy"])) is not None]
    count = None if experiment.reason else len(group.complete_samples(experiment))
    known: dict[str, Value] = {
        "rank": standing.rank if standing else None,
        "defense": experiment.defense,
        "guarantee": describe_guarantee(experiment.metadata),
        "epsilon_descriptor": None if privacy["epsilon_descriptor"] is None else float(privacy["epsilon_descriptor"]),
        "epsilon_image": median(per_image) if per_image else None,
        "attack": experiment.attack,
        "signal": verdict.word if verdict else None,
        "log10_true": None if privacy["log10_true"] is None else float(privacy["log10_true"]),
        "units": count,
    }
    for measure, condition in _list_measured(group):
        known[_join(measure.name, "_", condition)] = group.average(experiment, measure, condition)
    values = {column.name: known[column.name] for column in columns}
    note = "; ".join(_list_notes(group, experiment, standing))
    strongest = standing is not None and experiment is (standing.strongest or standing.experiments[0])
    return GroupRow(
        texts=tuple(_format_value(name, value, count) for name, value in values.items()),
        values=values | {"note": note},
        note=note,
        experiment=experiment,
        strongest=strongest,
        competes=count == len(group.samples) and (standing is None or (strongest and standing.rank is not None)),
    )


def _mark_best(columns: Sequence[GroupColumn], rows: Sequence[GroupRow]) -> tuple[GroupRow, ...]:
    """Mark the best value of each column among the rows that compete, unless all are equal."""
    best: dict[int, float] = {}
    for index, column in enumerate(columns):
        values = [value for row in rows if row.competes and (value := comparable_number(row.values[column.name])) is not None]
        if column.better and len(set(values)) > 1:
            best[index] = (max if column.better > 0 else min)(values)
    return tuple(
        dataclasses.replace(
            row,
            best=frozenset(
                index
                for index, value in best.items()
                if row.competes and comparable_number(row.values[columns[index].name]) == value
            ),
        )
        for row in rows
    )


def _format_value(name: str, value: Value, count: int | None) -> str:
    """Return a value as text, with its interval, and with its number of samples if that differs from the row's."""
    if value is None:
        return NOT_APPLICABLE
    if name == "log10_true" and isinstance(value, float):
        return format_chance(value)
    if isinstance(value, Interval):
        if name.startswith(RANK_1_COLUMNS):
            return format_fraction(value)
        return format_interval(value) + (f" (n = {value.count})" if value.count != count else "")
    return format_number(value) if isinstance(value, float) else str(value)


def _get_mean(group: ComparisonGroup, experiment: GroupedExperiment) -> float:
    """Return the mean reciprocal rank of an experiment; 0 if it has none."""
    (identified,) = list_measures([chance.IDENTIFIED])
    average = group.average(experiment, identified)
    return average.mean if average else 0.0


def _list_notes(group: ComparisonGroup, experiment: GroupedExperiment, standing: Standing | None) -> Iterator[str]:
    """Yield the reasons for a missing rank or missing values, the failures, and the notes that all records have."""
    unranked_reason = standing.unranked_reason if standing else None
    if unranked_reason:
        yield f"unranked: {unranked_reason}"
    if standing and standing.identifying and experiment is standing.strongest and standing.identifying is not experiment:
        assert standing.identification is not None
        if standing.identification.mean > _get_mean(group, experiment):
            yield f"ranked by {format_number(standing.identification.mean)} identified by {standing.identifying.attack}"
    if experiment.reason:
        if experiment.reason != unranked_reason:
            yield experiment.reason
        return
    if missing := group.count_missing(experiment):
        yield f"{missing} of {len(group.samples)} samples missing"
    if failed := experiment.failed:
        yield f"{len(failed)} failed: {failed[0]['sample']}: {failed[0]['reason']}"
    verdict = group.signals.get(experiment)
    if verdict and verdict.is_absent and verdict.text != unranked_reason:
        yield verdict.text
    completed = experiment.completed
    yield from list_rejected(completed)
    first_notes = completed[0].get("notes", ()) if completed else ()
    yield from (note for note in first_notes if all(note in record["notes"] for record in completed))
    if uncovered := [part for part in experiment.metadata["privacy"].get("uncovered", ()) if part not in UNCOVERED]:
        yield f"also not covered: {', '.join(uncovered)}"
