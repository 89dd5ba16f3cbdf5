"""The photographs and reconstructions of a site: written once each, small, under names that nobody else chose."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from bench.core import hashing
from bench.core.errors import SampleError
from bench.images import photographs
from bench.images.photographs import Source
from bench.runner import directory
from bench.runner.records import Record
from leaderboard import run_report
from leaderboard.comparison import Found

FOLDER = "pictures"
QUALITY = 90  # of WebP


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A reconstruction, and the photograph beside it where there is one; both relative to the page."""

    made: str
    original: str | None


def pairs(found: Iterable[Found], out: Path) -> Iterator[tuple[Record, Pair]]:
    """The records of which there is a reconstruction, with their pictures, which are written into the site `out`."""
    for one in found:
        made = _as_it_is(one.folder, directory.reconstruction_path(one.folder, one.record), out)
        if made is not None:
            original = _as_it_is(one.folder, run_report.photograph(one.folder, one.record), out) or _builtin(one.record, out)
            yield one.record, Pair(made=made, original=original)


def _as_it_is(folder: Path, path: Path, out: Path) -> str | None:
    """A picture of a folder of results; None if there is none, or a record's names lead out of the folder."""
    if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        return None
    return _written(path.read_bytes(), lambda: photographs.decode(path)[0], out)


def _builtin(record: Record, out: Path) -> str | None:
    """A photograph that every installation has, cut out as attacks see it."""
    sources, content = _all_builtin()
    if record["dataset"]["hash"] != content or record["unit"] not in sources:
        return None
    path = sources[record["unit"]].path
    return _written(b"cut out " + path.read_bytes(), lambda: Image.fromarray(photographs.read(path).pixels), out)


def _written(content: bytes, read: Callable[[], Image.Image], out: Path) -> str | None:
    """Write a picture as WebP, named by its content, unless that was done before; None if it cannot be read."""
    name = f"{FOLDER}/{hashlib.sha256(content).hexdigest()[:24]}.webp"
    if not (out / name).is_file():
        try:
            image = read()
        except SampleError:
            return None
        unfinished = (out / name).with_suffix(".unfinished")
        unfinished.parent.mkdir(parents=True, exist_ok=True)
        image.save(unfinished, "WEBP", quality=QUALITY)
        unfinished.replace(out / name)
    return name


@functools.cache
def _all_builtin() -> tuple[dict[str, Source], str]:
    """By name, and the hash that records know them by."""
    sources = {source.name: source for source in photographs.builtin()}
    return sources, hashing.digest({name: source.content_hash() for name, source in sources.items()})
