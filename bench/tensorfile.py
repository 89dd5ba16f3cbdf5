"""Safetensors files that carry what they are and a digest of all they hold, verified at every load."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import UserError

Arrays = dict[str, np.ndarray]


def content_digest(kind: str, arrays: Arrays, meta: dict[str, Any]) -> str:
    """SHA-256 over the kind, the metadata and every array's name, dtype, shape and bytes."""
    digest = hashlib.sha256(json.dumps([kind, meta], sort_keys=True, allow_nan=False).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return "sha256:" + digest.hexdigest()


def save(path: Path, kind: str, arrays: Arrays, meta: dict[str, Any]) -> str:
    """Write the file in one step (a crash leaves the old one) and return its digest."""
    from safetensors.numpy import save_file

    digest = content_digest(kind, arrays, meta)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.{os.getpid()}.unfinished")  # others may be writing the same
    header = {"kind": kind, "digest": digest, "meta": json.dumps(meta, sort_keys=True, allow_nan=False)}
    save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, unfinished, header)
    unfinished.replace(path)
    return digest


def load(path: Path, kind: str) -> tuple[Arrays, dict[str, Any], str]:
    """Return the arrays, the metadata and the digest.

    Raises
    ------
    UserError
        if there is no such file, it is of another kind, or its content is not what was written.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise UserError(f"{path}: no such file")
    try:
        with safe_open(path, framework="numpy") as opened:
            header = opened.metadata() or {}
            arrays = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 (it is no mapping)
    except (SafetensorError, OSError) as error:
        raise UserError(f"{path}: not a whole safetensors file: {error}") from error
    if header.get("kind") != kind:
        raise UserError(f"{path}: holds {header.get('kind', 'something else')!s}, not {kind}")
    meta = json.loads(header["meta"])
    digest = content_digest(kind, arrays, meta)
    if digest != header.get("digest"):
        raise UserError(f"{path}: its checksum is {digest}, but {header.get('digest')} was written; fetch or build it again")
    return arrays, meta, digest
