"""`bench status`: progress of a run or a suite."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, print_rich
from bench.core.errors import UserError

SUMMARY = "show the progress of a run or suite: numbers of done, running, failed, missing and inapplicable samples"
EPILOG = """examples:
  bench status                      # every run in runs/
  bench status paper-table-1
  bench status --results runs/mine
"""
REQUIRED = ()


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("suite", nargs="?", metavar="SUITE", help="a suite that was run by bench sweep without --out")
    parser.add_argument("--results", type=Path, metavar="DIR", help="a folder of bench run, sweep or reproduce")


def execute(args: argparse.Namespace) -> int:
    from bench.cli.status import build_overview_table, build_status_table
    from bench.runner import suite

    if args.suite is not None and args.results is not None:
        raise UserError("give a suite or --results, not both")
    if args.suite is not None:
        print_rich(*build_status_table(suite.choose_folder(args.suite)))
    elif args.results is not None:
        print_rich(*build_status_table(args.results))
    else:
        print_rich(build_overview_table(Path("runs")))
    return DONE
