"""Protection for deployment: the randomness comes from the operating system and cannot be reproduced."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
from pathlib import Path

import numpy as np
from randomgen import ChaCha

from bench.api import Defense
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.hashing import canonical_json
from bench.registry import spec
from bench.types import Features, Release

KEY_BYTES = 32  # bytes


def protect(features: Features, defense: Defense, public: Public | None = None, *, device: Path | str | None = None) -> Release:
    """Return the release, which may leave the phone.

    Parameters
    ----------
    features : the secret
    defense : such as `LDP(epsilon=10)`
    public : pass one `Public()` to all calls, so that the dictionary is read once
    device : file of the device's secret key, for memoized defenses only; created if missing

    Raises
    ------
    UserError
        if the dictionary is missing, damaged or does not fit the features, or the key is missing or damaged.
    """
    public = public or Public()
    if defense.is_memoized() and device is None:
        raise UserError(f"{defense.name()}, as configured, needs the file of the device's key: protect(..., device=PATH)")
    if device is not None and not defense.is_memoized():
        raise UserError(f"{defense.name()}, as configured, is not memoized: a key would repeat the draws")
    key = secrets.token_bytes(KEY_BYTES) if device is None else _derive_key(_load_device_key(Path(device)), defense, public)
    return defense.protect(features, public, create_generator(key))


def create_generator(key: bytes) -> np.random.Generator:
    """Return a generator of the bits of the ChaCha20 cipher under a 256-bit key (Bernstein 2008; RFC 8439).

    NumPy's own generators are not cryptographic: a few outputs of PCG64 reveal its state, and so all draws.
    """
    return np.random.Generator(ChaCha(key=int.from_bytes(key, "little"), rounds=20))


def _derive_key(key: bytes, defense: Defense, public: Public) -> bytes:
    """Return a key for this configuration: under one key, the answers of two configurations would be dependent."""
    return hashlib.blake2b(
        canonical_json(spec.to_json_with_digests(defense, public)).encode(), key=key, digest_size=KEY_BYTES
    ).digest()


def _load_device_key(path: Path) -> bytes:
    try:
        with contextlib.suppress(FileExistsError), open(path, "xb", opener=_open_for_owner) as file:
            file.write(secrets.token_bytes(KEY_BYTES))
        key = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot create or read the device's key: {error.strerror}") from error
    if len(key) != KEY_BYTES:
        raise UserError(f"{path}: a device's key has {KEY_BYTES} bytes, this file {len(key)}")
    return key


def _open_for_owner(name: str, flags: int) -> int:
    return os.open(name, flags, 0o600)
