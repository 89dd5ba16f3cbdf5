"""Tables of the status of runs, for the terminal."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table
from rich.text import Text

from bench.runner import directory
from bench.runner.status import read_status, summarize
from leaderboard.tables import build_labels


def build_status_table(out: Path) -> Iterator[Table | Text]:
    """Yield the status of the run in a folder.

    Raises
    ------
    UserError
        as `status`.
    """
    run = read_status(out)
    names = build_labels([(experiment.metadata["defense"], experiment.metadata["attack"]) for experiment in run.experiments])
    yield Text(f"{out}: {summarize(run)}")
    table = Table()
    for column in ("task", "defense", "attack", "seed", "done", "running", "failed", "missing", "n/a"):
        table.add_column(column, overflow="fold", justify="left" if column in ("task", "defense", "attack", "n/a") else "right")
    for experiment, (defense, attack) in zip(run.experiments, names, strict=True):
        counts = ["n/a"] * 4 if experiment.reason else list(map(str, dataclasses.astuple(experiment.count)))
        row = (experiment.metadata["task"], defense, attack, str(experiment.metadata["seed"]), *counts, experiment.reason or "")
        table.add_row(*map(Text, row))
    yield table


def build_overview_table(folder: Path) -> Table:
    """Return a table with the status of every run in a folder."""
    table = Table(title=Text(str(folder)), title_justify="left")
    for column in ("run", "status"):
        table.add_column(column, overflow="fold")
    for plan in sorted(folder.glob(f"*/{directory.PLAN}")):
        table.add_row(Text(plan.parent.name), Text(summarize(read_status(plan.parent))))
    return table
