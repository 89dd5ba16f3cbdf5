"""Runs the rows of a table through the runner, and weighs its claims by what came out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.api import Dataset, Task
from bench.core.progress import Progress
from bench.images import photographs, samples
from bench.images.photographs import Source
from bench.images.samples import Sample
from bench.runner import plan as runner
from bench.runner.engines import IN_PROCESS, Engine
from bench.runner.plan import Plan
from bench.runner.records import Record
from leaderboard.intervals import Interval, interval, proportion, rank_correlation
from leaderboard.reproduce import study
from leaderboard.reproduce.claims import Cell, Finding, judge
from leaderboard.reproduce.profiles import Profile, Setting
from leaderboard.reproduce.study import Measure, Row, Table


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """What a reproduction is made of: photographs, or the queries or the whole of a place."""

    name: str  # in words, in the plural
    names: tuple[str, ...]
    available: int
    chosen: tuple[Source, ...] = ()  # the photographs
    dataset: Dataset | None = None  # the place

    @property
    def units(self) -> tuple[Sample, ...]:
        """What records are about."""
        return (
            samples.collect_photographs(self.chosen) if self.dataset is None else samples.collect_queries(self.dataset)
        ).samples


@dataclass(frozen=True, kw_only=True, eq=False)
class Ran:
    """Rows, and what the runner recorded of them."""

    rows: tuple[Row, ...]
    cells: Mapping[str, tuple[str, ...]]  # row's name -> the cell_id of its records, for each seed
    records: Mapping[str, tuple[Record, ...]]  # cell_id -> its records


@dataclass(frozen=True, kw_only=True, eq=False)
class Rebuilt:
    """A table beside the paper's."""

    table: Table
    setting: Setting
    judged: Judged
    ran: Ran
    ours: Mapping[Cell, Interval]  # those that there are
    notes: Mapping[str, str]  # row's name -> why it has no values, or what a reader should know of them
    correlation: float | None  # Spearman's, over the table's own rows
    findings: tuple[Finding, ...]


def choose(images: Path | None, profile: Profile, most: int) -> Judged:
    """The photographs of a folder by name, or the built-in ones that the profile takes, at most so many.

    Raises
    ------
    UserError
        if the folder does not exist or holds no photograph.
    """
    if images is None:
        sources = [source for source in photographs.builtin() if profile.builtin is None or source.name in profile.builtin]
        return _photographs("built-in photographs", sources, most)
    return _photographs(f"photographs of {images.resolve().name}", photographs.folder(images), most)


def _photographs(name: str, sources: Sequence[Source], most: int) -> Judged:
    chosen = tuple(sources[:most])
    return Judged(name=name, names=tuple(source.name for source in chosen), available=len(sources), chosen=chosen)


def queries(dataset: Dataset) -> Judged:
    """All queries of a place.

    Raises
    ------
    UserError
        if it is damaged.
    """
    scene = dataset.scene()
    names = tuple(query.name for query in scene.queries)
    return Judged(name=f"queries of {scene.name}", names=names, available=len(names), dataset=dataset)


def rebuild(table: Table, setting: Setting, judged: Judged, out: Path, engine: Engine = IN_PROCESS) -> Rebuilt:
    """Run what `out` does not hold yet, and weigh the claims.

    Raises
    ------
    UserError
        if a file is missing or does not fit; nothing has been written then.
    """
    rows = (*table.rows(setting), *table.borrowed(setting))
    return weigh(table, setting, judged, execute(rows, setting, judged, out, table.name, engine, seeds(table, setting)))


def seeds(table: Table, setting: Setting) -> range:
    """That a table is done with."""
    return range(setting.seed, setting.seed + (setting.profile.seeds if table.repeated else 1))


def execute(
    rows: Sequence[Row],
    setting: Setting,
    judged: Judged,
    out: Path,
    title: str,
    engine: Engine = IN_PROCESS,
    seeds: Iterable[int] | None = None,
) -> Ran:
    """Run the rows, one plan for each task and seed, that of the setting alone for None.

    Records that `out` holds are not made again.
    """
    tasks, each = dict.fromkeys(row.task for row in rows), (setting.seed,) if seeds is None else seeds
    plans = [_plan(task, rows, setting, judged, seed) for seed in each for task in tasks]
    cells = {row.name: _cells(row, plans) for row in rows}
    found: list[Record] = []
    with Progress(f"{title}: {len(judged.names)} {judged.name}, {len(rows)} rows", sum(map(len, plans))) as progress:
        for record in runner.execute(plans, out, engine):
            found.append(record)
            progress.advance(note=record["unit"])
            if record["status"] == "failed":
                progress.say(f"bench: failed: {record['unit']}, {record['defense']['name']}: {record['reason']}")
    records: dict[str, list[Record]] = {}
    for record in runner.sort_records(plans, found):
        records.setdefault(record["cell_id"], []).append(record)
    return Ran(rows=tuple(rows), cells=cells, records={cell: tuple(its) for cell, its in records.items()})


def weigh(table: Table, setting: Setting, judged: Judged, ran: Ran) -> Rebuilt:
    """Means, intervals, rank correlation and verdicts from records alone."""
    reasons = {row.name: reason for row in ran.rows if (reason := _reason(of(ran, row.name)))}
    columns = _columns(table, ran)
    paper = study.printed(ran.rows)
    ours = {cell: _interval(table.measures[cell[1]], column) for cell, column in columns.items() if len(column)}
    return Rebuilt(
        table=table,
        setting=setting,
        judged=judged,
        ran=ran,
        ours=ours,
        notes={row.name: reasons.get(row.name) or _notes(of(ran, row.name)) for row in ran.rows},
        correlation=_correlation(table, table.rows(setting), ours),
        findings=judge(table.claims(paper), pd.DataFrame(columns), paper, reasons),
    )


def of(ran: Ran, row: str) -> tuple[Record, ...]:
    """The records of a row, those of the first seed first."""
    return tuple(record for cell in ran.cells[row] for record in ran.records.get(cell, ()))


def failures(ran: Ran) -> int:
    """Records of photographs that could not be done."""
    return sum(record["status"] == "failed" for records in ran.records.values() for record in records)


def _value(measure: Measure, record: Record) -> float | None:
    value: float | None = record["metrics"].get(measure.metric)
    worst = math.inf if measure.median and measure.metric in record["metrics"] else None
    return worst if value is None else value


def _interval(measure: Measure, column: pd.Series) -> Interval:
    if measure.median:
        return Interval(float(column.median()), -math.inf, math.inf, len(column))
    return proportion(column / measure.times, measure.times) if measure.share else interval(column)


def _plan(task: Task, rows: Sequence[Row], setting: Setting, judged: Judged, seed: int) -> Plan:
    pairs = [(row.defense, row.attack) for row in rows if row.task == task]
    defenses = list(dict.fromkeys(defense for defense, _ in pairs))
    pairs.sort(key=lambda pair: defenses.index(pair[0]))  # so that each photograph is protected once by each
    return runner.prepare_pairs(
        pairs, judged.chosen or None, task=task, extractor=setting.extractor, dataset=judged.dataset, seed=seed
    )


def _cells(row: Row, plans: Sequence[Plan]) -> tuple[str, ...]:
    return tuple(
        str(cell.metadata["cell_id"])
        for plan in plans
        for cell in plan.experiments
        if (plan.task, cell.defense, cell.attack) == (row.task, row.defense, row.attack)
    )


def _columns(table: Table, ran: Ran) -> dict[Cell, pd.Series]:
    """The values of each cell by unit and seed, in the paper's unit of measurement."""
    return {
        (row.name, measure): pd.Series(
            {
                f"{record['unit']} {record['seed']}": value * wanted.times
                for record in of(ran, row.name)
                if record["status"] == "ok" and wanted.condition in (None, record.get("condition"))
                if (value := _value(wanted, record)) is not None
            },
            dtype=float,
        )
        for row in ran.rows
        for measure, wanted in table.measures.items()
    }


def _correlation(table: Table, rows: Iterable[Row], ours: Mapping[Cell, Interval]) -> float | None:
    if table.ordered is None:
        return None
    both = [
        (row.paper[table.ordered], ours[row.name, table.ordered].mean)
        for row in rows
        if table.ordered in row.paper and (row.name, table.ordered) in ours
    ]
    return rank_correlation(*zip(*both, strict=True)) if len(both) > 1 else None


def _reason(records: Sequence[Record]) -> str | None:
    """Why a row has no values; None if it has some."""
    if any(record["status"] == "ok" for record in records):
        return None
    told = dict.fromkeys(str(record["reason"]) for record in records)
    return "n/a: " + "; ".join(told) if told else "n/a"


def _notes(records: Sequence[Record]) -> str:
    """What all photographs of a row share, and how many failed."""
    done = [record for record in records if record["status"] == "ok"]
    shared = [note for note in done[0]["notes"] if all(note in record["notes"] for record in done)]
    failed = len(records) - len(done)
    return "; ".join([*([f"{failed} failed"] if failed else []), *shared])
