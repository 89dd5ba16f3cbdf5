"""`bench list`: list plugins."""

from __future__ import annotations

import argparse

from bench.cli.terminal import DONE, print_rich
from bench.core.errors import unknown_name

SUMMARY = "list plugins with their fields, and the applicability of each attack to each defense"
REQUIRED = ()


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("section", nargs="?", metavar="defenses|attacks|metrics|tasks|datasets|extractors")


def execute(args: argparse.Namespace) -> int:
    from bench.cli.listing import SECTIONS, build_listing

    if args.section is not None and args.section not in SECTIONS:
        raise unknown_name("list", args.section, SECTIONS)
    print_rich(*build_listing(args.section))
    return DONE
