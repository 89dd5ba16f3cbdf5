"""`bench dataset`: write a dataset into a folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, parse_whole

SUMMARY = "write a dataset, such as the gallery, into a folder for other programs"
REQUIRED = ("dataset", "layout", "out")


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", nargs="?", metavar="SPEC", help="name:field=value,... (bench list datasets)")
    parser.add_argument("--layout", metavar="aachen|colmap", help="the layout of the folder")
    parser.add_argument("--out", type=Path, metavar="DIR", help="a new folder")
    parser.add_argument("--views", type=parse_whole, metavar="N", help="number of reference images; sets the field of that name")
    parser.add_argument("--queries", type=parse_whole, metavar="N", help="number of queries; sets the field of that name")
    parser.add_argument("--seed", type=parse_whole, metavar="N", help="seed of the dataset; sets the field of that name")


def execute(args: argparse.Namespace) -> int:
    from bench.formats import scene_export
    from bench.registry import discovery, spec

    plugin, given = spec.parse(args.dataset, discovery.DATASET)
    for name in ("views", "queries", "seed"):
        value = getattr(args, name)
        if value is not None:
            given |= spec.parse(f"{plugin.name()}:{name}={value}", discovery.DATASET)[1]
    scene = spec.build(plugin, given).scene()
    scene_export.write(scene, args.layout, args.out)
    print(f"{args.out}: {len(scene.references)} references and {len(scene.queries)} queries of {scene.name}, as {args.layout}")
    return DONE
