"""`bench cache`: list, verify or prune the cache."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from bench.cli.terminal import DONE, FAILED, format_size, parse_number, parse_size, print_rich
from bench.core.errors import UserError, unknown_name

if TYPE_CHECKING:
    from bench.cache.store import Entry

SUMMARY = "list, verify or prune the cache: bench cache list"
EPILOG = """The cache is a folder: the value of the environment variable FEATURE_PRIVACY_CACHE, or else the platform's folder
for caches (on Linux ~/.cache/feature-privacy-bench). A removed entry is computed again when it is needed.

examples:
  bench cache list
  bench cache verify
  bench cache prune --older-than 30 --kind recovered
  bench cache prune --damaged
"""
REQUIRED = ()
ACTIONS = ("list", "verify", "prune")
DAY = 24 * 3600.0


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "what", nargs="?", metavar="list|verify|prune", help="list entries, check all checksums, or remove entries"
    )
    parser.add_argument("--kind", metavar="KIND", help="only entries of this kind, such as features")
    parser.add_argument("--older-than", type=parse_number, metavar="DAYS", help="only entries that were not used for DAYS days")
    parser.add_argument("--larger-than", type=parse_size, metavar="SIZE", help="only entries larger than SIZE, such as 20MB")
    parser.add_argument("--damaged", action="store_true", help="only damaged or unfinished entries")


def execute(args: argparse.Namespace) -> int:
    if args.what not in ACTIONS:
        raise (
            UserError(f"give an action: bench cache {'|'.join(ACTIONS)}")
            if args.what is None
            else unknown_name("command", f"cache {args.what}", [f"cache {action}" for action in ACTIONS])
        )
    entries = _select(args)
    if args.what == "list":
        _list(entries)
        return DONE
    if args.what == "verify":
        return _verify(entries)
    return _prune(args, entries)


def _select(args: argparse.Namespace) -> list[Entry]:
    """Return the entries that the options select."""
    import time

    from bench.cache import store

    entries = list(store.list_entries())
    kinds = {entry.kind for entry in entries}
    if args.kind is not None and args.kind not in kinds:
        raise unknown_name("kind", args.kind, kinds)
    now = time.time()
    return [
        entry
        for entry in entries
        if args.kind in (None, entry.kind)
        and (args.older_than is None or now - entry.used > args.older_than * DAY)
        and (args.larger_than is None or entry.size > args.larger_than)
        and (not args.damaged or entry.find_fault() is not None)
    ]


def _list(entries: list[Entry]) -> None:
    from datetime import datetime

    from bench.cache import store
    from bench.core.table import build_table

    rows = []
    for kind in sorted({entry.kind for entry in entries}):
        of_kind = [entry for entry in entries if entry.kind == kind]
        last = datetime.fromtimestamp(max(entry.used for entry in of_kind))
        rows.append((kind, str(len(of_kind)), _format_total(of_kind), f"{last:%Y-%m-%d %H:%M}"))
    heading = f"{store.cache_folder()}: {len(entries)} entries, {_format_total(entries)}"
    print_rich(build_table(("kind", "entries", "size", "last used"), rows, text=("kind",), heading=heading))


def _verify(entries: list[Entry]) -> int:
    from bench.core.progress import Progress

    faults = []
    with Progress("verifying", len(entries)) as progress:
        for entry in entries:
            fault = entry.find_fault()
            if fault is not None:
                faults.append(fault)
            progress.advance(note=entry.kind)
    for fault in faults:
        print(fault)
    advice = "remove them with bench cache prune --damaged" if faults else "all checksums are right"
    print(f"{len(entries)} entries, {_format_total(entries)}: {len(faults)} damaged; {advice}")
    return FAILED if faults else DONE


def _prune(args: argparse.Namespace, entries: list[Entry]) -> int:
    if not args.damaged and all(value is None for value in (args.kind, args.older_than, args.larger_than)):
        raise UserError("select the entries: --kind, --older-than, --larger-than or --damaged (--older-than 0 removes all)")
    for entry in entries:
        entry.remove()
    print(f"removed {len(entries)} entries and freed {_format_total(entries)}")
    return DONE


def _format_total(entries: list[Entry]) -> str:
    return format_size(sum(entry.size for entry in entries))
