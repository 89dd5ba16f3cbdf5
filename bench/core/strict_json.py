"""JSON of other people: values that every reader can use, and no others."""

from __future__ import annotations

import json
import math
import sys
from typing import Any, NoReturn

DEEPEST = 32  # nested lists and objects; records have five


def parse(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises
    ------
    ValueError
        if it is not JSON (`not valid JSON: ...`), a number does not fit into a double, or lists and objects are nested more than
        32 deep; the message is one line.
    """
    try:
        value = json.loads(text, parse_constant=_refuse)
    except RecursionError:
        raise ValueError(f"nested more than {DEEPEST} deep") from None
    except ValueError as error:
        raise ValueError(f"not valid JSON: {error}") from None
    _check(value, "", 0)
    return value


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a number of JSON")


def _check(value: Any, path: str, depth: int) -> None:
    """Raise ValueError if a number is not finite as a double, or the value is nested too deep."""
    if depth > DEEPEST:
        raise ValueError(f"nested more than {DEEPEST} deep")
    if isinstance(value, dict):
        for name, inner in value.items():
            _check(inner, f"{path}.{name}", depth + 1)
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            _check(inner, f"{path}[{number}]", depth + 1)
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{path.lstrip('.')}: not finite")
    elif isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ValueError(f"{path.lstrip('.')}: too large for a double")
