"""`bench budget`: the epsilon of one descriptor for a given epsilon of a photograph."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, parse_number, parse_whole, print_rich

SUMMARY = "compute the epsilon of each descriptor for a given epsilon of a photograph, and the resulting accuracy"
REQUIRED = ("image_epsilon",)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--image-epsilon", type=parse_number, metavar="E", help="epsilon of the whole photograph")
    parser.add_argument(
        "--keypoints", type=parse_whole, default=1000, metavar="N", help="keypoints per photograph (default: %(default)s)"
    )
    parser.add_argument(
        "--releases", type=parse_whole, default=1, metavar="T", help="number of releases of the photograph (default: %(default)s)"
    )
    parser.add_argument(
        "--words", type=parse_whole, metavar="K", help="number of words of the dictionary (default: that of the shipped one)"
    )
    parser.add_argument(
        "--results", type=Path, metavar="DIR", help="results of bench run; shows their records at the nearest epsilon"
    )


def execute(args: argparse.Namespace) -> int:
    from bench.codebook.public import Public
    from bench.mechanisms import budget
    from bench.runner import records
    from leaderboard.tables import build_tables

    words = len(Public().dictionary("shipped")) if args.words is None else args.words
    plan = budget.divide_budget(args.image_epsilon, args.keypoints, args.releases, words)
    print_rich(*budget.report(plan))
    if args.results is not None:
        measured = [
            dict(record)
            for record in budget.select_nearest_records(records.read(records.find_file(args.results)).records, plan.epsilon)
        ]
        print(f"Nearest measured setting: ε = {float(measured[0]['privacy']['epsilon_descriptor']):g} for a descriptor")
        print_rich(*build_tables(measured, brief=True))
    return DONE
