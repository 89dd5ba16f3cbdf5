"""How far a run is, told by its folder alone: by the plan, the records, and what its writer has in hand."""

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
    """Units by how far they are. Each is one of these."""

    done: int = 0
    running: int = 0  # in the hand of a process that lives
    failed: int = 0  # and tried again by the next run
    missing: int = 0

    def __add__(self, other: Count) -> Count:
        both = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        return Count(**{field.name: sum(pair) for field, pair in zip(dataclasses.fields(self), both, strict=True)})


@dataclass(frozen=True, kw_only=True, eq=False)
class ExperimentStatus:
    """How far a cell is."""

    metadata: Mapping[str, Any]  # what its records begin with
    count: Count
    reason: str | None  # why it does not apply, if it does not


@dataclass(frozen=True, kw_only=True, eq=False)
class Status:
    """How far the last plan of a folder is."""

    experiments: tuple[ExperimentStatus, ...]
    other: int  # records of other plans, or of other source, libraries or machines
    writer: Mapping[str, Any] | None  # who is at work, or was when it ended without notice
    alive: bool  # whether somebody is

    @property
    def count(self) -> Count:
        """Of all cells that apply."""
        return sum((cell.count for cell in self.experiments if cell.reason is None), Count())

    @property
    def inapplicable(self) -> int:
        """Cells that do not apply."""
        return sum(cell.reason is not None for cell in self.experiments)


def status(out: Path) -> Status:
    """How far that folder's run is.

    Raises
    ------
    UserError
        if nothing was run there, or a file of it is damaged.
    """
    plans = directory.read_plan(out)
    file = out / records.FILE
    found = {records.key(record): record for record in (records.read(file).records if file.is_file() else ())}
    alive, writer = records.is_locked(file), directory.read_running(out)
    in_hand = {(run_hash, unit) for run_hash, unit in (writer or {}).get("jobs", ())} if alive else set()
    cells = {}
    for plan in plans:
        for cell in plan["cells"]:
            states = Counter(_state((cell["run_hash"], unit), found, in_hand) for unit in plan["units"])
            count = Count() if cell["reason"] else Count(**states)
            cells[cell["run_hash"]] = ExperimentStatus(metadata=cell, count=count, reason=cell["reason"])
    planned = {(cell["run_hash"], unit) for plan in plans for cell in plan["cells"] for unit in (*plan["units"], EVERY_SAMPLE)}
    return Status(experiments=tuple(cells.values()), other=len(found.keys() - planned), writer=writer, alive=alive)


def summarize(found: Status) -> str:
    """A status in one line."""
    count = found.count
    parts = [
        f"{count.done} done, {count.running} running, {count.failed} failed, {count.missing} missing",
        f"{found.inapplicable} pairs n/a" if found.inapplicable else "",
        *([f"{found.other} records of other runs"] if found.other else []),
        _writer(found),
    ]
    return "; ".join(part for part in parts if part)


def _writer(found: Status) -> str:
    if found.writer is None:
        return "" if not found.alive else "beginning"
    since = datetime.fromtimestamp(found.writer["since"])
    who = f"{found.writer['engine']} of process {found.writer['pid']} on {found.writer['host']}, since {since:%Y-%m-%d %H:%M}"
    return f"running: {who}" if found.alive else f"ended without notice: {who}; run it again to go on"


def _state(key: tuple[str, str], found: Mapping[tuple[str, str], Record], in_hand: set[tuple[str, str]]) -> str:
    record = found.get(key)
    if record is not None and record["status"] != "failed":
        return "done"
    if key in in_hand:
        return "running"
    return "missing" if record is None else "failed"
