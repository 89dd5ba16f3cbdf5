"""`bench sweep`: a whole suite, on one machine or many."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_engine, say
from bench.core.errors import UserError

SUMMARY = "run a suite of experiments, on one machine or many; what was done is not done again"
EPILOG = """A suite is a name (smoke, paper-table-1, ..., full), or one of your own: module:NAME or path/to/file.py:NAME.

examples:
  bench sweep smoke
  bench sweep paper-table-1 --workers 2
  bench sweep mine.py:SUITE --images DIR --out runs/mine
  bench sweep full --engine dask --scheduler tcp://HOST:8786
"""
REQUIRED = ()


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("suite", nargs="?", metavar="SUITE", help="what to run; without it the suites are listed")
    parser.add_argument("--images", type=Path, metavar="DIR", help="a folder of photographs (default: those of the suite)")
    add_engine(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: in runs/)"
    )


def execute(args: argparse.Namespace) -> int:
    from bench.cli import watch
    from bench.runner import engines, suite
    from bench.runner import plan as runner
    from leaderboard import run_report

    if args.suite is None:
        return _list()
    chosen = suite.find(args.suite)
    if args.images is not None:
        chosen = chosen.on(args.images)
    if not chosen.parts:
        raise UserError(f"suite {args.suite!r} has no parts")
    engine = engines.choose_engine(args.workers, args.engine, args.scheduler)
    plans = [runner.prepared(part, engine.describe) for part in chosen.parts]
    out = args.out or suite.folder(args.suite)
    pairs = sum(len(plan.experiments) for plan in plans)
    records = watch.execute_with_progress(plans, out, engine, f"{args.suite}: {pairs} pairs")
    units = {unit.name: unit for plan in plans for unit in plan.samples}
    run_report.write(records, list(units.values()), out)
    watch.print_tables(records)
    say(DONE, f"written to {out}")
    return FAILED if any(record["status"] == "failed" for record in records) else DONE


def _list() -> int:
    from bench.runner import suite

    for name in suite.names():
        print(f"{name}: {suite.find(name).summary}")
    return DONE
