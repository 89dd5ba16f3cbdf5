"""`bench audit`: a lower bound of a defense's epsilon, estimated from its releases."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_seed, parse_whole, print_rich

SUMMARY = "estimate a lower bound of a defense's epsilon from its releases; exit status 1 if the claim is violated"
REQUIRED = ("defense",)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--defense", metavar="SPEC", help="a defense that claims an epsilon")
    parser.add_argument(
        "--words", type=parse_whole, metavar="K", help="size of a synthetic dictionary (default: the defense's own dictionary)"
    )
    parser.add_argument(
        "--trials",
        type=parse_whole,
        default=100_000,
        metavar="N",
        help="number of releases of each of two descriptors (default: %(default)s)",
    )
    add_seed(parser)


def execute(args: argparse.Namespace) -> int:
    import tempfile

    from bench.audit import tables
    from bench.audit.auditor import audit
    from bench.registry import discovery, spec

    with tempfile.TemporaryDirectory() as folder:
        result = audit(spec.read(args.defense, discovery.DEFENSE), args.words, args.trials, args.seed, Path(folder))
    print_rich(*tables.report(result, args.defense))
    return FAILED if result.verdict == "violated" else DONE
