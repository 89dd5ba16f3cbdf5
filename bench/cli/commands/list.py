"""`bench list`: what there is."""

from __future__ import annotations

import argparse

from bench.cli.terminal import DONE, print_rich
from bench.core.errors import unknown_name

SUMMARY = "list plugins with their fields, and which attack applies to which defense"
REQUIRED = ()


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", nargs="?", metavar="defenses|attacks|metrics|tasks|extractors")


def execute(args: argparse.Namespace) -> int:
    from bench.cli.listing import SECTIONS, listing

    if args.what is not None and args.what not in SECTIONS:
        raise unknown_name("list", args.what, SECTIONS)
    print_rich(*listing(args.what))
    return DONE
