"""Execution of plans: yields records, resumes, and continues after failures.

All attacks receive the same release. A resumed run gives the same records as an uninterrupted one, with every engine.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from bench.api import Attack, Dataset, Defense, Extractor, Metric
from bench.core.errors import SampleError, UserError
from bench.images.samples import Images
from bench.registry import discovery, spec
from bench.runner import directory, records, trial
from bench.runner.consistency import list_contradictions
from bench.runner.engines.base import IN_PROCESS, Engine, Job
from bench.runner.plan import Plan, RunConfiguration, build_plan, cross
from bench.runner.records import EVERY_SAMPLE, Record
from bench.runner.trial import Result, dry_run
from bench.task_api import Task


def run(
    defenses: Sequence[Defense],
    attacks: Sequence[Attack] = (),
    images: Images = None,
    *,
    extractor: Extractor | None = None,
    task: Task | None = None,
    dataset: Dataset | None = None,
    seed: int = 0,
    metrics: Sequence[Metric] = (),
    out: Path | str | None = None,
) -> list[Record]:
    """Run every defense against every attack, and return one record for each sample of each pair.

    Parameters
    ----------
    defenses, attacks : plugins, such as `[LDP(epsilon=10)]` and `[DIA()]`
    images : a folder, a dataset of torchvision, files or sources; None for the built-in photographs
    extractor : `Sift()` if None
    task : `Reconstruction()` if None
    dataset : the scene, for a task that needs one
    seed : seed of all random numbers. A release with a known seed is for measurements and protects nobody.
    metrics : metrics that need a setting, such as a file, or an optional extra, such as `list_extra_metrics()` of
        `bench.runner.plan`; all other metrics are always computed
    out : a folder for records and reconstructions; finished records in it are not computed again

    Raises
    ------
    UserError
        if an argument is invalid. Nothing has been written.
    """
    task = task or spec.read("reconstruction", discovery.TASK)
    configuration = RunConfiguration(
        pairs=cross(task, defenses, attacks),
        images=images,
        task=task,
        extractor=extractor or spec.read("sift", discovery.EXTRACTOR),
        dataset=dataset,
        seed=seed,
        metrics=tuple(metrics),
    )
    plan = build_plan(configuration)
    dry_run(plan)
    return sort_records([plan], execute([plan], None if out is None else Path(out)))


def execute(plans: Sequence[Plan], out: Path | None = None, engine: Engine = IN_PROCESS) -> Iterator[Record]:
    """Execute plans and yield their records: first those in `out`, then new ones as they are computed.

    An experiment that occurs in several plans is executed once. Only this process writes to `out`, with every engine, and no
    other process can write there meanwhile. `sort_records` puts the records into the order of the plans.

    Parameters
    ----------
    out : the folder to write or resume; None stores nothing
    engine : executes the jobs; by default this process, in the order of the plans

    Raises
    ------
    UserError
        before anything is written, if `out` cannot be written, holds a damaged record or one that contradicts the plan, or
        another process writes to it.
    OSError
        if the disk is full; every record yielded so far is stored.
    """
    if out is None:
        yield from (result.record for result in _run_missing(plans, set(), engine))
        return
    with records.Log(out / records.FILE) as log:
        if log.before.notice:
            logging.getLogger(__name__).warning(log.before.notice)
        resumed = _select_finished(plans, log.before, out / records.FILE)
        directory.write_plan(out, plans)
        yield from resumed
        with directory.RunningJobs(out, engine.name) as running:
            for result in _run_missing(plans, set(map(records.key, resumed)), engine, running.track):
                record = result.record
                try:
                    directory.write_result(result, out)
                except SampleError as error:
                    record = trial.fail(record, str(error))
                log.append(record)
                running.remove(record)
                yield record


def _select_finished(plans: Sequence[Plan], held: records.Contents, file: Path) -> list[Record]:
    """Return the finished records of the plans, in their order.

    Raises
    ------
    UserError
        if one of them contradicts the plan or the range of a metric.
    """
    finished = {
        records.key(record): (number, record)
        for number, record in zip(held.numbers, held.records, strict=True)
        if record["status"] != "failed"
    }
    resumed = {}
    for plan in plans:
        experiments = {experiment.metadata["run_hash"]: experiment for experiment in plan.experiments}
        conditions = {sample.name: sample.condition for sample in plan.samples}
        for key in plan.list_record_keys():
            if key not in finished or key in resumed:
                continue
            number, record = finished[key]
            for contradiction in list_contradictions(record, experiments[key[0]], conditions.get(key[1])):
                raise UserError(f"{file}, line {number}: {contradiction}; remove the line, and its sample is computed again")
            resumed[key] = record
    return list(resumed.values())


def sort_records(plans: Sequence[Plan], unsorted: Iterable[Record]) -> list[Record]:
    """Return records in the order of the plans, which does not depend on the engine."""
    keys = dict.fromkeys(key for plan in plans for key in plan.list_record_keys())
    order = {key: number for number, key in enumerate(keys)}
    return sorted(unsorted, key=lambda record: order[records.key(record)])


def _run_missing(
    plans: Sequence[Plan],
    finished: set[tuple[str, str]],
    engine: Engine,
    track: Callable[[Iterator[Job]], Iterator[Job]] = lambda jobs: jobs,
) -> Iterator[Result]:
    """Yield the missing results. Those of experiments that do not apply need no engine and come first."""
    begun = set(finished)
    for experiment in (experiment for plan in plans for experiment in plan.experiments if experiment.reason is not None):
        if (key := (experiment.metadata["run_hash"], EVERY_SAMPLE)) not in begun:
            begun.add(key)
            yield Result(record=trial.build_record(experiment, None, status="n/a", reason=experiment.reason))
    jobs: dict[tuple[str, str], Job] = {}
    for plan in plans:
        applicable = [experiment for experiment in plan.experiments if experiment.reason is None]
        for job in (Job(plan, experiment, sample) for sample in plan.samples for experiment in applicable):
            if job.key not in finished:
                jobs.setdefault(job.key, job)
    yield from engine(track(iter(jobs.values())))
