"""`bench status`: how far a run or a suite is."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, print_rich
from bench.core.errors import UserError

SUMMARY = "show what of a run or suite is done, running, failed, not applicable or missing"
EPILOG = """examples:
  bench status                      # every run in runs/
  bench status paper-table-1
  bench status --results runs/mine
"""
REQUIRED = ()


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("suite", nargs="?", metavar="SUITE", help="as bench sweep was given it, if it was given no --out")
    parser.add_argument("--results", type=Path, metavar="DIR", help="a folder that bench run, sweep or reproduce writes")


def execute(args: argparse.Namespace) -> int:
    from bench.cli.status import overview_table, status_table
    from bench.runner import suite

    if args.suite is not None and args.results is not None:
        raise UserError("give a suite or --results, not both")
    if args.suite is not None:
        print_rich(*status_table(suite.folder(args.suite)))
    elif args.results is not None:
        print_rich(*status_table(args.results))
    else:
        print_rich(overview_table(Path("runs")))
    return DONE
