"""Records: append-only JSON lines, one for each sample of each experiment. Everything that a person sees is derived from them."""

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

from bench.core.errors import UserError
from bench.core.hashing import digest, short_hash

if TYPE_CHECKING:
    import pandas as pd

Record = dict[str, Any]

SCHEMA = 2
FILE = "records.jsonl"
EVERY_SAMPLE = "*"  # the sample of a record that holds for the whole experiment, such as one that does not apply
RENAMED_SINCE_1 = {"cell_id": "experiment_id", "unit": "sample"}  # keys of schema 1 -> keys of schema 2


def experiment_id(task: Any, defense: Any, attack: Any, dataset: Mapping[str, Any], seed: int, metric_settings: Any) -> str:
    """Hash the configuration and the inputs. The name of a dataset is neither."""
    return short_hash([task, defense, attack, _content(dataset), seed, metric_settings])


def run_hash(experiment: str, environment: Mapping[str, Any]) -> str:
    """Hash the experiment and the environment: a record with the same one need not be computed again."""
    return short_hash([experiment, environment])


def seal(record: Mapping[str, Any]) -> Record:
    """Return the record with the digest of all its other entries."""
    entries = {name: value for name, value in record.items() if name != "digest"}
    return entries | {"digest": digest(entries)}


def key(record: Record) -> tuple[str, str]:
    """Return the key of a record: of two that share it the later one counts."""
    return record["run_hash"], record["sample"]


@dataclass(frozen=True)
class Contents:
    """The contents of a file of records."""

    records: list[Record]
    whole: int  # bytes up to the end of the last whole line
    notice: str | None = None  # of a last line that was cut off


def read(path: Path) -> Contents:
    """Read a file of records of schema 2 or 1; a last line that a crash cut off is left out.

    Records of schema 1 come out with the names and hashes of schema 2. Their `cell_id` stays: it names their pictures' folder.

    Raises
    ------
    UserError
        if any other line is no record, or was changed after it was written; the message names the file and the line.
    """
    *lines, rest = path.read_bytes().split(b"\n")
    contents = [_parse(path, number, line) for number, line in enumerate(lines, start=1) if line.strip()]
    whole = sum(len(line) + 1 for line in lines)
    notice = f"{path}: its last line was cut off and is left out" if rest else None
    return Contents(contents, whole, notice)


def keep_latest(records: Iterable[Record]) -> list[Record]:
    """Return the last record of each sample of each run of an experiment."""
    return list({key(record): record for record in records}.values())


def find_file(path: str | Path) -> Path:
    """Return the file of records: the file itself, or that of a folder which `bench run` wrote.

    Raises
    ------
    UserError
        if there is none.
    """
    file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise UserError(f"{file}: no such file")
    return file


def load_records(path: str | Path) -> pd.DataFrame:
    """Load the latest records of a file, or of a folder that `bench run` wrote, one a row.

    Nested names become columns such as `metrics.ssim`; "inf" becomes infinity; absent entries are missing values.

    Raises
    ------
    UserError
        if there is no such file, or a line of it is no record.
    """
    import pandas as pd

    contents = read(find_file(path))
    if contents.notice:
        logging.getLogger(__name__).warning(contents.notice)
    return pd.json_normalize([_with_infinity(record) for record in keep_latest(contents.records)])


def is_locked(path: Path) -> bool:
    """Whether a living process is writing to that file of records."""
    if not path.is_file():
        return False
    lock = _file_lock(path)
    try:
        lock.acquire()
    except Timeout:
        return True
    except (OSError, NotImplementedError):
        return False  # where nothing can be locked, nobody is known to write
    lock.release()
    return False


class Log:
    """A file of records, open to append. Each record is handed to the system before the next job begins.

    The file is locked while it is open. The system lifts the lock when its process ends, however it ends. `before` holds the
    contents at the time of locking.
    """

    def __init__(self, path: Path) -> None:
        """Open the file, or create it, and cut off a last line that a crash left unfinished.

        Raises
        ------
        UserError
            if the file cannot be written, holds something else, or another process writes to it.
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
            raise UserError(f"--out: another process is writing to {path}; wait for it, or name another folder") from None
        except (OSError, NotImplementedError):  # a file system without locks
            logging.getLogger(__name__).debug("%s: cannot be locked", path)

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file and lift the lock."""
        self._file.close()
        self._lock.release()

    def append(self, record: Record) -> None:
        """Write one record whole.

        Raises
        ------
        OSError
            if it cannot be written; earlier records stay.
        """
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        if self._file.write(line) != len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def explain_invalid(record: Any) -> str | None:
    """Return why a value is no valid record of schema 2 or 1, by its hashes and its digest; None if it is one."""
    if not isinstance(record, dict) or record.get("schema") not in (1, SCHEMA):
        return f"not a record of schema {SCHEMA} or 1"
    if record["schema"] == SCHEMA:
        if record.get("digest") != digest({name: value for name, value in record.items() if name != "digest"}):
            return "its digest does not match: the line was changed after it was written"
        return None
    if "task_settings" not in record:  # the oldest records of schema 1 do not hold all that they hash
        return None
    try:
        experiment = short_hash([1, *_configuration(record)])
        run = run_hash(record["cell_id"], record["environment"])
    except (KeyError, TypeError, AttributeError) as error:
        return f"not a whole record of schema 1 ({type(error).__name__}: {error})"
    if experiment != record["cell_id"]:
        return f"cell_id: is {record['cell_id']}, but that of this configuration is {experiment}"
    if run != record["run_hash"]:
        return f"run_hash: is {record['run_hash']}, but that of this cell and environment is {run}"
    return None


def upgrade(record: Record) -> Record:
    """Return a valid record with the names and hashes of schema 2. One of schema 1 keeps its `cell_id`."""
    if record["schema"] == SCHEMA:
        return record
    renamed = {RENAMED_SINCE_1.get(name, name): value for name, value in record.items()}
    settings: dict[str, Any] = {"task_settings": {}} if "task_settings" not in record else {}
    renamed |= settings | {"schema": SCHEMA, "cell_id": record["cell_id"]}
    renamed["experiment_id"] = short_hash(_configuration(renamed))
    renamed["run_hash"] = run_hash(renamed["experiment_id"], record["environment"])
    return seal(renamed)


def _configuration(record: Record) -> list[Any]:
    """Return the entries that `experiment_id` hashes."""
    task = {"name": record["task"], **record["task_settings"]}
    parts = (record[name] for name in ("defense", "attack"))
    return [task, *parts, _content(record["dataset"]), record["seed"], record["metric_settings"]]


def _content(dataset: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in dataset.items() if name not in ("name", "spec")}


def _parse(path: Path, number: int, line: bytes) -> Record:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}, line {number}: no JSON ({error}); mend or remove that line") from error
    if (fault := explain_invalid(record)) is not None:
        raise UserError(f"{path}, line {number}: {fault}; mend or remove that line")
    return upgrade(record)


def _file_lock(path: Path) -> FileLock:
    return FileLock(path.with_name(f".{path.name}.lock"), timeout=0)


def _with_infinity(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_infinity(inner) for key, inner in value.items()}
    return math.inf if value == "inf" else value
