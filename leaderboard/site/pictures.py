"""The photographs and reconstructions of a site: copied once each, small, under names that nobody else chose."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from bench import records, runner
from bench.datasets import photographs
from bench.datasets.photographs import Source
from bench.errors import UnitError
from bench.records import Record
from leaderboard import report
from leaderboard.boards import Found

FOLDER = "pictures"
QUALITY = 90  # of WebP


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A reconstruction, and the photograph beside it where there is one; both relative to the page."""

    made: str
    original: str | None


def pair(found: Found, out: Path) -> Pair | None:
    """Copy the pictures of a record into the site `out`; None where there is no reconstruction."""
    made = _copied(_within(found.folder, runner.picture(found.folder, found.record)), out)
    if made is None:
        return None
    kept = _within(found.folder, report.photograph(found.folder, found.record))
    return Pair(made=made, original=_copied(kept, out) or _copied(_builtin(found.record), out))


def _within(folder: Path, path: Path) -> Path | None:
    """The path, unless a record's names lead out of the record's folder."""
    return path if path.resolve().is_relative_to(folder.resolve()) else None


def _copied(path: Path | None, out: Path) -> str | None:
    """Write the picture as WebP, named by its content, unless that was done before; the name, or None if there is no picture."""
    if path is None or not path.is_file():
        return None
    name = f"{FOLDER}/{hashlib.sha256(path.read_bytes()).hexdigest()[:24]}.webp"
    if not (out / name).is_file():
        try:
            pixels = photographs.read(path).pixels
        except UnitError:
            return None
        unfinished = (out / name).with_suffix(".unfinished")
        unfinished.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(unfinished, "WEBP", quality=QUALITY)
        unfinished.replace(out / name)
    return name


def _builtin(record: Record) -> Path | None:
    """A photograph that every installation has."""
    sources, content = _all_builtin()
    same = record["dataset"]["hash"] == content
    return next((source.path for source in sources if same and source.name == record["unit"]), None)


@functools.cache
def _all_builtin() -> tuple[list[Source], str]:
    sources = photographs.builtin()
    hashes = {source.name: source.content_hash() for source in sources}
    return sources, "sha256:" + hashlib.sha256(records.canonical(hashes).encode()).hexdigest()


def every(found: tuple[Found, ...], out: Path) -> Iterator[tuple[Record, Pair]]:
    """The records of a cell that have a picture, with the pictures."""
    for one in found:
        if one.record["status"] == "ok" and (pictures := pair(one, out)):
            yield one.record, pictures
