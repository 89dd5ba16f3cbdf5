"""What lies in a run's folder beside its records: the plan, pictures, what broke, and who is at work.

`bench status` is told by these files alone. `plan.json` is the last that was asked of the folder. `running.json` says what is
in hand; that its writer lives is told by the lock on the records, which the system lifts whenever a process ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from bench.core.errors import UserError
from bench.runner.records import Record, key

if TYPE_CHECKING:
    from bench.runner.engines import Job
    from bench.runner.plan import Plan
    from bench.runner.trial import Result

ERRORS = "errors.log"
PLAN = "plan.json"
RUNNING = "running.json"
KEPT = ("task", "defense", "attack", "dataset", "seed", "cell_id", "run_hash")  # of a cell's head


def reconstruction_path(out: Path, record: Record) -> Path:
    """Where the reconstruction of a record is kept."""
    return out / "reconstructions" / record["cell_id"] / f"{record['unit']}.png"


def write_result(made: Result, out: Path) -> None:
    """Write what belongs to a record, before the record itself.

    Raises
    ------
    OSError
        if it cannot be written.
    """
    if made.picture is not None:
        path = reconstruction_path(out, made.record)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(made.picture)
    if made.trace is not None:
        with (out / ERRORS).open("a", encoding="utf-8") as log:
            log.write(f"{made.record['unit']}\n{made.trace}\n")


def write_plan(out: Path, plans: Sequence[Plan]) -> None:
    """Write down what is to be done.

    Raises
    ------
    OSError
        if it cannot be written.
    """
    written = [
        {
            "units": [unit.name for unit in plan.samples],
            "cells": [{name: cell.metadata[name] for name in KEPT} | {"reason": cell.reason} for cell in plan.experiments],
        }
        for plan in plans
    ]
    _replace(out / PLAN, written)


def read_plan(out: Path) -> list[dict[str, Any]]:
    """What was written down.

    Raises
    ------
    UserError
        if there is none, or it is damaged.
    """
    path = out / PLAN
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; nothing was run there") from None
    except ValueError as error:
        raise UserError(f"{path}: no JSON ({error}); run what was run there again, and it is written anew") from None


class RunningJobs:
    """The jobs in hand, in a file that is there while there are any."""

    def __init__(self, out: Path, engine: str) -> None:
        self._path = out / RUNNING
        self._who = {"host": socket.gethostname(), "pid": os.getpid(), "engine": engine, "since": time.time()}
        self._jobs: dict[tuple[str, str], None] = {}

    def __enter__(self) -> Self:
        self._write()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._path.unlink(missing_ok=True)

    def taken(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """The jobs, each noted when it is taken."""
        for job in jobs:
            self._jobs[job.key] = None
            self._write()
            yield job

    def done(self, record: Record) -> None:
        """That job is in hand no more."""
        self._jobs.pop(key(record), None)

    def _write(self) -> None:
        with contextlib.suppress(OSError):  # it is for people, and no result depends on it
            _replace(self._path, self._who | {"jobs": list(self._jobs)})


def read_running(out: Path) -> dict[str, Any] | None:
    """Who is at work, or was when it ended without notice; None if nobody."""
    try:
        return json.loads((out / RUNNING).read_bytes())
    except (OSError, ValueError):
        return None


def _replace(path: Path, value: Any) -> None:
    """In one step: whoever reads sees the old or the new."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.unfinished")
    unfinished.write_text(json.dumps(value, allow_nan=False), encoding="utf-8")
    unfinished.replace(path)
