"""`bench submit-check`: check submitted records."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_images, add_seed, format_count, parse_whole, print_status

SUMMARY = "check submitted records: schema, hashes, ranges, applicability and duplicates; recompute a sample of them"
EPILOG = """The attack of a recomputed record runs in a process that never holds the secret. Its plugins must be installed.
Each fault is one line on stdout, which begins with the line number in the file.

exit status: 0 no fault; 1 a fault; 2 invalid arguments

examples:
  bench submit-check runs/x
  bench submit-check theirs.jsonl --images photos/ --file K.safetensors --sample 10 --seed 7
"""
REQUIRED = ("records",)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("records", nargs="?", type=Path, metavar="FILE", help="a file of records, or a folder of bench run")
    add_images(parser, "the built-in ones")
    parser.add_argument(
        "--file",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a dictionary or network that the records use; may be repeated",
    )
    parser.add_argument(
        "--sample", type=parse_whole, default=3, metavar="N", help="number of records to recompute (default: %(default)s)"
    )
    add_seed(parser, "the sample")


def execute(args: argparse.Namespace) -> int:
    from bench.runner import records
    from leaderboard import submission

    count, faults = submission.check(
        records.find_file(args.records), images=args.images, files=args.file, sample=args.sample, seed=args.seed
    )
    for line in submission.format_faults(faults):
        print(line)
    checked = format_count(count, "record")
    if faults:
        return print_status(FAILED, f"{format_count(len(faults), 'fault')} in {checked}")
    return print_status(DONE, f"no fault in {checked}, of which at most {min(args.sample, count)} were recomputed")
