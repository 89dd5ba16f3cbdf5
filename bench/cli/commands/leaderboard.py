"""`bench leaderboard`: tables, plots and a page, from records alone."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, say

SUMMARY = "make tables, plots and a page that needs no network from the records of any number of runs"
EPILOG = """The page is OUT/index.html; beside it lie tables/ (Markdown, CSV, LaTeX), plots/ (PNG, PDF) and pictures/.

examples:
  bench leaderboard --results runs/ --out site/
"""
REQUIRED = ("results", "out")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--results", type=Path, metavar="DIR", help="of bench run; all records below it are taken")
    parser.add_argument("--out", type=Path, metavar="DIR", help="what is written; over what was written there before")


def execute(args: argparse.Namespace) -> int:
    from leaderboard import site

    done = site.write(args.results, args.out)
    return say(DONE, f"written to {done.page} (boards: {done.boards}, cells: {done.cells}, records: {done.records})")
