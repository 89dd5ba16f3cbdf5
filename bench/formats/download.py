"""Downloads that can be interrupted: the received bytes stay in `NAME.TAG.part`, and the next call requests the rest.

TAG is a hash of the server's ETag or date, so that the parts of two versions of a file are never joined.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import http.client
import os
import re
import shutil
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from bench.core.errors import UserError
from bench.core.progress import Progress

CHUNK = 10**6  # bytes
TIMEOUT = 60.0  # seconds without an answer
RESUMED, UNSATISFIABLE = 206, 416  # HTTP statuses: the requested range; no such range
CHECKSUM = re.compile(r"(md5:[0-9a-f]{32}|sha256:[0-9a-f]{64})")


def download(url: str, path: Path, checksum: str | None = None) -> str:
    """Download a file unless `path` exists, and return its SHA-256, as `sha256:...`.

    Parameters
    ----------
    checksum : `md5:...` or `sha256:...`; None: the content is not verified

    Raises
    ------
    OSError
        if the server cannot be reached or ends early, or the disk is full. The next call resumes.
    UserError
        if the file has another checksum. It is removed.
    """
    if not path.exists():
        os.replace(_receive(url, path), path)
    algorithm, _, expected = (checksum or "sha256:").partition(":")
    found = {name: _hash_file(path, name) for name in {"sha256", algorithm}}
    if expected and found[algorithm] != expected:
        path.unlink()
        raise UserError(
            f"{url}: its {algorithm} is {found[algorithm]}, expected {expected}; it was removed. Download it again; if the error "
            "repeats, the file of the server is another one"
        )
    return f"sha256:{found['sha256']}"


def check_space(folder: Path, needed: int) -> None:
    """Raise OSError if the disk of a folder has less than `needed` bytes left."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(errno.ENOSPC, f"{needed / 1e6:,.0f} MB are needed, {free / 1e6:,.0f} MB are free", str(folder))


def _receive(url: str, path: Path) -> Path:
    """Download a file, from the end of an earlier part if the server's file is still the same. -> the complete part"""
    earlier = next(iter(sorted(path.parent.glob(f"{glob.escape(path.name)}.*.part"))), None)
    start = 0 if earlier is None else earlier.stat().st_size
    try:
        response = _request(url, start)
    except urllib.error.HTTPError as error:
        if error.code != UNSATISFIABLE or earlier is None:
            raise ConnectionError(error.code, f"the server answers {error.code} {error.reason}", url) from None
        if error.headers.get("Content-Range") == f"bytes */{start}" and earlier == _name_part(path, error.headers):
            return earlier  # complete
        earlier.unlink()
        return _receive(url, path)
    with response:
        part = _name_part(path, response.headers)
        resumed = start > 0 and response.status == RESUMED
        if earlier is not None and part != earlier:  # the server has another version now
            earlier.unlink()
            if resumed:
                return _receive(url, path)
        done = start if resumed else 0
        length = response.headers.get("Content-Length")
        total = None if length is None else done + int(length)
        check_space(path.parent, 0 if total is None else total - done)
        with (
            part.open("ab" if done else "wb") as file,
            Progress(f"{path.name}, MB", -(-(total or 0) // CHUNK)) as progress,
        ):
            progress.advance(done // CHUNK)
            while chunk := _read(response, url):
                file.write(chunk)
                progress.advance()
    size = part.stat().st_size
    if total is not None and size != total:
        raise ConnectionError(errno.ECONNABORTED, f"the connection ended after {size:,} of {total:,} bytes", url)
    return part


def _request(url: str, start: int) -> Any:
    request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})
    try:
        return urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError:
        raise
    except (OSError, http.client.HTTPException) as error:
        raise ConnectionError(errno.ECONNREFUSED, f"cannot be reached: {getattr(error, 'reason', error)}", url) from error


def _read(response: Any, url: str) -> bytes:
    try:
        return bytes(response.read(CHUNK))
    except (OSError, http.client.HTTPException) as error:
        raise ConnectionError(errno.ECONNABORTED, f"the connection ended: {error}", url) from error


def _name_part(path: Path, headers: Any) -> Path:
    version = headers.get("ETag") or headers.get("Last-Modified") or ""
    return path.with_name(f"{path.name}.{hashlib.sha256(version.encode()).hexdigest()[:8]}.part")


def _hash_file(path: Path, algorithm: str) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.new(algorithm, usedforsecurity=False)).hexdigest()
