"""Runs the rows of a table, and evaluates its claims from the records."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from bench.api import Dataset
from bench.core.progress import Progress
from bench.images import photographs, samples
from bench.images.photographs import Source
from bench.images.samples import Sample
from bench.runner.engines import IN_PROCESS, Engine
from bench.runner.execute import execute, sort_records
from bench.runner.plan import Plan, RunConfiguration, build_plan
from bench.runner.records import Record
from bench.runner.trial import dry_run
from bench.task_api import Task
from leaderboard.chance import IDENTIFICATION
from leaderboard.identification import measure_bits, measure_reciprocal
from leaderboard.intervals import Interval, interval, proportion, rank_correlation
from leaderboard.reproduce import study
from leaderboard.reproduce.claims import ClaimResult, TableEntry, judge_claims
from leaderboard.reproduce.profiles import Profile, Setting
from leaderboard.reproduce.study import Measure, Row, Table
from leaderboard.signal import Signal, judge_experiments
from leaderboard.tables import list_rejected


@dataclass(frozen=True, kw_only=True, eq=False)
class EvaluationSet:
    """The samples of a reproduction: photographs, or the queries or all images of a scene."""

    name: str  # a description in the plural
    names: tuple[str, ...]
    available: int  # how many there are
    photographs: tuple[Source, ...] = ()  # empty for a dataset
    dataset: Dataset | None = None  # None for photographs

    @property
    def samples(self) -> tuple[Sample, ...]:
        """The samples of the records."""
        return (
            samples.collect_photographs(self.photographs) if self.dataset is None else samples.collect_queries(self.dataset)
        ).samples


@dataclass(frozen=True, kw_only=True, eq=False)
class RunResult:
    """Rows and their records."""

    rows: tuple[Row, ...]
    experiment_ids: Mapping[str, tuple[str, ...]]  # row's name -> the cell_id of its records, one per seed
    records: Mapping[str, tuple[Record, ...]]  # cell_id -> its records


@dataclass(frozen=True, kw_only=True, eq=False)
class ReproducedTable:
    """A reproduced table beside the paper's."""

    definition: Table
    setting: Setting
    evaluation_set: EvaluationSet
    result: RunResult
    ours: Mapping[TableEntry, Interval]  # entries with values only
    notes: Mapping[str, str]  # row's name -> why it has no values, or remarks on them
    correlation: float | None  # Spearman's, without reference rows
    claim_results: tuple[ClaimResult, ...]
    signals: Mapping[str, Signal]  # of the rows whose attack returns images


def select_photographs(images: Path | None, profile: Profile, limit: int) -> EvaluationSet:
    """Return the first `limit` photographs of a folder, or of the profile's built-in ones for None.

    Raises
    ------
    UserError
        if the folder does not exist or holds no photograph.
    """
    if images is None:
        sources = [source for source in photographs.list_builtin() if profile.builtin is None or source.name in profile.builtin]
        return _build_evaluation_set("built-in photographs", sources, limit)
    return _build_evaluation_set(f"photographs of {photographs.name_images(images)}", photographs.list_photographs(images), limit)


def _build_evaluation_set(name: str, sources: Sequence[Source], limit: int) -> EvaluationSet:
    selection = tuple(sources[:limit])
    return EvaluationSet(
        name=name, names=tuple(source.name for source in selection), available=len(sources), photographs=selection
    )


def select_queries(dataset: Dataset) -> EvaluationSet:
    """Return all queries of a dataset.

    Raises
    ------
    UserError
        if the dataset is damaged.
    """
    scene = dataset.scene()
    names = tuple(query.name for query in scene.queries)
    return EvaluationSet(name=f"queries of {scene.name}", names=names, available=len(names), dataset=dataset)


def reproduce_table(
    table: Table, setting: Setting, evaluation_set: EvaluationSet, out: Path, engine: Engine = IN_PROCESS
) -> ReproducedTable:
    """Run the rows that `out` has no records of, and evaluate the claims.

    Raises
    ------
    UserError
        if a file is missing or does not fit; nothing is written then.
    """
    rows = (*table.build_rows(setting), *table.build_reference_rows(setting))
    result = run_rows(rows, setting, evaluation_set, out, table.name, engine, list_seeds(table, setting))
    return compare_with_paper(table, setting, evaluation_set, result)


def list_seeds(table: Table, setting: Setting) -> range:
    """Return the seeds of a table's rows."""
    return range(setting.seed, setting.seed + (setting.profile.seeds if table.multiple_seeds else 1))


def run_rows(
    rows: Sequence[Row],
    setting: Setting,
    evaluation_set: EvaluationSet,
    out: Path,
    title: str,
    engine: Engine = IN_PROCESS,
    seeds: Iterable[int] | None = None,
) -> RunResult:
    """Run the rows, one plan per task and seed. `seeds` None: the seed of the setting.

    Records in `out` are reused.
    """
    tasks = dict.fromkeys(row.task for row in rows)
    plans = [
        _plan_task(task, rows, setting, evaluation_set, seed)
        for seed in ((setting.seed,) if seeds is None else seeds)
        for task in tasks
    ]
    experiment_ids = {row.name: _list_experiment_ids(row, plans) for row in rows}
    unordered: list[Record] = []
    with Progress(
        f"{title}: {len(evaluation_set.names)} {evaluation_set.name}, {len(rows)} rows", sum(map(len, plans))
    ) as progress:
        for record in execute(plans, out, engine):
            unordered.append(record)
            progress.advance(note=record["sample"])
            if record["status"] == "failed":
                progress.log(f"bench: failed: {record['sample']}, {record['defense']['name']}: {record['reason']}")
    records: dict[str, list[Record]] = {}
    for record in sort_records(plans, unordered):
        records.setdefault(record["experiment_id"], []).append(record)
    return RunResult(
        rows=tuple(rows), experiment_ids=experiment_ids, records={key: tuple(group) for key, group in records.items()}
    )


def compare_with_paper(table: Table, setting: Setting, evaluation_set: EvaluationSet, result: RunResult) -> ReproducedTable:
    """Return means, intervals, rank correlation and verdicts, computed from records alone."""
    reasons = {row.name: reason for row in result.rows if (reason := _explain_missing(select_records(result, row.name)))}
    columns = _collect_values(table, result)
    paper = study.collect_paper_values(result.rows)
    signals = _judge_signals(result)
    no_evidence = {row: signal.text for row, signal in signals.items() if signal.is_absent or signal.is_untested}
    ours = {entry: _compute_interval(table.measures[entry[1]], column) for entry, column in columns.items() if len(column)}
    return ReproducedTable(
        definition=table,
        setting=setting,
        evaluation_set=evaluation_set,
        result=result,
        ours=ours,
        notes={row.name: reasons.get(row.name) or _summarize_notes(select_records(result, row.name)) for row in result.rows},
        correlation=_correlate_ranks(table, table.build_rows(setting), ours),
        claim_results=judge_claims(table.build_claims(paper), pd.DataFrame(columns), paper, reasons, no_evidence),
        signals=signals,
    )


def select_records(result: RunResult, row: str) -> tuple[Record, ...]:
    """Return the records of a row, ordered by seed."""
    return tuple(record for key in result.experiment_ids[row] for record in result.records.get(key, ()))


def list_records(result: RunResult) -> list[Record]:
    """Return all records."""
    return [record for group in result.records.values() for record in group]


def count_failures(result: RunResult) -> int:
    """Return the number of failed records."""
    return sum(record["status"] == "failed" for record in list_records(result))


def _judge_signals(result: RunResult) -> dict[str, Signal]:
    records = {row.name: select_records(result, row.name) for row in result.rows}
    known = {name: each for name, each in records.items() if each}
    signals = zip(known, judge_experiments(list(known.values())), strict=True)
    return {name: signal for name, signal in signals if signal is not None}


def _get_value(measure: Measure, record: Record) -> float | None:
    value: float | None = record["metrics"].get(measure.metric)
    worst = math.inf if measure.median and measure.metric in record["metrics"] else None
    return worst if value is None else value


def _compute_interval(measure: Measure, column: pd.Series) -> Interval:
    if measure.median:
        return Interval(float(column.median()), -math.inf, math.inf, len(column))
    if measure.identification == "bits":
        return measure_bits(column)
    if measure.identification == "rank 1":
        return proportion(column == 1)
    if measure.metric in IDENTIFICATION:
        return measure_reciprocal(column)
    return proportion(column / measure.factor, measure.factor) if measure.fraction else interval(column)


def _plan_task(task: Task, rows: Sequence[Row], setting: Setting, evaluation_set: EvaluationSet, seed: int) -> Plan:
    pairs = [(row.defense, row.attack) for row in rows if row.task == task]
    defenses = list(dict.fromkeys(defense for defense, _ in pairs))
    pairs.sort(key=lambda pair: defenses.index(pair[0]))  # so that each defense protects each photograph once
    configuration = RunConfiguration(
        pairs=tuple(pairs),
        images=evaluation_set.photographs or None,
        task=task,
        extractor=setting.extractor,
        dataset=evaluation_set.dataset,
        seed=seed,
    )
    plan = build_plan(configuration)
    dry_run(plan)
    return plan


def _list_experiment_ids(row: Row, plans: Sequence[Plan]) -> tuple[str, ...]:
    return tuple(
        str(experiment.metadata["experiment_id"])
        for plan in plans
        for experiment in plan.experiments
        if (plan.task, experiment.defense, experiment.attack) == (row.task, row.defense, row.attack)
    )


def _collect_values(table: Table, result: RunResult) -> dict[TableEntry, pd.Series]:
    """Return the values of each entry by sample and seed, in the paper's unit of measurement."""
    return {
        (row.name, name): pd.Series(
            {
                f"{record['sample']} {record['seed']}": value * measure.factor
                for record in select_records(result, row.name)
                if record["status"] == "ok" and measure.condition in (None, record.get("condition"))
                if (value := _get_value(measure, record)) is not None
            },
            dtype=float,
        )
        for row in result.rows
        for name, measure in table.measures.items()
    }


def _correlate_ranks(table: Table, rows: Iterable[Row], ours: Mapping[TableEntry, Interval]) -> float | None:
    if table.rank_measure is None:
        return None
    pairs = [
        (row.paper[table.rank_measure], ours[row.name, table.rank_measure].mean)
        for row in rows
        if table.rank_measure in row.paper and (row.name, table.rank_measure) in ours
    ]
    return rank_correlation(*zip(*pairs, strict=True)) if len(pairs) > 1 else None


def _explain_missing(records: Sequence[Record]) -> str | None:
    """Return why a row has no values; None if it has some."""
    if any(record["status"] == "ok" for record in records):
        return None
    reasons = dict.fromkeys(str(record["reason"]) for record in records)
    return "n/a: " + "; ".join(reasons) if reasons else "n/a"


def _summarize_notes(records: Sequence[Record]) -> str:
    """Return the notes that all samples of a row share, and how many samples failed or were rejected."""
    succeeded = [record for record in records if record["status"] == "ok"]
    common = [note for note in succeeded[0]["notes"] if all(note in record["notes"] for record in succeeded)]
    failed = len(records) - len(succeeded)
    return "; ".join([*([f"{failed} failed"] if failed else []), *list_rejected(succeeded), *common])
