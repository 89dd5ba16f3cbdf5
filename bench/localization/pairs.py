"""Which references were retrieved for each query, as hloc's pairs files say: a line `query reference` each, best first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from bench.core.errors import UserError
from bench.formats import lists


def read(path: Path) -> dict[str, list[str]]:
    """Query -> its references, in the file's order.

    Raises
    ------
    UserError
        naming file and line, if a line is no pair or stands twice, or there is none.
    """
    found: dict[str, list[str]] = {}
    for number, fields in lists.lines(path):
        if len(fields) != 2:
            raise UserError(f"{path}:{number}: expected 'query reference', but there are {len(fields)} fields")
        query, reference = fields
        references = found.setdefault(query, [])
        if reference in references:
            raise UserError(f"{path}:{number}: {query} {reference} stands here for the second time")
        references.append(reference)
    if not found:
        raise UserError(f"{path}: nothing in it; expected lines of 'query reference'")
    return found


def write(path: Path, retrieved: Mapping[str, Sequence[str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = (f"{query} {reference}\n" for query, references in retrieved.items() for reference in references)
    path.write_text("".join(lines), encoding="utf-8")
