"""Watches a run on the terminal: progress, notes and failures as they come."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from bench.cli.terminal import print_rich
from bench.core.progress import Progress
from bench.runner import plan
from bench.runner.engines import Engine
from bench.runner.plan import Plan
from bench.runner.records import Record


def execute_with_progress(plans: Sequence[Plan], out: Path, engine: Engine, title: str) -> list[Record]:
    """`runner.execute`, shown. Returns the records in the order of the plans."""
    records: list[Record] = []
    noted: set[str] = set()
    with Progress(title, sum(map(len, plans))) as progress:
        for record in plan.execute(plans, out, engine):
            records.append(record)
            progress.advance(note=record["unit"])
            for note in record["notes"]:
                if note not in noted:
                    progress.say(f"bench: {note}")
            noted.update(record["notes"])
            if record["status"] == "failed":
                progress.say(f"bench: failed: {record['unit']}, {record['defense']['name']}: {record['reason']}")
    return plan.sort_records(plans, records)


def print_tables(records: Sequence[Record]) -> None:
    """Print what the records come to."""
    from leaderboard import tables

    print_rich(*(tables.to_rich(table, foldable=sys.stdout.isatty()) for table in tables.tables(records)))
