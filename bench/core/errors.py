"""Errors that the command line reports in one line, without a traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class UserError(Exception):
    """A wrong name, file or value given by the user. Nothing has been written (exit 2)."""


class SampleError(Exception):
    """One sample failed; its record says so, and the run continues with the others (exit 1)."""


class PluginError(SampleError):
    """A plugin raised an unexpected error on one sample. The original error is the `__cause__`."""


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> UserError:
    """Return the error for a misspelt `name`, with the closest choice and all choices."""
    choices = sorted(choices)
    nearest = difflib.get_close_matches(name, choices, n=1)
    hint = f"; did you mean {nearest[0]!r}? Available:" if nearest else "; available:"
    return UserError(f"unknown {kind} {name!r}{hint} {', '.join(choices) or 'none'}")


@contextmanager
def wrap_plugin_errors(source: str) -> Iterator[None]:
    """Raise a `PluginError` that names `source` for any unexpected error. A `MemoryError` passes unchanged."""
    try:
        yield
    except (SampleError, UserError, MemoryError):
        raise
    except Exception as error:
        raise PluginError(f"internal error in {source}: {type(error).__name__}: {error}") from error
