"""`bench new`: write a package with a new plugin."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE

SUMMARY = "write a small package with a new plugin and a passing test of its contract"
EPILOG = """The package runs without changes. Replace its example by your own code.

examples:
  bench new defense my-defense
  pip install -e my-defense && pytest my-defense
  bench run --defense my-defense --attack keypoints
"""
REQUIRED = ("kind", "name")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", nargs="?", metavar="KIND", help="defense, attack, metric, task, extractor or dataset")
    parser.add_argument("name", nargs="?", metavar="NAME", help="lower-case letters, digits and -")
    parser.add_argument("--out", type=Path, metavar="DIR", help="a new folder (default: the name of the plugin)")


def execute(args: argparse.Namespace) -> int:
    from bench.registry import scaffold

    out = args.out or Path(args.name)
    for path in scaffold.write(args.kind, args.name, out):
        print(path)
    print(f"next: pip install -e {out} && pytest {out}")
    return DONE
