"""The two kinds of trouble that a user is told of in one line, never with a traceback."""


class UserError(Exception):
    """A mistake in what was asked: wrong name, wrong file, wrong value. Nothing has been written (exit 2)."""


class UnitError(Exception):
    """One photograph (or query, or scene) cannot be done; its record is `failed`, the others go on (exit 1)."""
