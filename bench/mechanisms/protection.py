"""Protection for deployment, with randomness from the operating system, which cannot be reproduced."""

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
    """Return the release of features for deployment. It may leave the phone; the features must not.

    Parameters
    ----------
    features : the secret
    defense : such as `LDP(epsilon=10)`
    public : dictionaries; pass one `Public()` to all calls, so that each dictionary is read once
    device : file of the device's secret key, for memoized defenses only; it is created if missing

    Raises
    ------
    UserError
        if the dictionary is missing or damaged, or does not suit the features; or if the key is missing or damaged.
    """
    public = public or Public()
    if defense.is_memoized() and device is None:
        raise UserError(f"{defense.name()}, as configured, needs a file for the device's key: protect(..., device=PATH)")
    if device is not None and not defense.is_memoized():
        raise UserError(f"{defense.name()}, as configured, is not memoized; omit device=, because a key would repeat the draws")
    key = secrets.token_bytes(KEY_BYTES) if device is None else _derive_key(_load_device_key(Path(device)), defense, public)
    rng = create_generator(key)
    # The number of draws for an order varies: from the device's generator, they would change a memoized defense's answers.
    order = rng if device is None else create_generator(secrets.token_bytes(KEY_BYTES))
    return defense.protect(hide_order(features, defense, order), public, rng)


def hide_order(secret: Features, defense: Defense, rng: np.random.Generator) -> Features:
    """Return the features in random order if the defense hides positions: their order by position would reveal them."""
    return secret.take(rng.permutation(len(secret))) if defense.hides_positions() else secret


def create_generator(key: bytes) -> np.random.Generator:
    """Return a generator whose bits are those of the ChaCha20 cipher with a 256-bit key (Bernstein 2008; RFC 8439).

    NumPy's own generators are not cryptographic: a few outputs of PCG64 reveal its state, and with it all draws.
    """
    return np.random.Generator(ChaCha(key=int.from_bytes(key, "little"), rounds=20))


def _derive_key(key: bytes, defense: Defense, public: Public) -> bytes:
    """Return a key for this configuration. With one key, the answers of two configurations would be dependent."""
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
        raise UserError(f"{path}: a device's key has {KEY_BYTES} bytes, but this file has {len(key)}")
    return key


def _open_for_owner(name: str, flags: int) -> int:
    return os.open(name, flags, 0o600)
