"""Writes localization results for other programs: poses for Aachen's evaluation server, and retrieved images as hloc's pairs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bench.core import paths
from bench.core.errors import UserError
from bench.datasets import aachen
from bench.formats import lists, pairs
from bench.runner.records import Record
from bench.tasks.localization import THRESHOLDS
from leaderboard import tables

if TYPE_CHECKING:
    import pycolmap

ESTIMATES = "estimates"
RECALL = f"recall_{max(THRESHOLDS, key=THRESHOLDS.__getitem__)}"  # by the loosest threshold


def write(records: Iterable[Record], out: Path) -> Iterator[str]:
    """Write the files into `out`, from records alone, and yield a line of text for each file.

    Each defense on Aachen has a file `Aachen_eval_[method].txt`. It excludes the queries that failed, were rejected for their
    intrinsics, or were not localized, and the line states their number. `pairs.txt` has the retrieved images. If they differ
    between defenses, each defense has a file `pairs-[method].txt`.

    Raises
    ------
    UserError
        if two queries of Aachen have the same name apart from their folders.
    OSError
        if a file cannot be written.
    """
    experiments: dict[str, list[Record]] = {}
    for record in records:
        if record["task"] == "localization" and record["status"] != "n/a":
            experiments.setdefault(record["experiment_id"], []).append(record)
    methods = _name_methods(list(experiments.values()))
    retrieved = {
        method: {record["sample"]: record[ESTIMATES]["retrieved"] for record in experiment if ESTIMATES in record}
        for method, experiment in zip(methods, experiments.values(), strict=True)
    }
    if retrieved and len({str(each) for each in retrieved.values()}) == 1:
        retrieved = {"": next(iter(retrieved.values()))}
    for method, by_query in retrieved.items():
        path = paths.assign_path(out, f"pairs-{method}" if method else "pairs", ".txt")
        try:
            pairs.write(path, by_query)
        except UserError as error:  # a name with a space, which hloc's format does not allow
            yield f"{path}: not written: {error}"
            continue
        yield f"{path}: the images retrieved for {len(by_query)} queries"
    for method, experiment in zip(methods, experiments.values(), strict=True):
        if experiment[0]["dataset"]["name"] == "aachen":
            poses = {record["sample"]: _read_pose(record) for record in experiment}
            path, missing = aachen.write_evaluation(out, method, poses)
            yield f"{path}: {len(poses) - missing} poses; {missing} queries without a pose are left out"


def find_lost_baselines(records: Iterable[Record]) -> Iterator[str]:
    """Yield a line for each undefended experiment in which no query is localized.

    A query counts as localized if its pose is within the loosest threshold or, where the true pose is withheld, if it has a pose.
    """
    localized: dict[str, list[bool]] = {}
    for record in records:
        if record["task"] == "localization" and record["defense"]["name"] == "none" and record["status"] == "ok":
            recall = record["metrics"].get(RECALL, _read_pose(record) is not None)
            localized.setdefault(record["experiment_id"], []).append(bool(recall))
    for each in localized.values():
        if not any(each):
            yield (
                f"warning: without a defense, 0 of {len(each)} queries are localized, so this run says nothing about defenses; "
                "give a dataset with more references that see the queries"
            )


def _name_methods(experiments: list[list[Record]]) -> list[str]:
    """Return a distinct file name for each experiment."""
    first = [experiment[0] for experiment in experiments]
    labels = tables.build_labels([(record["defense"], None) for record in first])
    names = [re.sub(r"[^\w.+-]+", "_", f"{label}-seed{record['seed']}") for (label, _), record in zip(labels, first, strict=True)]
    return [
        name if names.count(name) == 1 else f"{name}-{record['experiment_id']}" for name, record in zip(names, first, strict=True)
    ]


def _read_pose(record: Record) -> pycolmap.Rigid3d | None:
    pose = record.get(ESTIMATES, {}).get("pose")
    return None if pose is None else lists.parse_pose([repr(value) for value in pose], record["sample"])
