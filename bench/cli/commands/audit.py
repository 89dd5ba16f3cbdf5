"""`bench audit`: a bound of a defense's epsilon from below, by what it releases."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_seed, print_rich, whole

SUMMARY = "bound a defense's epsilon from below by what it releases; exit status 1 if it is violated"
REQUIRED = ("defense",)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--defense", metavar="SPEC", help="one that claims an epsilon")
    parser.add_argument("--words", type=whole, metavar="K", help="of a made-up dictionary to report from (default: its own)")
    parser.add_argument(
        "--trials", type=whole, default=100_000, metavar="N", help="releases of each of two descriptors (default: %(default)s)"
    )
    add_seed(parser)


def execute(args: argparse.Namespace) -> int:
    import tempfile

    from bench.audit import tables
    from bench.audit.auditor import audit
    from bench.registry import discovery, spec

    with tempfile.TemporaryDirectory() as folder:
        found = audit(spec.read(args.defense, discovery.DEFENSE), args.words, args.trials, args.seed, Path(folder))
    print_rich(*tables.report(found, args.defense))
    return FAILED if found.verdict == "violated" else DONE
