"""Status of a run, from the files in its folder: the plan, the records, and the running jobs."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.runner import directory, records
from bench.runner.records import EVERY_SAMPLE, Record


@dataclass(frozen=True, kw_only=True)
class Count:
    """Numbers of samples by state. Each sample has one of these states."""

    done: int = 0
    running: int = 0  # in a process that still runs
    failed: int = 0  # the next run repeats them
    missing: int = 0

    def __add__(self, other: Count) -> Count:
        both = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        return Count(**{field.name: sum(pair) for field, pair in zip(dataclasses.fields(self), both, strict=True)})


@dataclass(frozen=True, kw_only=True, eq=False)
class ExperimentStatus:
    """The status of one experiment."""

    metadata: Mapping[str, Any]  # the entries that its records have in common
    count: Count
    reason: str | None  # why it does not apply; None if it does


@dataclass(frozen=True, kw_only=True, eq=False)
class Status:
    """The status of the last plan of a folder."""

    experiments: tuple[ExperimentStatus, ...]
    other: int  # records of other plans, or of other source, libraries or machines
    writer: Mapping[str, Any] | None  # the process that writes, or that ended before the run was complete
    alive: bool  # whether a process writes

    @property
    def count(self) -> Count:
        """The sum over all experiments that apply."""
        return sum((experiment.count for experiment in self.experiments if experiment.reason is None), Count())

    @property
    def inapplicable(self) -> int:
        """The number of experiments that do not apply."""
        return sum(experiment.reason is not None for experiment in self.experiments)


def read_status(out: Path) -> Status:
    """Read the status of a folder.

    Raises
    ------
    UserError
        if nothing was run there, or a file of it is damaged.
    """
    plans = directory.read_plan(out)
    file = out / records.FILE
    latest = {records.key(record): record for record in (records.read(file).records if file.is_file() else ())}
    alive, writer = records.is_locked(file), directory.read_running(out)
    running = {(run_hash, sample) for run_hash, sample in (writer or {}).get("jobs", ())} if alive else set()
    experiments, planned = {}, set()
    for plan in plans:
        for experiment in plan["experiments"]:
            run_hash = experiment["run_hash"]
            states = Counter(_state((run_hash, sample), latest, running) for sample in plan["samples"])
            count = Count() if experiment["reason"] else Count(**states)
            experiments[run_hash] = ExperimentStatus(metadata=experiment, count=count, reason=experiment["reason"])
            planned |= {(run_hash, sample) for sample in (*plan["samples"], EVERY_SAMPLE)}
    return Status(experiments=tuple(experiments.values()), other=len(latest.keys() - planned), writer=writer, alive=alive)


def summarize(status: Status) -> str:
    """Return a status in one line."""
    count = status.count
    parts = [
        f"{count.done} done, {count.running} running, {count.failed} failed, {count.missing} missing",
        f"{status.inapplicable} pairs n/a" if status.inapplicable else "",
        *([f"{status.other} records of other runs"] if status.other else []),
        _describe_writer(status),
    ]
    return "; ".join(part for part in parts if part)


def _describe_writer(status: Status) -> str:
    if status.writer is None:
        return "" if not status.alive else "starting"
    since = datetime.fromtimestamp(status.writer["since"])
    process = f"process {status.writer['pid']} on {status.writer['host']}, since {since:%Y-%m-%d %H:%M}"
    writer = f"{status.writer['engine']} of {process}"
    return f"running: {writer}" if status.alive else f"ended early: {writer}; repeat the command to continue"


def _state(key: tuple[str, str], latest: Mapping[tuple[str, str], Record], running: set[tuple[str, str]]) -> str:
    record = latest.get(key)
    if record is not None and record["status"] != "failed":
        return "done"
    if key in running:
        return "running"
    return "missing" if record is None else "failed"
