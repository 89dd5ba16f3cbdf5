"""The kinds of trouble that a user is told of in one line, never with a traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class UserError(Exception):
    """A mistake in what was asked: wrong name, wrong file, wrong value. Nothing has been written (exit 2)."""


class SampleError(Exception):
    """One photograph (or query, or scene) cannot be done; its record is `failed`, the others go on (exit 1)."""


class PluginError(SampleError):
    """A plugin broke on one unit. The error that it raised is the `__cause__`, and its traceback is worth keeping."""


def unknown_name(what: str, name: str, known: Iterable[str]) -> UserError:
    """The error for a misspelt `name`: what comes nearest to it, and all there is to choose from."""
    choices = sorted(known)
    nearest = difflib.get_close_matches(name, choices, n=1)
    hint = f"; did you mean {nearest[0]!r}? There is" if nearest else "; there is"
    return UserError(f"unknown {what} {name!r}{hint} {', '.join(choices) or 'none'}")


@contextmanager
def blame(who: str) -> Iterator[None]:
    """Turn whatever `who` raises into a `PluginError` that names it. Running out of memory is nobody's fault."""
    try:
        yield
    except (SampleError, UserError, MemoryError):
        raise
    except Exception as error:
        raise PluginError(f"internal error in {who}: {type(error).__name__}: {error}") from error
