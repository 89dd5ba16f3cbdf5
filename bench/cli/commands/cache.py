"""`bench cache`: what is kept so that it need not be made again."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from bench.cli.terminal import DONE, FAILED, number, print_rich, size, told_size
from bench.core.errors import UserError, unknown_name

if TYPE_CHECKING:
    from bench.cache.store import Entry

SUMMARY = "list, verify or prune what is kept so that it need not be made again: bench cache list"
EPILOG = """All of it can be made again. It lies in runs/cache, or where the environment's FEATURE_PRIVACY_CACHE says.

examples:
  bench cache list
  bench cache verify
  bench cache prune --older-than 30 --kind recovered
  bench cache prune --damaged
"""
REQUIRED = ()
ACTIONS = ("list", "verify", "prune")
DAY = 24 * 3600.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "what", nargs="?", metavar="list|verify|prune", help="show it, check every checksum, or remove some of it"
    )
    parser.add_argument("--kind", metavar="KIND", help="only this kind, such as features")
    parser.add_argument("--older-than", type=number, metavar="DAYS", help="only what was not used for so long")
    parser.add_argument("--larger-than", type=size, metavar="SIZE", help="only what is larger, such as 20MB")
    parser.add_argument("--damaged", action="store_true", help="only what is damaged, or was never finished")


def execute(args: argparse.Namespace) -> int:
    if args.what not in ACTIONS:
        raise (
            UserError(f"say what to do: bench cache {'|'.join(ACTIONS)}")
            if args.what is None
            else unknown_name("command", f"cache {args.what}", [f"cache {action}" for action in ACTIONS])
        )
    chosen = _chosen(args)
    if args.what == "list":
        _list(chosen)
        return DONE
    if args.what == "verify":
        return _verify(chosen)
    return _prune(args, chosen)


def _chosen(args: argparse.Namespace) -> list[Entry]:
    """What the options say."""
    import time

    from bench.cache import store

    found = list(store.entries())
    kinds = {entry.kind for entry in found}
    if args.kind is not None and args.kind not in kinds:
        raise unknown_name("kind", args.kind, kinds)
    now = time.time()
    return [
        entry
        for entry in found
        if args.kind in (None, entry.kind)
        and (args.older_than is None or now - entry.used > args.older_than * DAY)
        and (args.larger_than is None or entry.size > args.larger_than)
        and (not args.damaged or entry.fault() is not None)
    ]


def _list(chosen: list[Entry]) -> None:
    from datetime import datetime

    from rich.table import Table

    from bench.cache import store

    table = Table(title=f"{store.root()}: {len(chosen)} entries, {_total(chosen)}", title_justify="left")
    for column in ("kind", "entries", "size", "last used"):
        table.add_column(column, justify="left" if column == "kind" else "right")
    for kind in sorted({entry.kind for entry in chosen}):
        its = [entry for entry in chosen if entry.kind == kind]
        last = datetime.fromtimestamp(max(entry.used for entry in its))
        table.add_row(kind, str(len(its)), _total(its), f"{last:%Y-%m-%d %H:%M}")
    print_rich(table)


def _verify(chosen: list[Entry]) -> int:
    from bench.core.progress import Progress

    faults = []
    with Progress("verifying", len(chosen)) as progress:
        for entry in chosen:
            fault = entry.fault()
            if fault is not None:
                faults.append(fault)
            progress.advance(note=entry.kind)
    for fault in faults:
        print(fault)
    told = "bench cache prune --damaged removes what is" if faults else "all as written"
    print(f"{len(chosen)} entries, {_total(chosen)}: {len(faults)} damaged; {told}")
    return FAILED if faults else DONE


def _prune(args: argparse.Namespace, chosen: list[Entry]) -> int:
    if not args.damaged and all(value is None for value in (args.kind, args.older_than, args.larger_than)):
        raise UserError("say what to remove: --kind, --older-than, --larger-than or --damaged (--older-than 0 is everything)")
    for entry in chosen:
        entry.remove()
    print(f"removed {len(chosen)} entries and freed {_total(chosen)}")
    return DONE


def _total(chosen: list[Entry]) -> str:
    return told_size(sum(entry.size for entry in chosen))
