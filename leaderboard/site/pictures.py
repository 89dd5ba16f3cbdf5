"""The photographs and reconstructions of a site: each is written once, small, under a name made from its content."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from bench.core import hashing
from bench.core.errors import SampleError
from bench.images import photographs
from bench.images.photographs import Source
from bench.runner import directory
from bench.runner.directory import photograph_path
from bench.runner.records import Record
from leaderboard.comparison import LocatedRecord

FOLDER = "pictures"
QUALITY = 90  # of WebP


@dataclass(frozen=True, kw_only=True)
class Pair:
    """The paths of a reconstruction and of its photograph where there is one, relative to the page."""

    reconstruction: str
    original: str | None


def write_pairs(records: Iterable[LocatedRecord], out: Path) -> Iterator[tuple[Record, Pair]]:
    """Write the images of all reconstructions into the site `out`, and yield their records with the paths."""
    for located in records:
        folder, record = located.folder, located.record
        reconstruction = _copy_picture(folder, directory.reconstruction_path(folder, record), out)
        if reconstruction is not None:
            original = _copy_picture(folder, photograph_path(folder, record), out) or _write_builtin(record, out)
            yield record, Pair(reconstruction=reconstruction, original=original)


def _copy_picture(folder: Path, path: Path, out: Path) -> str | None:
    """Copy an image of a folder of results. Returns None if there is none, or if a link leads out of the folder."""
    if not os.path.isfile(path) or not path.resolve().is_relative_to(folder.resolve()):
        return None
    return _write_picture(path.read_bytes(), lambda: photographs.decode(path)[0], out)


def _write_builtin(record: Record, out: Path) -> str | None:
    """Write a built-in photograph, cropped as attacks see it. Returns None if the record is of another photograph."""
    sources, content = _index_builtin()
    if record["dataset"]["hash"] != content or record["sample"] not in sources:
        return None
    path = sources[record["sample"]].path
    return _write_picture(b"cut out " + path.read_bytes(), lambda: Image.fromarray(photographs.read(path).pixels), out)


def _write_picture(content: bytes, read: Callable[[], Image.Image], out: Path) -> str | None:
    """Write an image as WebP, named by its content, unless it exists. Returns None if it cannot be read."""
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
def _index_builtin() -> tuple[dict[str, Source], str]:
    """Return the built-in photographs by name, and their hash in records."""
    sources = {source.name: source for source in photographs.list_builtin()}
    return sources, hashing.digest({name: source.content_hash() for name, source in sources.items()})
