"""Speed: ratios of times within one run of pytest-benchmark, compared with ratios of a reference run.

Times of two machines cannot be compared. So each group of benchmarks contains floors, such as a bare product of matrices or the
search of another library. The time of each other benchmark is divided by that of the fastest floor, which differs between
processors. pytest-benchmark itself compares times with those of earlier runs (`--benchmark-compare`), but no ratios within a run.

Ratios depend on the instructions that the processor has for the floors. So each instruction set has its own reference. The ratios
of a set without one are new, and not worse.
"""

from __future__ import annotations

import functools
import json
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.core.device import pick_dtype
from bench.core.errors import UserError
from leaderboard.regression import RegressionResult, Verdict

TOLERANCE = 2.0  # factor; a busy machine changes ratios by less
FLOORS = ("bare_product", "random words", "faiss")  # parts of the names of the benchmarks that are floors
INSTRUCTION_SET = "instruction_set"  # key of the machine's description in files of pytest-benchmark

Ratios = Mapping[str, float]


def name_instruction_set() -> str:
    """Return the instruction set of this machine's matrix products, such as "x86_64 AVX512 bf16"."""
    import torch

    parts = (
        platform.machine(),
        torch.backends.cpu.get_cpu_capability(),
        "bf16" * (pick_dtype(torch.device("cpu")) != torch.float32),
    )
    return " ".join(filter(None, parts))


def load_ratios(path: Path) -> Mapping[str, Ratios]:
    """Return the committed ratios: instruction set -> benchmark -> ratio.

    Raises
    ------
    UserError
        if the file is missing or has other content.
    """
    content = _load_json(path)
    if not isinstance(content, dict) or not all(map(_are_ratios, content.values())):
        raise UserError(f"{path}: expected, for the name of each instruction set, an object with a number for each benchmark")
    return content


def _are_ratios(content: Any) -> bool:
    return isinstance(content, dict) and all(isinstance(value, (int, float)) for value in content.values())


def read_instruction_set(path: Path) -> str:
    """Return the instruction set of a `--benchmark-json` file, or "unknown".

    Raises
    ------
    UserError
        if the file is missing or not valid JSON.
    """
    content = _load_json(path)
    machine = content.get("machine_info") if isinstance(content, dict) else None
    return str(machine.get(INSTRUCTION_SET, "unknown")) if isinstance(machine, dict) else "unknown"


def compute_ratios(path: Path) -> Ratios:
    """Return the ratios of a `--benchmark-json` file: shortest time of a benchmark over that of the fastest floor of its group.

    Raises
    ------
    UserError
        if the file is missing or has other content.
    """
    content = _load_json(path)
    if not isinstance(content, dict) or "benchmarks" not in content:
        raise UserError(f"{path}: not a file of pytest --benchmark-json")
    groups: dict[str, dict[str, float]] = {}
    for benchmark in content["benchmarks"]:
        groups.setdefault(str(benchmark["group"]), {})[benchmark["name"]] = benchmark["stats"]["min"]
    ratios: dict[str, float] = {}
    for group, times in groups.items():
        floors = [time for name, time in times.items() if _is_floor(name)]
        if floors:
            ratios |= {f"{group}: {name}": time / min(floors) for name, time in times.items() if not _is_floor(name)}
    return ratios


def compare(baseline: Ratios, measured: Ratios) -> list[RegressionResult]:
    """Compare the ratios of all benchmarks of both sides."""
    return [_compare_ratio(name, baseline.get(name), measured.get(name)) for name in sorted({*baseline, *measured})]


def _compare_ratio(name: str, before: float | None, after: float | None) -> RegressionResult:
    build = functools.partial(RegressionResult, defense=name, attack="its floor")
    if before is None or after is None:
        note = "" if after is None else f"{after:.2f} times its floor"
        return build(verdict="new" if before is None else "missing", note=note)
    verdict: Verdict = "worse" if after > before * TOLERANCE else "better" if after < before / TOLERANCE else "same"
    allowed = before * (TOLERANCE - 1)
    return build(verdict=verdict, metric="time", before=before, after=after, tolerance=allowed)


def _is_floor(name: str) -> bool:
    return any(part in name for part in FLOORS)


def _load_json(path: Path) -> Any:
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({error})") from error
