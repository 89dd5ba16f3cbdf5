"""`bench sweep`: run a suite, on one machine or many."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_engine, add_images, print_status
from bench.core.errors import UserError

SUMMARY = "run a suite of experiments, on one machine or many; finished records are not computed again"
EPILOG = """SUITE is a name (smoke, paper-table-1, ..., full), or your own suite: module:NAME or path/to/file.py:NAME.

examples:
  bench sweep smoke
  bench sweep paper-table-1 --workers 2
  bench sweep mine.py:SUITE --images DIR --out runs/mine
  bench sweep full --engine dask --scheduler tcp://127.0.0.1:8786
"""
REQUIRED = ()


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("suite", nargs="?", metavar="SUITE", help="the suite; without it, all suites are listed")
    add_images(parser, "those of the suite")
    add_engine(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: a folder in runs/)"
    )


def execute(args: argparse.Namespace) -> int:
    from bench.cli import watch
    from bench.runner import engines, suite
    from bench.runner.plan import build_plan
    from bench.runner.trial import dry_run
    from leaderboard import run_report

    if args.suite is None:
        return _list()
    selected = suite.find(args.suite)
    if args.images is not None:
        selected = selected.with_images(args.images)
    if not selected.parts:
        raise UserError(f"suite {args.suite!r} has no parts")
    engine = engines.choose_engine(args.workers, args.engine, args.scheduler)
    plans = [build_plan(part, engine.describe) for part in selected.parts]
    for plan in plans:
        dry_run(plan)
    out = args.out or suite.choose_folder(args.suite)
    pairs = sum(len(plan.experiments) for plan in plans)
    records = watch.execute_with_progress(plans, out, engine, f"{args.suite}: {pairs} pairs")
    run_report.write(records, out, args.command)
    watch.print_tables(records)
    print_status(DONE, f"written to {out}")
    return FAILED if any(record["status"] == "failed" for record in records) else DONE


def _list() -> int:
    from bench.runner import suite

    for name in suite.list_suites():
        print(f"{name}: {suite.find(name).summary}")
    return DONE
