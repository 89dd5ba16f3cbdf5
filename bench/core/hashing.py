"""Hashes of JSON values, which identify configurations, inputs and results."""

from __future__ import annotations

import hashlib
import json
from typing import Any


def canonical_json(value: Any) -> str:
    """Return JSON with sorted keys and no spaces: equal values give equal text.

    Raises
    ------
    ValueError
        if a number is not finite.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def short_hash(value: Any) -> str:
    """Return the first 64 bits of the SHA-256 of the canonical JSON, in hexadecimal."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:16]


def digest(value: Any) -> str:
    """Return `sha256:` and the SHA-256 of the canonical JSON, in hexadecimal."""
    return "sha256:" + hashlib.sha256(canonical_json(value).encode()).hexdigest()
