"""Unpacking of zip and tar files into a folder that no name can leave."""

from __future__ import annotations

import gzip
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO

from bench.core import paths
from bench.core.errors import UserError
from bench.formats.download import CHUNK, check_space

SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")
Member = tuple[str, int, Callable[[], IO[bytes] | None]]  # name, bytes, and a function that opens it


def is_archive(name: str) -> bool:
    """Return whether `unpack` reads files of this name."""
    return name.endswith(SUFFIXES)


def unpack(archive: Path, folder: Path) -> int:
    """Unpack the files of an archive into a folder, and return their number. Files of the same names are overwritten.

    All names are checked before the first file is written. Links and devices are refused.

    Raises
    ------
    OSError
        if the disk has too little space.
    UserError
        if the archive is damaged, or a name leads out of the folder.
    """
    try:
        with _open(archive) as members:
            targets = [(paths.find_file(folder, name), read) for name, _, read in members]
            check_space(folder, sum(size for _, size, _ in members))
            for target, read in targets:
                target.parent.mkdir(parents=True, exist_ok=True)
                source = read()
                assert source is not None  # a regular file
                with source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)
            return len(targets)
    except UserError as error:
        raise UserError(f"{archive}: {error}; nothing was unpacked") from None
    except (zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError, RuntimeError) as error:
        raise UserError(f"{archive}: damaged: {error}; remove it, and download it again") from error


@contextmanager
def _open(archive: Path) -> Iterator[list[Member]]:
    """Open an archive. -> its files"""
    if archive.suffix == ".zip":
        with zipfile.ZipFile(archive) as zipped:
            yield [(info.filename, info.file_size, partial(zipped.open, info)) for info in zipped.infolist() if not info.is_dir()]
        return
    with tarfile.open(archive) as tarred:
        members = [member for member in tarred if not member.isdir()]
        while tarred.fileobj.read(CHUNK):
            pass  # gzip verifies its checksum at the end
        if special := next((member.name for member in members if not member.isfile()), None):
            raise UserError(f"{special!r}: a link or a device; expected files and folders")
        yield [(member.name, member.size, partial(tarred.extractfile, member)) for member in members]
