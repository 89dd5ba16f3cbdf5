"""Tables for the terminal with the status of runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from bench.core.table import Table, build_table
from bench.runner import directory
from bench.runner.status import read_status, summarize
from leaderboard.tables import build_labels

COLUMNS = ("task", "defense", "attack", "seed", "done", "running", "failed", "missing", "n/a")
TEXT = ("task", "defense", "attack", "n/a")  # the other columns are numbers


def build_status_table(out: Path) -> Iterator[Table | str]:
    """Yield the status of the run in a folder.

    Raises
    ------
    UserError
        if nothing was run there, or a file of the folder is damaged.
    """
    run = read_status(out)
    names = build_labels([(experiment.metadata["defense"], experiment.metadata["attack"]) for experiment in run.experiments])
    yield f"{out}: {summarize(run)}"
    rows = []
    for experiment, (defense, attack) in zip(run.experiments, names, strict=True):
        counts = ["n/a"] * 4 if experiment.reason else list(map(str, dataclasses.astuple(experiment.count)))
        metadata = experiment.metadata
        rows.append((metadata["task"], defense, attack, str(metadata["seed"]), *counts, experiment.reason or ""))
    yield build_table(COLUMNS, rows, text=TEXT)


def build_overview_table(folder: Path) -> Table:
    """Return a table with the status of every run in a folder."""
    runs = (plan.parent for plan in sorted(folder.glob(f"*/{directory.PLAN}")))
    rows = ((run.name, summarize(read_status(run))) for run in runs)
    return build_table(("run", "status"), rows, text=("run", "status"), heading=str(folder))
