"""The status of a run, as tables for a terminal."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table
from rich.text import Text

from bench.runner import directory
from bench.runner.status import status, summarize
from leaderboard.tables import labels


def status_table(out: Path) -> Iterator[Table | Text]:
    """The status of a folder for a terminal.

    Raises
    ------
    UserError
        as `status`.
    """
    found = status(out)
    names = labels([(cell.metadata["defense"], cell.metadata["attack"]) for cell in found.experiments])
    yield Text(f"{out}: {summarize(found)}")
    table = Table()
    for column in ("task", "defense", "attack", "seed", "done", "running", "failed", "missing", "n/a"):
        table.add_column(column, overflow="fold", justify="left" if column in ("task", "defense", "attack", "n/a") else "right")
    for cell, (defense, attack) in zip(found.experiments, names, strict=True):
        counts = ["n/a"] * 4 if cell.reason else list(map(str, dataclasses.astuple(cell.count)))
        row = (cell.metadata["task"], defense, attack, str(cell.metadata["seed"]), *counts, cell.reason or "")
        table.add_row(*map(Text, row))
    yield table


def overview_table(folder: Path) -> Table:
    """The status of every run in a folder, one a line."""
    table = Table(title=Text(str(folder)), title_justify="left")
    for column in ("run", "status"):
        table.add_column(column, overflow="fold")
    for plan in sorted(folder.glob(f"*/{directory.PLAN}")):
        table.add_row(Text(plan.parent.name), Text(summarize(status(plan.parent))))
    return table
