"""Storage of results on disk by the hash of their inputs, never by name.

A key contains everything that the content depends on: configuration, hashes of inputs, and the hash of the source that computes
it. Damaged entries are computed again. If the folder is not writable, nothing is stored. All entries may be removed at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from bench.core import paths
from bench.core.environment import DISTRIBUTION
from bench.core.errors import UserError
from bench.core.hashing import canonical_json
from bench.formats import tensor_file
from bench.formats.tensor_file import Arrays

VARIABLE = "FEATURE_PRIVACY_CACHE"  # environment variable: the folder of the cache
SUFFIX = ".safetensors"
SUMS = "SHA256SUMS"  # checksums of a folder's files, as sha256sum writes them
Content = tuple[Arrays, dict[str, Any]]


def cache_folder() -> Path:
    """Return the folder of the cache: FEATURE_PRIVACY_CACHE if set, else the platform's folder for caches."""
    folder = os.environ.get(VARIABLE)
    return Path(folder) if folder else user_cache_path(DISTRIBUTION, appauthor=False)


@contextlib.contextmanager
def use_folder(folder: Path) -> Iterator[None]:
    """Use another folder for the cache, inside a `with` statement."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before


def fetch(kind: str, key: Any, compute: Callable[[], Content], min_seconds: float = 0.0) -> Content:
    """Return arrays and metadata, from the cache or by `compute`.

    Parameters
    ----------
    kind : name of the kind of content
    key : JSON: everything that the content depends on
    min_seconds : faster results are not stored
    """
    file = entry_path(kind, key)
    if file.is_file():
        try:
            arrays, meta, _ = tensor_file.load(file, kind)
        except UserError as error:
            _warn_damaged(error)
        else:
            _touch(file)
            return arrays, meta
    start = time.perf_counter()
    arrays, meta = compute()
    if time.perf_counter() - start >= min_seconds:
        with _log_write_errors(file):
            tensor_file.save(file, kind, arrays, meta)
    return arrays, meta


def copy_file(kind: str, key: Any, target: Path) -> bool:
    """Copy the file stored under a key to `target`; return False if there is none."""
    file = entry_path(kind, key)
    if (fault := _find_fault(file)) is not None:
        if file.is_file():
            _warn_damaged(fault)
        return False
    _copy(file, target)
    _touch(file)
    return True


def store_file(kind: str, key: Any, file: Path) -> None:
    """Store a copy of a file of arrays under a key."""
    entry = entry_path(kind, key)
    with _log_write_errors(entry):
        _copy(file, entry)


def fetch_folder(kind: str, key: Any, fill: Callable[[Path], None]) -> Path:
    """Return a folder of the cache. If it is missing, `fill` writes its files.

    Raises
    ------
    OSError
        if the folder cannot be written.
    """
    folder = entry_path(kind, key).with_suffix("")
    if folder.is_dir():
        if (fault := _find_fault(folder)) is None:
            _touch(folder)
            return folder
        _warn_damaged(fault)
        shutil.rmtree(folder)
    unfinished = _unfinished_path(folder)
    unfinished.mkdir(parents=True)
    try:
        fill(unfinished)
        (unfinished / SUMS).write_text("".join(f"{_sha256(file)}  {file.name}\n" for file in sorted(unfinished.iterdir())))
        unfinished.replace(folder)
    except BaseException:
        shutil.rmtree(unfinished)
        raise
    return folder


def entry_path(kind: str, key: Any) -> Path:
    """Return the path of an entry."""
    return cache_folder() / kind / f"{hashlib.sha256(canonical_json(key).encode()).hexdigest()[:32]}{SUFFIX}"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One entry of the cache: a file or a folder."""

    path: Path
    kind: str
    size: int  # bytes
    used: float  # time of the last use; seconds since the epoch

    def find_fault(self) -> str | None:
        """Read the whole content, and return a description of its fault; None if there is none."""
        return _find_fault(self.path)

    def remove(self) -> None:
        """Remove the entry if it still exists."""
        if self.path.is_dir():
            shutil.rmtree(self.path, ignore_errors=True)
        else:
            self.path.unlink(missing_ok=True)


def list_entries() -> Iterator[Entry]:
    """Yield all entries, sorted by kind and name."""
    for path in sorted(cache_folder().glob("*/*")):
        with contextlib.suppress(FileNotFoundError):  # another process has removed it since
            files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
            size = sum(file.stat().st_size for file in files)
            yield Entry(path=path, kind=path.parent.name, size=size, used=path.stat().st_mtime)


def _find_fault(path: Path) -> str | None:
    if path.name.endswith(".unfinished"):
        return f"{path}: incomplete, its writer ended early"
    try:
        if path.is_dir():
            _verify_folder(path)
        else:
            tensor_file.verify(path)
    except UserError as error:
        return str(error)
    except OSError as error:
        return f"{path}: cannot be read: {error.strerror}"
    return None


def _verify_folder(folder: Path) -> None:
    """Raise UserError if a file of a folder differs from its checksum, or there are no checksums."""
    sums = folder / SUMS
    if not sums.is_file():
        raise UserError(f"{folder}: has no checksums")
    listed = [line.partition("  ") for line in sums.read_text(encoding="utf-8", errors="replace").splitlines()]
    if not listed:
        raise UserError(f"{folder}: has no checksums")
    for digest, _, name in listed:
        file = paths.find_file(folder, name)
        if not file.is_file() or _sha256(file) != digest:
            raise UserError(f"{folder}: the checksum of {name} is wrong")


def _copy(source: Path, target: Path) -> None:
    """Copy a file atomically."""
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = _unfinished_path(target)
    shutil.copyfile(source, unfinished)
    unfinished.replace(target)


def _unfinished_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.{os.getpid()}.unfinished")


def _warn_damaged(fault: object) -> None:
    logging.getLogger(__name__).warning("%s; it is computed again", fault)


def _touch(path: Path) -> None:
    with contextlib.suppress(OSError):
        os.utime(path)


@contextlib.contextmanager
def _log_write_errors(file: Path) -> Iterator[None]:
    """Log a failed write instead of raising: the disk may be full or read-only."""
    try:
        yield
    except OSError as error:
        logging.getLogger(__name__).warning("%s: %s; it is not stored", file, error.strerror)


def _sha256(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
