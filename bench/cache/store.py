"""What was made once and can be made again, kept on disk by the hash of what it was made from, never by name.

A key says everything that the content depends on: configuration, hashes of inputs, and of the source that makes it. What is
damaged is made again; where nothing can be written, nothing is kept. All of it may be removed at any time.
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

from bench.core.errors import UserError
from bench.core.hashing import canonical
from bench.formats import tensor_file
from bench.formats.tensor_file import Arrays

VARIABLE = "FEATURE_PRIVACY_CACHE"  # of the environment: the folder
SUFFIX = ".safetensors"
SUMS = "SHA256SUMS"  # of a folder: its files' checksums, as sha256sum writes them
Content = tuple[Arrays, dict[str, Any]]


def root() -> Path:
    """The folder that everything is kept in."""
    return Path(os.environ.get(VARIABLE, "runs/cache"))


@contextlib.contextmanager
def within(folder: Path) -> Iterator[None]:
    """Keep everything there for a while, and find nothing of what is kept elsewhere."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before


def fetch(kind: str, key: Any, make: Callable[[], Content], worth: float = 0.0) -> Content:
    """Arrays and metadata that `make` makes, unless they are kept already.

    Parameters
    ----------
    kind : what it is, in a word
    key : JSON: all that the content depends on
    worth : seconds; what took less is not kept
    """
    file = path(kind, key)
    if file.is_file():
        try:
            arrays, meta, _ = tensor_file.load(file, kind)
        except UserError as error:
            _damaged(error)
        else:
            _used(file)
            return arrays, meta
    started = time.perf_counter()
    arrays, meta = make()
    if time.perf_counter() - started >= worth:
        with _as_far_as_possible(file):
            tensor_file.save(file, kind, arrays, meta)
    return arrays, meta


def copy(kind: str, key: Any, to: Path) -> bool:
    """Copy the file of arrays that is kept under that key; False if there is none."""
    file = path(kind, key)
    if (fault := _fault(file)) is not None:
        if file.is_file():
            _damaged(fault)
        return False
    to.parent.mkdir(parents=True, exist_ok=True)
    unfinished = to.with_name(f"{to.name}.{os.getpid()}.unfinished")
    shutil.copyfile(file, unfinished)
    unfinished.replace(to)
    _used(file)
    return True


def keep(kind: str, key: Any, file: Path) -> None:
    """Keep a copy of a file of arrays under that key."""
    kept = path(kind, key)
    with _as_far_as_possible(kept):
        kept.parent.mkdir(parents=True, exist_ok=True)
        unfinished = kept.with_name(f"{kept.name}.{os.getpid()}.unfinished")
        shutil.copyfile(file, unfinished)
        unfinished.replace(kept)


def folder(kind: str, key: Any, make: Callable[[Path], None]) -> Path:
    """A folder that `make` fills, unless it is kept already.

    Raises
    ------
    OSError
        if it cannot be written.
    """
    place = path(kind, key).with_suffix("")
    if place.is_dir():
        if (fault := _fault(place)) is None:
            _used(place)
            return place
        _damaged(fault)
        shutil.rmtree(place)
    unfinished = place.with_name(f"{place.name}.{os.getpid()}.unfinished")
    unfinished.mkdir(parents=True)
    try:
        make(unfinished)
        (unfinished / SUMS).write_text("".join(f"{_sha256(file)}  {file.name}\n" for file in sorted(unfinished.iterdir())))
        unfinished.replace(place)
    except BaseException:
        shutil.rmtree(unfinished)
        raise
    return place


def path(kind: str, key: Any) -> Path:
    """Where that is kept."""
    return root() / kind / f"{hashlib.sha256(canonical(key).encode()).hexdigest()[:32]}{SUFFIX}"


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One thing that is kept: a file, or a folder."""

    path: Path
    kind: str
    size: int  # bytes
    used: float  # when it was last made or used; seconds since the epoch

    def fault(self) -> str | None:
        """What is wrong with its content, read whole; None if nothing."""
        return _fault(self.path)

    def remove(self) -> None:
        """Remove it, if it is still there."""
        if self.path.is_dir():
            shutil.rmtree(self.path, ignore_errors=True)
        else:
            self.path.unlink(missing_ok=True)


def entries() -> Iterator[Entry]:
    """All that is kept, by kind and name."""
    for place in sorted(root().glob("*/*")):
        with contextlib.suppress(FileNotFoundError):  # another process has removed it since
            files = [place] if place.is_file() else [file for file in place.rglob("*") if file.is_file()]
            size = sum(file.stat().st_size for file in files)
            yield Entry(path=place, kind=place.parent.name, size=size, used=place.stat().st_mtime)


def _fault(place: Path) -> str | None:
    if place.name.endswith(".unfinished"):
        return f"{place}: was never finished"
    if place.is_dir():
        sums = place / SUMS
        written = [line.split("  ", 1) for line in sums.read_text().splitlines()] if sums.is_file() else []
        wrong = [name for digest, name in written if not (place / name).is_file() or _sha256(place / name) != digest]
        if wrong or not written:
            return f"{place}: {'the checksum of ' + wrong[0] + ' is not what was written' if wrong else 'has no checksums'}"
        return None
    try:
        tensor_file.verify(place)
    except UserError as error:
        return str(error)
    return None


def _damaged(what: object) -> None:
    logging.getLogger(__name__).warning("%s; it is made again", what)


def _used(place: Path) -> None:
    with contextlib.suppress(OSError):
        os.utime(place)


@contextlib.contextmanager
def _as_far_as_possible(file: Path) -> Iterator[None]:
    """Writing it may fail: the disk may be full, or not ours."""
    try:
        yield
    except OSError as error:
        logging.getLogger(__name__).warning("%s: %s; it is not kept", file, error.strerror)


def _sha256(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
