"""Protecting features for real: the randomness is the operating system's, and nobody's to repeat."""

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
from bench.core.hashing import canonical
from bench.registry import spec
from bench.types import Features, Release

KEY = 32  # bytes


def protect(features: Features, defense: Defense, public: Public | None = None, *, device: Path | str | None = None) -> Release:
    """Return what may leave the phone.

    Parameters
    ----------
    features : the secret
    defense : such as `LDP(epsilon=10)`
    public : pass one `Public()` to many calls, so that the dictionary is read once
    device : the file of the device's secret key, for a defense that remembers, and for no other. Where there is none it is made.

    Raises
    ------
    UserError
        if the defense's dictionary is missing or damaged, or does not fit the features; or the key is.
    """
    public = public or Public()
    if defense.is_memoized() and device is None:
        raise UserError(f"{defense.name()}, as configured, needs the file of the device's key: protect(..., device=PATH)")
    if device is not None and not defense.is_memoized():
        raise UserError(f"{defense.name()}, as configured, does not remember: a key would make all releases draw alike")
    key = secrets.token_bytes(KEY) if device is None else _derived(_device_key(Path(device)), defense, public)
    return defense.protect(features, public, generator(key))


def generator(key: bytes) -> np.random.Generator:
    """A generator whose bits are those of the ChaCha20 cipher under a 256-bit key (Bernstein 2008; RFC 8439).

    NumPy's own generators are not made for secrets: of PCG64, a few outputs give the state, and so all that was drawn.
    """
    return np.random.Generator(ChaCha(key=int.from_bytes(key, "little"), rounds=20))


def _derived(key: bytes, defense: Defense, public: Public) -> bytes:
    """A key of its own for each configuration: under one key, the answers of two would depend on each other."""
    return hashlib.blake2b(canonical(spec.configuration(defense, public)).encode(), key=key, digest_size=KEY).digest()


def _device_key(path: Path) -> bytes:
    try:
        with contextlib.suppress(FileExistsError), open(path, "xb", opener=_for_the_owner_alone) as file:
            file.write(secrets.token_bytes(KEY))
        key = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot make or read the device's key: {error.strerror}") from error
    if len(key) != KEY:
        raise UserError(f"{path}: a device's key has {KEY} bytes, this file {len(key)}")
    return key


def _for_the_owner_alone(name: str, flags: int) -> int:
    return os.open(name, flags, 0o600)
