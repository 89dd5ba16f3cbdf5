"""Records: append-only JSON lines, one for each unit of each cell of the experiment, and all that anything is derived from."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from io import BufferedReader, RawIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.core.errors import UserError
from bench.core.hashing import short_hash

if TYPE_CHECKING:
    import pandas as pd

Record = dict[str, Any]

SCHEMA = 1
FILE = "records.jsonl"
EVERY_SAMPLE = "*"  # the unit of a record that holds for the whole cell, such as one that does not apply


def experiment_id(task: Any, defense: Any, attack: Any, dataset: dict[str, Any], seed: int, metric_settings: Any) -> str:
    """Hash of the configuration and the inputs. How a dataset is called is neither."""
    content = {key: value for key, value in dataset.items() if key not in ("name", "spec")}
    return short_hash([SCHEMA, task, defense, attack, content, seed, metric_settings])


def run_hash(cell: str, environment: dict[str, Any]) -> str:
    """Hash of the cell and of all that ran it: a record with the same one need not be made again."""
    return short_hash([cell, environment])


def key(record: Record) -> tuple[str, str]:
    """What a record is known by: of two that share it the later one counts."""
    return record["run_hash"], record["unit"]


@dataclass(frozen=True)
class Contents:
    """What a file of records holds."""

    records: list[Record]
    whole: int  # bytes up to the end of the last whole line
    notice: str | None = None  # of a last line that was cut off


def read(path: Path) -> Contents:
    """Read a file of records; a last line that a crash cut off is left out.

    Raises
    ------
    UserError
        if any other line is no record; the message names the file and the line.
    """
    *lines, rest = path.read_bytes().split(b"\n")
    found = [_record(path, number, line) for number, line in enumerate(lines, start=1) if line.strip()]
    whole = sum(len(line) + 1 for line in lines)
    notice = f"{path}: its last line was cut off and is left out" if rest else None
    return Contents(found, whole, notice)


def latest(records: Iterable[Record]) -> list[Record]:
    """The last record of each unit of each run of a cell."""
    return list({key(record): record for record in records}.values())


def find(path: str | Path) -> Path:
    """The file of records that is meant: the file itself, or that of a folder which `bench run` wrote.

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
    """The latest records of a file, or of a folder that `bench run` wrote, one a row.

    Nested names become columns such as `metrics.ssim`; "inf" becomes infinity; what a record lacks is missing.

    Raises
    ------
    UserError
        if there is no such file, or a line of it is no record.
    """
    import pandas as pd

    contents = read(find(path))
    if contents.notice:
        logging.getLogger(__name__).warning(contents.notice)
    return pd.json_normalize([_with_infinity(record) for record in latest(contents.records)])


def is_locked(path: Path) -> bool:
    """Whether a process that lives is writing to that file of records."""
    try:
        with path.open("rb") as file:
            return not _lock(file, fcntl.LOCK_SH)
    except FileNotFoundError:
        return False


class Log:
    """A file of records, open to append; each record is handed to the system before the next unit begins.

    It is locked while it is open. Whenever its process ends, however that is, the system lifts the lock.
    `before` is what the file held when it was locked.
    """

    def __init__(self, path: Path) -> None:
        """Open the file, or make it, and cut off what a crash left of a last line.

        Raises
        ------
        UserError
            if the file cannot be written, holds something else, or another process writes to it.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: RawIOBase = path.open("ab", buffering=0)
        except OSError as error:
            raise UserError(f"--out: cannot write {path}: {error.strerror}") from error
        try:
            if not _lock(self._file, fcntl.LOCK_EX):
                raise UserError(f"--out: another process is writing to {path}; wait for it, or name another folder")
            self.before = read(path)
            self._file.truncate(self.before.whole)
        except UserError:
            self._file.close()
            raise

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def append(self, record: Record) -> None:
        """Write one record whole.

        Raises
        ------
        OSError
            if it cannot be written; what stood before stays.
        """
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        if self._file.write(line) != len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _lock(file: RawIOBase | BufferedReader, how: int) -> bool:
    """Lock an open file until it is closed; False if another has it open and locked. Where nothing can be locked, all is free."""
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _record(path: Path, number: int, line: bytes) -> Record:
    try:
        record = json.loads(line)
    except ValueError as error:
        raise UserError(f"{path}, line {number}: no JSON ({error}); mend or remove that line") from error
    if not isinstance(record, dict) or record.get("schema") != SCHEMA:
        raise UserError(f"{path}, line {number}: not a record of schema {SCHEMA}; mend or remove that line")
    return record


def _with_infinity(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _with_infinity(inner) for key, inner in value.items()}
    return math.inf if value == "inf" else value
