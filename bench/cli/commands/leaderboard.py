"""`bench leaderboard`: write tables, plots and a page from records."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, print_status

SUMMARY = "write tables, plots and an offline page from the records of any number of runs"
EPILOG = """The page is OUT/index.html, with the folders tables/ (Markdown, CSV, LaTeX), plots/ (PNG, PDF) and pictures/.

examples:
  bench leaderboard --results runs/ --out site/
  bench leaderboard --results runs/a runs/b --out site/
"""
REQUIRED = ("results", "out")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--results",
        type=Path,
        nargs="+",
        action="extend",
        metavar="DIR",
        help="folders of bench run, with all records below them, or files of records; may be repeated",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="the folder to write; earlier output is overwritten")


def execute(args: argparse.Namespace) -> int:
    from leaderboard import site

    written = site.write(args.results, args.out)
    counts = f"comparison groups: {written.groups}, experiments: {written.experiments}, records: {written.records}"
    return print_status(DONE, f"written to {written.page} ({counts})")
