"""`bench cost`: the cost of a service."""

from __future__ import annotations

import argparse
import dataclasses
import sys

from bench.cli.terminal import DONE, parse_whole, print_rich

SUMMARY = "measure this machine and estimate the cost of a service: operations, bytes and time, per query and per day"
EPILOG = """Times are measured on one core of this machine; a phone differs. The measurement takes some seconds.

examples:
  bench cost
  bench cost --queries 1000000 --keypoints 2000 --words 32000
"""
REQUIRED = ()


def add_options(parser: argparse.ArgumentParser) -> None:
    from bench.core.errors import UserError

    def parse_positive(text: str) -> int:
        if (number := parse_whole(text)) < 1:
            raise UserError(f"{text} must be at least 1")
        return number

    parser.add_argument(
        "--queries", type=parse_positive, default=1_000_000, metavar="N", help="queries per day (default: %(default)s)"
    )
    parser.add_argument(
        "--keypoints", type=parse_positive, default=1000, metavar="N", help="keypoints per photograph (default: %(default)s)"
    )
    parser.add_argument(
        "--words",
        type=parse_positive,
        default=256_000,
        metavar="K",
        help="words in the dictionary (default: %(default)s)",
    )
    parser.add_argument(
        "--subset-size", type=parse_positive, default=2, metavar="M", help="words released per keypoint (default: %(default)s)"
    )
    parser.add_argument(
        "--references", type=parse_positive, default=20, metavar="R", help="reference images per query (default: %(default)s)"
    )
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")


def execute(args: argparse.Namespace) -> int:
    from bench.core.table import to_markdown
    from leaderboard import cost

    service = cost.Service(keypoints=args.keypoints, words=args.words, subset_size=args.subset_size, references=args.references)
    table = cost.build_cost_table(service, cost.measure_rates(service), args.queries)
    if args.markdown:
        sys.stdout.write(to_markdown(dataclasses.replace(table, heading=""), plain=True))
    else:
        print_rich(table)
    return DONE
