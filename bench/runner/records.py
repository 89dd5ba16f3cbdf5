"""Records: append-only JSON lines, one per sample of each experiment. All tables, plots and pages are derived from them."""

from __future__ import annotations

import errno
import json
import logging
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import RawIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from bench.core import strict_json
from bench.core.errors import UserError
from bench.core.hashing import digest, short_hash
from bench.runner.record_shape import explain_misshapen

if TYPE_CHECKING:
    import pandas as pd

Record = dict[str, Any]

SCHEMA = 2
FILE = "records.jsonl"
EVERY_SAMPLE = "*"  # in a record of a whole experiment, such as one that does not apply
RENAMED_SINCE_1 = {"cell_id": "experiment_id", "unit": "sample"}  # keys of schema 1 -> keys of schema 2


def experiment_id(task: Any, defense: Any, attack: Any, dataset: Mapping[str, Any], seed: int, metric_settings: Any) -> str:
    """Return the hash of the configuration and the inputs. The name of a dataset does not enter."""
    return short_hash([task, defense, attack, _content(dataset), seed, metric_settings])


def run_hash(experiment: str, environment: Mapping[str, Any]) -> str:
    """Return the hash of the experiment and the environment. A run skips records with an equal hash."""
    return short_hash([experiment, environment])


def seal(record: Mapping[str, Any]) -> Record:
    """Return the record with the digest of all its other entries."""
    entries = {name: value for name, value in record.items() if name != "digest"}
    return entries | {"digest": digest(entries)}


def key(record: Record) -> tuple[str, str]:
    """Return the key of a record. Of several records with one key, the last one counts."""
    return record["run_hash"], record["sample"]


@dataclass(frozen=True)
class Contents:
    """Contents of a file of records."""

    records: list[Record]
    numbers: list[int]  # of their lines, counted from 1
    whole: int  # bytes up to the end of the last whole line
    notice: str | None = None  # a warning about an incomplete last line


def read(path: Path) -> Contents:
    """Read a file of records of schema 2 or 1. An incomplete last line, left by a crash, is skipped.

    Records of schema 1 are returned with the keys and hashes of schema 2. They retain `cell_id`, the name of their pictures'
    folder.

    Raises
    ------
    UserError
        if another line is no record, or was changed after it was written; the message names file and line.
    """
    *lines, rest = path.read_bytes().split(b"\n")
    numbers = [number for number, line in enumerate(lines, start=1) if line.strip()]
    contents = [_parse(path, number, lines[number - 1]) for number in numbers]
    whole = sum(len(line) + 1 for line in lines)
    notice = f"{path}: the last line was cut off and is skipped" if rest else None
    return Contents(contents, numbers, whole, notice)


def keep_latest(records: Iterable[Record]) -> list[Record]:
    """Return the last record of each sample of each run of an experiment."""
    return list({key(record): record for record in records}.values())


def find_file(path: str | Path) -> Path:
    """Return the path of a file of records, from that path or from the folder of a run.

    Raises
    ------
    UserError
        if there is no such file.
    """
    file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise UserError(f"{file}: no such file; give a file of records, or a folder that `bench run` wrote")
    return file


def load_records(path: str | Path) -> pd.DataFrame:
    """Return the latest records of a file, or of a folder that `bench run` wrote, as a DataFrame with one row per record.

    Nested keys become columns such as `metrics.ssim`. The text "inf" becomes infinity. Absent entries are missing values.

    Raises
    ------
    UserError
        if there is no such file, or one of its lines is no record.
    """
    import pandas as pd

    contents = read(find_file(path))
    if contents.notice:
        logging.getLogger(__name__).warning(contents.notice)
    return pd.json_normalize([_with_infinity(record) for record in keep_latest(contents.records)])


def is_locked(path: Path) -> bool:
    """Return whether a running process writes to that file of records."""
    if not path.is_file():
        return False
    lock = _file_lock(path)
    try:
        lock.acquire()
    except Timeout:
        return True
    except (OSError, NotImplementedError):
        return False  # a file system without locks, on which no writer can be detected
    lock.release()
    return False


class Log:
    """A file of records, open to append. Each record is passed to the operating system before the next job begins.

    The file is locked while it is open. The operating system releases the lock when the process ends, also after a crash.
    `before` holds the contents at the time of locking.
    """

    def __init__(self, path: Path) -> None:
        """Open the file, or create it, and remove an incomplete last line.

        Raises
        ------
        UserError
            if the file cannot be written, contains other data, or another process writes to it.
        """
        self._lock = _file_lock(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: RawIOBase = path.open("ab", buffering=0)
        except OSError as error:
            raise UserError(f"--out: cannot write {path}: {error.strerror}") from error
        try:
            self._acquire(path)
            self.before = read(path)
            self._file.truncate(self.before.whole)
        except UserError:
            self.close()
            raise

    def _acquire(self, path: Path) -> None:
        try:
            self._lock.acquire()
        except Timeout:
            raise UserError(f"--out: another process is writing to {path}; wait for it, or give another folder") from None
        except (OSError, NotImplementedError):  # a file system without locks
            logging.getLogger(__name__).debug("%s: cannot be locked", path)

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file and release the lock."""
        self._file.close()
        self._lock.release()

    def append(self, record: Record) -> None:
        """Append one record, as a complete line.

        Raises
        ------
        OSError
            if it cannot be written; earlier records stay.
        """
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        if self._file.write(line) != len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def explain_invalid(record: Any) -> str | None:
    """Return the reason why a value is no valid record of schema 2 or 1, by its hashes and its digest; None if it is valid."""
    if not isinstance(record, dict) or type(record.get("schema")) is not int or record["schema"] not in (1, SCHEMA):
        return f"not a record of schema {SCHEMA} or 1"
    if (fault := explain_misshapen(record if record["schema"] == SCHEMA else _rename(record))) is not None:
        return fault
    if record["schema"] == SCHEMA:
        if record.get("digest") != digest({name: value for name, value in record.items() if name != "digest"}):
            return "its digest does not match: the line was changed after it was written"
        return None
    if record.get("task_settings") is None:  # the oldest records of schema 1 do not hold all that they hash
        return None
    experiment = short_hash([1, *_configuration(record)])
    run = run_hash(record["cell_id"], record["environment"])
    if experiment != record["cell_id"]:
        return f"cell_id is {record['cell_id']}, but its configuration has {experiment}"
    if run != record["run_hash"]:
        return f"run_hash is {record['run_hash']}, but its cell_id and environment have {run}"
    return None


def upgrade(record: Record) -> Record:
    """Return a valid record with the keys and hashes of schema 2. A record of schema 1 retains its `cell_id`."""
    if record["schema"] == SCHEMA:
        return record
    settings: dict[str, Any] = {"task_settings": {}} if record.get("task_settings") is None else {}
    renamed = _rename(record) | settings | {"schema": SCHEMA, "cell_id": record["cell_id"]}
    renamed["experiment_id"] = short_hash(_configuration(renamed))
    renamed["run_hash"] = run_hash(renamed["experiment_id"], record["environment"])
    return seal(renamed)


def _rename(record: Record) -> Record:
    """Return a record of schema 1 under the names of schema 2."""
    return {RENAMED_SINCE_1.get(name, name): value for name, value in record.items()}


def _configuration(record: Record) -> list[Any]:
    """Return the entries that `experiment_id` hashes."""
    task = {"name": record["task"], **record["task_settings"]}
    parts = (record[name] for name in ("defense", "attack"))
    return [task, *parts, _content(record["dataset"]), record["seed"], record["metric_settings"]]


def _content(dataset: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in dataset.items() if name not in ("name", "spec")}


def _parse(path: Path, number: int, line: bytes) -> Record:
    try:
        record = strict_json.parse(line)
    except ValueError as error:
        raise UserError(f"{path}, line {number}: {error}; repair or remove the line") from error
    if (fault := explain_invalid(record)) is not None:
        raise UserError(f"{path}, line {number}: {fault}; repair or remove the line")
    return upgrade(record)


def _file_lock(path: Path) -> FileLock:
    return FileLock(path.with_name(f".{path.name}.lock"), timeout=0)


def _with_infinity(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_infinity(inner) for key, inner in value.items()}
    return math.inf if value == "inf" else value
