"""Execution of a run with its progress, notes and failures on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from bench.cli.terminal import print_rich
from bench.core.progress import Progress
from bench.runner.engines.base import Engine
from bench.runner.execute import execute, sort_records
from bench.runner.plan import Plan
from bench.runner.records import Record


def execute_with_progress(plans: Sequence[Plan], out: Path, engine: Engine, title: str) -> list[Record]:
    """Execute plans with a progress bar, and return the records in the order of the plans."""
    records: list[Record] = []
    shown_notes: set[str] = set()
    with Progress(title, sum(map(len, plans))) as progress:
        for record in execute(plans, out, engine):
            records.append(record)
            progress.advance(note=record["sample"])
            for note in record["notes"]:
                if note not in shown_notes:
                    progress.log(f"bench: {note}")
            shown_notes.update(record["notes"])
            if record["status"] == "failed":
                progress.log(f"bench: failed: {record['sample']}, {record['defense']['name']}: {record['reason']}")
    return sort_records(plans, records)


def print_tables(records: Sequence[Record]) -> None:
    """Print the tables of records, and the worst cases over the suites of attacks that were run."""
    from leaderboard.run_report import build_suite_tables
    from leaderboard.tables import build_tables

    print_rich(*build_tables(records, brief=True, foldable=sys.stdout.isatty()), *build_suite_tables(records, brief=True))
