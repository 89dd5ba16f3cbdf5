"""`bench scale`: what a service costs."""

from __future__ import annotations

import argparse
import sys

from bench.cli.terminal import DONE, print_rich, whole

SUMMARY = "measure this machine, and say what a service costs: operations, bytes and time of a query, and of a day's"
EPILOG = """Times are of one core; those of a phone's differ. `bench scale` takes some seconds to measure.

examples:
  bench scale
  bench scale --queries 1000000 --keypoints 2000 --words 32000
"""
REQUIRED = ()
COLUMNS = ("who", "step", "operations", "bytes", "core seconds", "TB a day", "cores")


def options(parser: argparse.ArgumentParser) -> None:
    from bench.core.errors import UserError

    def positive(text: str) -> int:
        if (found := whole(text)) < 1:
            raise UserError(f"{text} must be at least 1")
        return found

    parser.add_argument("--queries", type=positive, default=1_000_000, metavar="N", help="a day (default: %(default)s)")
    parser.add_argument("--keypoints", type=positive, default=1000, metavar="N", help="of a photograph (default: %(default)s)")
    parser.add_argument("--words", type=positive, default=256_000, metavar="K", help="of the dictionary (default: %(default)s)")
    parser.add_argument(
        "--subset-size", type=positive, default=2, metavar="M", help="words sent a keypoint (default: %(default)s)"
    )
    parser.add_argument("--references", type=positive, default=20, metavar="R", help="images to match (default: %(default)s)")
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")


def execute(args: argparse.Namespace) -> int:
    from rich.table import Table

    from leaderboard import cost
    from leaderboard.tables import markdown_row

    service = cost.Service(keypoints=args.keypoints, words=args.words, subset_size=args.subset_size, references=args.references)
    rows = cost.rows(service, cost.measure(service), args.queries)
    if args.markdown:
        lines = [markdown_row(COLUMNS), markdown_row("---" for _ in COLUMNS), *map(markdown_row, rows)]
        sys.stdout.write("\n".join(lines) + "\n")
        return DONE
    table = Table(title=f"A query of {args.keypoints} keypoints, and {args.queries:,} a day", title_justify="left")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column in COLUMNS[:2] else "right")
    for row in rows:
        table.add_row(*row)
    print_rich(table)
    return DONE
