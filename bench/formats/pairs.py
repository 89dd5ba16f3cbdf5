"""Lists of image pairs in hloc's format: one line `query reference` for each pair, the best reference first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from bench.core.errors import UserError
from bench.formats import lists


def read(path: Path) -> dict[str, list[str]]:
    """Return query -> references, in the order of the file.

    Raises
    ------
    UserError
        if a line is not a pair, a pair occurs twice, or there is no pair; the message names file and line.
    """
    pairs: dict[str, list[str]] = {}
    for number, fields in lists.read_fields(path):
        if len(fields) != 2:
            raise UserError(
                f"{path}:{number}: a pair is two names, 'query reference', but there are {len(fields)} fields; names with spaces "
                "cannot be in such a list"
            )
        query, reference = fields
        references = pairs.setdefault(query, [])
        if reference in references:
            raise UserError(f"{path}:{number}: {query} {reference} occurs a second time")
        references.append(reference)
    if not pairs:
        raise UserError(f"{path}: the file is empty; expected lines of 'query reference'")
    return pairs


def write(path: Path, pairs: Mapping[str, Sequence[str]]) -> int:
    """Write query -> references and return the number of pairs.

    Raises
    ------
    UserError
        as `check_names`.
    """
    rows = [(query, reference) for query, references in pairs.items() for reference in references]
    check_names({*pairs, *(reference for _, reference in rows)})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{query} {reference}\n" for query, reference in rows), encoding="utf-8")
    return len(rows)


def check_names(names: Iterable[str]) -> None:
    """Raise UserError for a name that the file cannot hold: with a space, of a comment, or not in UTF-8."""
    for name in sorted(names):
        if len(name.split()) != 1:
            raise UserError(f"{name!r}: a list of pairs cannot hold a name with a space in it")
        if name.startswith("#") or not lists.is_utf8(name):
            raise UserError(f"{name!r}: a list of pairs cannot hold a name that begins with #, or is not UTF-8")


def pair_all(names: Sequence[str]) -> dict[str, Sequence[str]]:
    """Return every pair of names once, in the form of `write`."""
    return {name: names[index + 1 :] for index, name in enumerate(names)}
