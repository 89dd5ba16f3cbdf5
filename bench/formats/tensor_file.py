"""Safetensors files with a kind, metadata and a digest of their content, verified at every load."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from bench.core import strict_json
from bench.core.errors import UserError

Arrays = dict[str, np.ndarray]
DTYPES = {
    "BOOL",
    "U8",
    "I8",
    "U16",
    "I16",
    "U32",
    "I32",
    "U64",
    "I64",
    "F16",
    "F32",
    "F64",
    "C64",
}  # types of safetensors in NumPy


def hash_content(kind: str, arrays: Arrays, meta: dict[str, Any]) -> str:
    """Return the SHA-256 of the kind, the metadata and every array's name, dtype, shape and bytes."""
    digest = hashlib.sha256(json.dumps([kind, meta], sort_keys=True, allow_nan=False).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return "sha256:" + digest.hexdigest()


def to_half(array: np.ndarray) -> np.ndarray:
    """Return the array in half precision, or unchanged if a value overflows: a batch norm's variance may be above 65,504."""
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    return half if np.isfinite(half).all() else array


def save(path: Path, kind: str, arrays: Arrays, meta: dict[str, Any]) -> str:
    """Write the file atomically, so that a crash leaves the old file, and return its digest."""
    from safetensors.numpy import save as serialize

    digest = hash_content(kind, arrays, meta)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.unfinished")  # another process may be writing the same file
    header = {"kind": kind, "digest": digest, "meta": json.dumps(meta, sort_keys=True, allow_nan=False)}
    content = serialize({name: np.ascontiguousarray(array) for name, array in arrays.items()}, header)
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
    return digest


def load(path: Path, kind: str) -> tuple[Arrays, dict[str, Any], str]:
    """Return the arrays, the metadata and the digest.

    Raises
    ------
    UserError
        if there is no such file, it is no safetensors file of this program, its kind differs, or its digest is wrong.
    """
    arrays, header = _read(path)
    if header.get("kind") != kind:
        raise UserError(f"{path}: holds {header.get('kind', 'something else')!s}, not {kind}")
    return arrays, *_check_digest(path, arrays, header)


def read_header(path: Path) -> tuple[str, str, str]:
    """Return the kind, the metadata as JSON, and the digest as they are written, without the arrays. Nothing is verified.

    Raises
    ------
    UserError
        if there is no such file, or it is no safetensors file of this program.
    """
    return _get_fields(path, _read(path, with_arrays=False)[1])


def verify(path: Path) -> None:
    """Check the digest of a file of any kind.

    Raises
    ------
    UserError
        if there is no such file, it is no safetensors file of this program, or its digest is wrong.
    """
    arrays, header = _read(path)
    _check_digest(path, arrays, header)


def _read(path: Path, *, with_arrays: bool = True) -> tuple[Arrays, dict[str, str]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise UserError(f"{path}: no such file")
    try:
        with safe_open(path, framework="numpy") as opened:
            names, header = list(opened.keys()) if with_arrays else [], opened.metadata() or {}
            for name in names:
                if (dtype := opened.get_slice(name).get_dtype()) not in DTYPES:
                    raise UserError(f"{path}: tensor {name} has the type {dtype}, which NumPy does not know")
            return {name: opened.get_tensor(name) for name in names}, header
    except (SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path}: not a complete safetensors file: {error}") from error


def _check_digest(path: Path, arrays: Arrays, header: dict[str, str]) -> tuple[dict[str, Any], str]:
    """Return the metadata and the digest."""
    kind, text, written = _get_fields(path, header)
    try:
        meta = strict_json.parse(text)
    except ValueError as error:
        raise UserError(f"{path}: its metadata are damaged: {error}") from None
    if not isinstance(meta, dict):
        raise UserError(f"{path}: its metadata are not a JSON object, so this program did not write it")
    digest = hash_content(kind, arrays, meta)
    if digest != written:
        raise UserError(f"{path}: its checksum is {digest}, but {written} was written; fetch or build it again")
    return meta, digest


def _get_fields(path: Path, header: dict[str, str]) -> tuple[str, str, str]:
    """Return the kind, the metadata and the digest of a header."""
    if not {"kind", "digest", "meta"} <= header.keys():
        raise UserError(f"{path}: has no checksum, so this program did not write it")
    return header["kind"], header["meta"], header["digest"]
