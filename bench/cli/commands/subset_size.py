"""`bench subset-size`: compare subset sizes."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, parse_number, parse_whole, parse_wholes, print_rich

SUMMARY = "compare subset sizes for a dictionary and an epsilon: information, and success of localization"
REQUIRED = ("epsilon",)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--epsilon", type=parse_number, metavar="E", help="epsilon of each descriptor")
    parser.add_argument(
        "--words", type=parse_whole, metavar="K", help="number of words of the dictionary (default: that of the shipped one)"
    )
    parser.add_argument(
        "--sizes",
        type=parse_wholes,
        metavar="M,M,...",
        help="subset sizes to compare (default: 1, 2, 4, 8, 16 and the two optima of theory)",
    )
    parser.add_argument(
        "--keypoints", type=parse_whole, default=1000, metavar="N", help="keypoints per query (default: %(default)s)"
    )
    parser.add_argument(
        "--repeated",
        type=parse_number,
        default=0.27,
        metavar="FRACTION",
        help="fraction of keypoints whose word occurs at their point in the retrieved references (default: %(default)s)",
    )
    parser.add_argument(
        "--points",
        type=parse_whole,
        default=5000,
        metavar="R",
        help="3D points in these references (default: %(default)s)",
    )
    parser.add_argument("--trials", type=parse_whole, default=30_000, metavar="T", help="trials of RANSAC (default: %(default)s)")
    parser.add_argument(
        "--results",
        type=Path,
        metavar="DIR",
        help="results of localization; shows their recall by day, and uses the repeated fractions measured without a guarantee",
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
        found = records.read(records.find_file(args.results)).records
        recalls, repeated = subset_size.collect_recalls(found, args.epsilon, words, args.trials, "day")
    candidates = {1, 2, 4, 8, 16, most_accurate_size(args.epsilon, words), most_informative_size(args.epsilon, words)}
    sizes = args.sizes or sorted(size for size in candidates if size < words)
    service = subset_size.Workload(
        keypoints=args.keypoints, repeatability=repeated or [args.repeated], points=args.points, trials=args.trials
    )
    rows = subset_size.estimate_sizes(args.epsilon, words, sizes, service)
    print_rich(subset_size.report(rows, args.epsilon, words, recalls))
    return DONE
