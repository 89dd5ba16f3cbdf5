"""`bench submit-check`: somebody's records, before they are believed."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_seed, say, whole

SUMMARY = "check somebody's records: schema, hashes, ranges, applicability, duplicates; and make a sample of them again"
EPILOG = """A record is made again with its attack in a process that never holds the secret. It and its plugins must be installed.
Every complaint is a line on stdout that begins with the line of the file.

exit status: 0 nothing is wrong, 1 something is, 2 a mistake in what was asked

examples:
  bench submit-check runs/x
  bench submit-check theirs.jsonl --images photos/ --file K.safetensors --sample 10 --seed 7
"""
REQUIRED = ("records",)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("records", nargs="?", type=Path, metavar="FILE", help="records, or a folder of bench run's")
    parser.add_argument("--images", type=Path, metavar="DIR", help="the photographs, if they are not the built-in ones")
    parser.add_argument(
        "--file",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a dictionary or network; may be repeated",
    )
    parser.add_argument("--sample", type=whole, default=3, metavar="N", help="records to make again (default: %(default)s)")
    add_seed(parser, "the sample")


def execute(args: argparse.Namespace) -> int:
    from bench.runner import records
    from leaderboard import submission

    count, faults = submission.check(
        records.find(args.records), images=args.images, files=args.file, sample=args.sample, seed=args.seed
    )
    for line in submission.lines(faults):
        print(line)
    if faults:
        return say(FAILED, f"{len(faults)} faults in {count} records")
    return say(DONE, f"nothing is wrong with {count} records, of which {min(args.sample, count)} at most were made again")
