"""Speed, as ratios of times within one run of pytest-benchmark, against ratios that were found good.

A time means little on another machine, and so does a ratio of two machines' times. In each group one benchmark is the floor, such
as a bare product of matrices, and the others are divided by it. pytest-benchmark compares times with those of earlier runs
(`--benchmark-compare`), and knows no ratios within a run.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.errors import UserError
from leaderboard.regression import Finding, Verdict

TOLERANCE = 2.0  # times as much as the baseline: what a busy machine makes of it is less
FLOORS = ("bare_product[float32", "random words")  # what other benchmarks of a group are divided by

Ratios = Mapping[str, float]


def read(path: Path) -> Ratios:
    """The committed ratios, by benchmark.

    Raises
    ------
    UserError
        if the file is missing, or holds something else.
    """
    found = _json(path)
    if not isinstance(found, dict) or not all(isinstance(value, (int, float)) for value in found.values()):
        raise UserError(f"{path}: expected ratios, a number for each benchmark's name")
    return found


def ratios(path: Path) -> Ratios:
    """Shortest time of each benchmark, divided by that of its group's floor, from what `--benchmark-json` wrote.

    Raises
    ------
    UserError
        if the file is missing, or holds something else.
    """
    found = _json(path)
    if not isinstance(found, dict) or "benchmarks" not in found:
        raise UserError(f"{path}: not what pytest --benchmark-json wrote")
    groups: dict[str, dict[str, float]] = {}
    for one in found["benchmarks"]:
        groups.setdefault(str(one["group"]), {})[one["name"]] = one["stats"]["min"]
    return {
        f"{group}: {name}": time / times[floor]
        for group, times in groups.items()
        if (floor := _floor(times)) is not None
        for name, time in times.items()
        if name != floor
    }


def compare(baseline: Ratios, measured: Ratios) -> list[Finding]:
    """A finding for each benchmark of either side."""
    return [_finding(name, baseline.get(name), measured.get(name)) for name in sorted({*baseline, *measured})]


def _finding(name: str, before: float | None, after: float | None) -> Finding:
    where = {"defense": name, "attack": "its floor"}
    if before is None or after is None:
        return Finding(verdict="new" if before is None else "missing", **where)
    verdict: Verdict = "worse" if after > before * TOLERANCE else "better" if after < before / TOLERANCE else "same"
    allowed = before * (TOLERANCE - 1)
    return Finding(verdict=verdict, **where, metric="time", before=before, after=after, tolerance=allowed)


def _floor(times: Mapping[str, float]) -> str | None:
    return next((name for floor in FLOORS for name in sorted(times) if floor in name), None)


def _json(path: Path) -> Any:
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"{path}: no JSON ({error})") from error
