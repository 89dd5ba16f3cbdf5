"""`bench reproduce`: our results beside the tables and figures of the paper."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, add_extractor, add_images, add_seed, parse_whole, print_rich, print_status

SUMMARY = "reproduce a table of the paper, or its figures, beside the published values"
EPILOG = """Each table shows intervals over the photographs, and a verdict on each claim of the paper.
With --profile paper, it first names the data of the paper that are replaced by our own, and the commands that download them.

examples:
  bench reproduce table1
  bench reproduce table4 --images DIR --out runs/test
  bench reproduce figures --profile smoke
  bench reproduce tableS2 --dataset captured:path=DIR,leading=25
"""
REQUIRED = ("what",)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", nargs="?", metavar="NAME", help="table1, table2, tableS2, figures, ...")
    parser.add_argument(
        "--profile",
        metavar="NAME",
        default="cpu",
        help="smoke, cpu, dense or paper: the size of the experiment (default: %(default)s)",
    )
    add_images(parser, "the built-in ones")
    parser.add_argument("--dataset", metavar="SPEC", help="the scene, for tables about localization (default: a gallery)")
    parser.add_argument(
        "--workers", type=parse_whole, metavar="N", help="worker processes, for tables about localization (default: one per core)"
    )
    add_extractor(parser, None, "the table's own")
    add_seed(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results; resumed if it exists (default: a folder in runs/)"
    )
    parser.add_argument("--dictionary", metavar="FILE", help="dictionary K of LDP-Feat (default: the shipped one)")
    parser.add_argument("--database", metavar="FILE", help="database W of affine lifting (default: the shipped one)")
    parser.add_argument("--public-database", metavar="FILE", help="database Z of the attacker (default: the shipped one)")
    for network, defense in (("raw", "none"), ("affine", "affine"), ("ldp", "ldp")):
        parser.add_argument(
            f"--{network}-network", metavar="FILE", help=f"network trained for `{defense}` (default: the shipped one)"
        )
    for defense, stacked in (("affine", "stacked origin and basis"), ("ldp", "stacked words")):
        parser.add_argument(
            f"--as-printed-{defense}",
            metavar="FILE",
            help=f"network trained for `{defense}` with the paper's input, {stacked} (default: none; the table omits these rows)",
        )


def execute(args: argparse.Namespace) -> int:
    from bench.registry import discovery, spec
    from leaderboard import reproduce

    materials = {name: getattr(args, name) for name in reproduce.list_materials() if getattr(args, name)}
    if args.profile == "paper":
        given = {*materials, *(name for name in ("images", "dataset") if getattr(args, name) is not None)}
        for line in reproduce.list_missing(args.what, given):
            print_status(DONE, f"not the paper's: {line}")
    done = reproduce.reproduce(
        args.what,
        args.profile,
        images=args.images,
        dataset=None if args.dataset is None else spec.read(args.dataset, discovery.DATASET),
        extractor=None if args.extractor is None else spec.read(args.extractor, discovery.EXTRACTOR),
        seed=args.seed,
        out=args.out,
        workers=args.workers,
        materials=materials,
        command=args.command,
    )
    print_rich(*done.output)
    print_status(DONE, f"written to {done.out}")
    return FAILED if done.failed else DONE
