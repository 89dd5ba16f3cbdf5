"""`bench dataset`: write a dataset into a folder, or download a published one."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.cli.terminal import DONE, FAILED, INTERRUPTED, parse_whole, print_rich, print_status, require
from bench.core.errors import UserError

SUMMARY = "write a dataset, such as the gallery, for other programs; or download a published one: bench dataset fetch"
EPILOG = """bench dataset fetch lists the published datasets. With a name it shows the licence, the files and their checksums, and
downloads nothing. With --to it shows the licence first, and then downloads. An interrupted download is resumed.

examples:
  bench dataset gallery --layout colmap --out gallery/
  bench dataset fetch
  bench dataset fetch places365-val
  bench dataset fetch places365-val --to places/
  bench dataset fetch hpatches --to hpatches/ --unverified
"""
REQUIRED = ("dataset",)
FETCH = "fetch"
RESUME = "received files are stored; run the same command again to continue"


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", nargs="?", metavar="SPEC|fetch", help="name:field=value,... (bench list datasets), or fetch")
    parser.add_argument("name", nargs="?", metavar="NAME", help="the published dataset; without it, all are listed")
    parser.add_argument("--layout", metavar="aachen|colmap", help="the layout of the folder")
    parser.add_argument("--out", type=Path, metavar="DIR", help="a new folder")
    parser.add_argument("--views", type=parse_whole, metavar="N", help="number of reference images; sets the field of that name")
    parser.add_argument("--queries", type=parse_whole, metavar="N", help="number of queries; sets the field of that name")
    parser.add_argument("--seed", type=parse_whole, metavar="N", help="seed of the dataset; sets the field of that name")
    parser.add_argument("--to", type=Path, metavar="DIR", help="fetch: a new folder, or that of an interrupted download")
    parser.add_argument(
        "--checksum",
        action="append",
        default=[],
        metavar="FILE=sha256:...",
        help="fetch: the checksum of a file, in place of the published one; may be repeated",
    )
    parser.add_argument("--unverified", action="store_true", help="fetch: accept files without a published checksum")


def execute(args: argparse.Namespace) -> int:
    if args.dataset == FETCH:
        return _fetch(args)
    if args.name is not None:
        raise UserError(f"{args.name!r} is an unexpected argument")
    require(args, ("layout", "out"), "dataset")
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


def _fetch(args: argparse.Namespace) -> int:
    from bench.core.table import build_table
    from bench.formats import published

    if args.name is None:
        rows = [(name, each.title, each.licence) for name, each in published.DATASETS.items()]
        print_rich(build_table(("name", "dataset", "licence"), rows, text=("name", "dataset", "licence")))
        return DONE
    print(published.describe(args.name, args.to), flush=True)
    if args.to is None:
        return print_status(DONE, f"nothing was downloaded; to accept the licence and download: --to DIR with {args.name}")
    pairs = [text.partition("=") for text in args.checksum]
    try:
        for line in published.fetch(args.name, args.to, {file: value for file, _, value in pairs}, args.unverified):
            print(line, flush=True)
    except KeyboardInterrupt:
        return print_status(INTERRUPTED, f"interrupted; {RESUME}")
    except OSError as error:
        return print_status(FAILED, f"{error.filename or args.to}: {error.strerror or error}; {RESUME}")
    return print_status(DONE, f"in {args.to}; {published.RECORD} there states what was verified")
