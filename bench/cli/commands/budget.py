"""`bench budget`: what an epsilon for a photograph leaves."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, number, print_rich, whole

SUMMARY = "say what an epsilon for a whole photograph leaves for each descriptor, and what that buys"
REQUIRED = ("image_epsilon",)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--image-epsilon", type=number, metavar="E", help="of a photograph, in all")
    parser.add_argument("--keypoints", type=whole, default=1000, metavar="N", help="of a photograph (default: %(default)s)")
    parser.add_argument("--releases", type=whole, default=1, metavar="T", help="of the photograph (default: %(default)s)")
    parser.add_argument("--words", type=whole, metavar="K", help="of the dictionary (default: those of the shipped one)")
    parser.add_argument(
        "--results", type=Path, metavar="DIR", help="of bench run: shows what was measured at the nearest epsilon"
    )


def execute(args: argparse.Namespace) -> int:
    from bench.codebook.public import Public
    from bench.mechanisms import budget
    from bench.runner import records
    from leaderboard import tables

    words = len(Public().dictionary("shipped")) if args.words is None else args.words
    plan = budget.budget(args.image_epsilon, args.keypoints, args.releases, words)
    print_rich(*budget.report(plan))
    if args.results is not None:
        measured = [dict(record) for record in budget.nearest(records.read(records.find(args.results)).records, plan.epsilon)]
        print(f"The nearest that was measured: ε = {float(measured[0]['privacy']['epsilon_descriptor']):g} for a descriptor")
        print_rich(*(tables.to_rich(table) for table in tables.tables(measured)))
    return DONE
