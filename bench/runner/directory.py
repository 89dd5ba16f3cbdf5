"""Files in the folder of a run beside its records: the plan, pictures, tracebacks, and the running jobs.

`bench status` reads only these files and the records. `plan.json` is the last plan of the folder. `running.json` lists the
running jobs. The lock on the records shows whether their process runs: the operating system releases it when the process ends.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from bench.core import paths, strict_json
from bench.core.errors import SampleError, UserError
from bench.runner.record_shape import is_plugin
from bench.runner.records import Record, key

if TYPE_CHECKING:
    from bench.runner.engines.base import Job
    from bench.runner.plan import Plan
    from bench.runner.trial import Result

ERRORS = "errors.log"
# Errors of one path, and not of the disk: the name is too long for the system, or a file has the name of a folder.
ERRORS_OF_NAMES = {errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ELOOP}
PLAN = "plan.json"
RUNNING = "running.json"
LATEST = 250_000_000_000  # seconds since the epoch; later times have no date
METADATA = ("task", "defense", "attack", "dataset", "seed", "experiment_id", "run_hash")  # of an experiment, in the plan's file


def reconstruction_path(out: Path, record: Record) -> Path:
    """Return the path of a record's reconstruction. For records of schema 1 the folder is `cell_id`."""
    experiment = paths.assign_path(out / "reconstructions", str(record.get("cell_id", record["experiment_id"])))
    return paths.assign_path(experiment, record["sample"], ".png")


def photograph_path(out: Path, record: Record) -> Path:
    """Return the path of a record's photograph, as it was attacked. Its folder is a hash: datasets can have equal names."""
    content = record["dataset"]["hash"].removeprefix("sha256:")[:16]
    return paths.assign_path(paths.assign_path(out / "photographs", content), record["sample"], ".png")


def figure_path(out: Path, sample: str) -> Path:
    """Return the path of the figure with all reconstructions of a sample."""
    return paths.assign_path(out / "figures", sample, ".png")


def write_result(result: Result, out: Path) -> None:
    """Write the files that belong to a record, before the record itself.

    Raises
    ------
    SampleError
        if the system does not accept the path of one of them.
    OSError
        if one cannot be written, for example to a full disk.
    """
    for content, path in (
        (result.reconstruction, reconstruction_path(out, result.record)),
        (result.photograph, photograph_path(out, result.record)),
    ):
        if content is not None:
            _write_picture(path, content)
    if result.trace is not None:
        with (out / ERRORS).open("a", encoding="utf-8", errors="backslashreplace") as log:
            log.write(f"{result.record['sample']}\n{result.trace}\n")


def _write_picture(path: Path, content: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    except OSError as error:
        if error.errno not in ERRORS_OF_NAMES:
            raise
        raise SampleError(f"its picture cannot be written to {path}: {error.strerror}") from error


def write_plan(out: Path, plans: Sequence[Plan]) -> None:
    """Write the plans.

    Raises
    ------
    OSError
        if the file cannot be written.
    """
    content = [
        {
            "samples": [sample.name for sample in plan.samples],
            "experiments": [
                {name: experiment.metadata[name] for name in METADATA} | {"reason": experiment.reason}
                for experiment in plan.experiments
            ],
        }
        for plan in plans
    ]
    _replace(out / PLAN, content)


def read_plan(out: Path) -> list[dict[str, Any]]:
    """Read the plans.

    Raises
    ------
    UserError
        if there are none, or the file is damaged or of version 0.1.
    """
    path = out / PLAN
    try:
        plans = strict_json.parse(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; nothing was run there") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}; repeat the run to write the file again") from None
    if not isinstance(plans, list) or not all(map(_is_plan, plans)):
        raise UserError(f"{path}: written by another version of this program; repeat the run to write the file again")
    return plans


class RunningJobs:
    """The running jobs, in a file that exists during the run."""

    def __init__(self, out: Path, engine: str) -> None:
        self._path = out / RUNNING
        self._writer = {"host": socket.gethostname(), "pid": os.getpid(), "engine": engine, "since": time.time()}
        self._jobs: dict[tuple[str, str], None] = {}

    def __enter__(self) -> Self:
        self._write()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._path.unlink(missing_ok=True)

    def track(self, jobs: Iterable[Job]) -> Iterator[Job]:
        """Yield the jobs, and add each to the file when it is taken."""
        for job in jobs:
            self._jobs[job.key] = None
            self._write()
            yield job

    def remove(self, record: Record) -> None:
        """Remove the job of that record."""
        self._jobs.pop(key(record), None)

    def _write(self) -> None:
        with contextlib.suppress(OSError):  # no result depends on this file
            _replace(self._path, self._writer | {"jobs": list(self._jobs)})


def read_running(out: Path) -> dict[str, Any] | None:
    """Return the process that writes, or that ended before the run was complete; None if there is none."""
    try:
        running = strict_json.parse((out / RUNNING).read_bytes())
    except (OSError, ValueError):
        return None
    return running if _is_running(running) else None


def _is_plan(plan: Any) -> bool:
    """Return whether a value is a plan of this version, as `write_plan` writes it."""
    if not isinstance(plan, dict) or not _is_texts(plan.get("samples")) or not isinstance(plan.get("experiments"), list):
        return False
    return all(
        isinstance(experiment, dict)
        and {*METADATA, "reason"} <= experiment.keys()
        and isinstance(experiment["reason"], str | None)
        and all(isinstance(experiment[name], str) for name in ("task", "run_hash"))
        and all(is_plugin(experiment[name]) for name in ("defense", "attack") if experiment[name] is not None)
        for experiment in plan["experiments"]
    )


def _is_running(running: Any) -> bool:
    """Return whether a value is the content of `running.json`."""
    if not isinstance(running, dict) or not {"host", "pid", "engine", "since"} <= running.keys():
        return False
    jobs, since = running.get("jobs", []), running["since"]
    known = isinstance(since, int | float) and 0 <= since < LATEST and isinstance(jobs, list)
    return known and all(_is_texts(job) and len(job) == 2 for job in jobs)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


def _replace(path: Path, value: Any) -> None:
    """Write atomically: a reader gets the old or the new content."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.unfinished")
    unfinished.write_text(json.dumps(value, allow_nan=False), encoding="utf-8")
    unfinished.replace(path)
