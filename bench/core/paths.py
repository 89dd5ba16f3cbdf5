"""Paths of names that come from outside: images in lists and models, samples, entries of records.

A name may hold folders, separated by `/`. `find_file` is for readers, `assign_path` for writers. Neither leaves the folder.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

from bench.core.errors import UserError

LONGEST = 255  # bytes of the name of a file, on the file systems in common use
ENCODED = re.compile(r"[0-9a-f]{16}~")  # the beginning of an encoded name
FORBIDDEN = re.compile(r'[\x00-\x1f<>:"|?*\\]')  # in names of files on Windows
RESERVED = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE | re.DOTALL)  # its devices


def find_file(folder: Path, name: str, windows: bool = os.name == "nt") -> Path:
    """Return the path of the file that a name refers to, which need not exist.

    Raises
    ------
    UserError
        if the name leads out of the folder, or this system has no such names of files.
    """
    parts = name.split("/")
    if "\0" in name or parts[0] == "" or ".." in parts:
        raise UserError(f"{name!r}: expected a name of a file below {folder}, without '..'")
    if any(len(part.encode(errors="surrogatepass")) > LONGEST for part in parts):
        raise UserError(f"{name!r}: no name of a file is longer than {LONGEST} bytes")
    special = [part for part in parts if windows and part not in ("", ".") and _is_special(part)]
    if special:
        raise UserError(f"{name!r}: {special[0]!r} is not allowed in the name of a file on Windows; rename it")
    return folder / name


def assign_path(folder: Path, name: str, suffix: str = "") -> Path:
    """Return the path below `folder` at which the file of a name is written. `suffix` is appended to the name.

    All names have a path that every system accepts, and two names never need the same one. A part of the name is replaced by its
    hash and its first letters if it is too long, leads out of the folder, has another meaning on Windows, is no UTF-8, looks
    replaced, or is a folder that ends as files do.

    >>> assign_path(Path("out"), "night/1.jpg", ".png").as_posix()
    'out/night/1.jpg.png'
    >>> assign_path(Path("out"), "nul.jpg", ".png").as_posix()
    'out/e14d5453e48d0e48~nul.jpg.png'
    """
    *folders, last = name.split("/")
    encoded = (_encode(part, "", bool(suffix) and part.lower().endswith(suffix)) for part in folders)
    return folder.joinpath(*encoded, _encode(last, suffix))


def _encode(part: str, suffix: str, ambiguous: bool = False) -> str:
    content = part.encode(errors="surrogatepass")
    room = LONGEST - len(suffix)
    replaced = ambiguous or not part or len(content) > room or _is_special(part + suffix) or ENCODED.match(part)
    if not replaced and not _has_surrogates(part):
        return part + suffix
    start = FORBIDDEN.sub("_", content[: room - 17].decode(errors="ignore")).rstrip(". ")
    return f"{hashlib.sha256(content).hexdigest()[:16]}~{start}{suffix}"


def _is_special(part: str) -> bool:
    """Return whether Windows refuses the name of a file or folder, or gives it another meaning."""
    return bool(FORBIDDEN.search(part) or RESERVED.fullmatch(part)) or part.endswith((".", " "))


def _has_surrogates(part: str) -> bool:
    """Return whether a name has parts that are no text, such as bytes that are not UTF-8."""
    return any("\ud800" <= letter <= "\udfff" for letter in part)
