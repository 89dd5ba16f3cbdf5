"""`bench dictionary build`: build a dictionary of descriptors."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, add_extractor, add_images, add_seed, parse_whole, require
from bench.core.errors import UserError, unknown_name

SUMMARY = "build a dictionary of descriptors: bench dictionary build"
REQUIRED = ()


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", nargs="?", type=_parse_action, metavar="build", help="cluster the descriptors of a folder")
    add_images(parser)
    parser.add_argument("--size", type=parse_whole, metavar="K", help="number of words")
    parser.add_argument("--out", type=Path, metavar="FILE", help="a new safetensors file")
    add_seed(parser, "the clustering")
    add_extractor(parser)


def execute(args: argparse.Namespace) -> int:
    from bench.codebook.build import build
    from bench.registry import discovery, spec

    if args.what is None:
        raise UserError("give an action: bench dictionary build")
    require(args, ("images", "size", "out"), "dictionary build")

    built = build(args.images, args.size, args.out, spec.read(args.extractor, discovery.EXTRACTOR), args.seed)
    print(f"{args.out}: {len(built)} words from {built.meta['descriptors']} descriptors of {len(built.photographs)} photographs,")
    print(f"mean cosine {built.meta['mean_cosine']:.4f}, {built.digest}")
    return DONE


def _parse_action(text: str) -> str:
    if text != "build":
        raise unknown_name("command", f"dictionary {text}", ["dictionary build"])
    return text
