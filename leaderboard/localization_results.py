"""What localization leaves for other programs: poses for Aachen's evaluation server, and what was retrieved, as hloc's pairs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pycolmap

from bench.core.errors import UserError
from bench.datasets import aachen
from bench.formats import lists, pairs
from bench.runner.records import Record
from leaderboard import tables

ESTIMATES = "estimates"


def write(records: Iterable[Record], out: Path) -> Iterator[str]:
    """Write into `out`, from records alone, and tell of each file in a line.

    For each defense on Aachen `Aachen_eval_[method].txt`, without the queries that failed or were not localized, which are
    counted; and `pairs.txt`, or `pairs-[method].txt` for each defense where they differ.

    Raises
    ------
    UserError
        if two queries of Aachen have one name, folders aside.
    OSError
        if a file cannot be written.
    """
    cells: dict[str, list[Record]] = {}
    for record in records:
        if record["task"] == "localization" and record["status"] != "n/a":
            cells.setdefault(record["experiment_id"], []).append(record)
    methods = _name_methods(list(cells.values()))
    retrieved = {
        method: {record["sample"]: record[ESTIMATES]["retrieved"] for record in cell if ESTIMATES in record}
        for method, cell in zip(methods, cells.values(), strict=True)
    }
    if retrieved and len({str(each) for each in retrieved.values()}) == 1:
        retrieved = {"": next(iter(retrieved.values()))}
    for method, listed in retrieved.items():
        path = out / (f"pairs-{method}.txt" if method else "pairs.txt")
        try:
            pairs.write(path, listed)
        except UserError as error:  # a name with a space: hloc's format has no place for it
            yield f"{path}: not written: {error}"
            continue
        yield f"{path}: what was retrieved for {len(listed)} queries"
    for method, cell in zip(methods, cells.values(), strict=True):
        if cell[0]["dataset"]["name"] == "aachen":
            poses = {record["sample"]: _read_pose(record) for record in cell}
            path, left_out = aachen.write_evaluation(out, method, poses)
            yield f"{path}: {len(poses) - left_out} poses; {left_out} queries that failed are left out"


def _name_methods(cells: list[list[Record]]) -> list[str]:
    """A name for each cell that a file can have, each once."""
    labels = tables.build_labels([(cell[0]["defense"], None) for cell in cells])
    names = [re.sub(r"[^\w.+-]+", "_", f"{label}-seed{cell[0]['seed']}") for (label, _), cell in zip(labels, cells, strict=True)]
    return [name if names.count(name) == 1 else f"{name}-{cell[0]['experiment_id']}" for name, cell in zip(names, cells, strict=True)]


def _read_pose(record: Record) -> pycolmap.Rigid3d | None:
    found = record.get(ESTIMATES, {}).get("pose")
    return None if found is None else lists.parse_pose([repr(value) for value in found], record["sample"])
