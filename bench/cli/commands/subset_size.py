"""`bench choose`: how many words to release."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, number, print_rich, whole, wholes

SUMMARY = "say how many words to release for a dictionary and an epsilon: by what they tell, and by what a server can do"
REQUIRED = ("epsilon",)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--epsilon", type=number, metavar="E", help="of a descriptor")
    parser.add_argument("--words", type=whole, metavar="K", help="of the dictionary (default: those of the shipped one)")
    parser.add_argument(
        "--sizes", type=wholes, metavar="M,M,...", help="to choose from (default: powers of 2, and the best known)"
    )
    parser.add_argument("--keypoints", type=whole, default=1000, metavar="N", help="of a query (default: %(default)s)")
    parser.add_argument(
        "--repeated",
        type=number,
        default=0.27,
        metavar="SHARE",
        help="of these, that have their point's word in the retrieved references (default: %(default)s)",
    )
    parser.add_argument("--points", type=whole, default=5000, metavar="R", help="of these references (default: %(default)s)")
    parser.add_argument("--trials", type=whole, default=30_000, metavar="T", help="of RANSAC (default: %(default)s)")
    parser.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        help="of localization: shows what was measured by day, and takes the queries' own shares where nothing was hidden",
    )


def execute(args: argparse.Namespace) -> int:
    from bench.codebook.public import Public
    from bench.mechanisms import subset_size
    from bench.mechanisms.subset import most_accurate_size, most_informative_size
    from bench.runner import records

    words = len(Public().dictionary("shipped")) if args.words is None else args.words
    recalls: dict[int, list[float]] = {}
    repeated: list[float] = []
    if args.results is not None:
        found = records.read(records.find(args.results)).records
        recalls, repeated = subset_size.measured(found, args.epsilon, words, args.trials, "day")
    known = {1, 2, 4, 8, 16, most_accurate_size(args.epsilon, words), most_informative_size(args.epsilon, words)}
    sizes = args.sizes or sorted(size for size in known if size < words)
    service = subset_size.Service(
        keypoints=args.keypoints, repeated=repeated or [args.repeated], points=args.points, trials=args.trials
    )
    rows = subset_size.choices(args.epsilon, words, sizes, service)
    print_rich(*subset_size.report(rows, args.epsilon, words, recalls))
    return DONE
