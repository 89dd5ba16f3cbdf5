"""Shared by the tools that write pages in docs/results/: a cache of results, values and intervals as text, and provenance.

A page or picture in docs/ belongs to the command in its provenance, where placeholders stand for local folders. A run with other
options, such as a short test, writes to work/results/ instead, and prints the path. To replace the page, move the file, or remove
the page before the run. Any command writes a missing page.
"""

from __future__ import annotations

import itertools
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.cache import provenance, store
from bench.core import environment
from bench.formats.tensor_file import Arrays
from bench.runner.records import Record
from leaderboard.intervals import Interval
from leaderboard.provenance import CHUNK, format_provenance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
OTHER_RESULTS = ROOT / "work" / "results"  # pages and pictures of other commands
SMALL_GALLERY = "gallery:views=40,queries=12,rooms=2"  # a dataset for localization
RECALLS = {"recall_0.25m_2deg": "0.25 m, 2°", "recall_0.5m_5deg": "0.5 m, 5°", "recall_5m_10deg": "5 m, 10°"}
PLACEHOLDERS = {
    "--data": "DATA",
    "--images": "PHOTOGRAPHS",
    "--network": "NETWORK",
    "--scene": "fox/",
    "--training": "TRAINING",
    "--weights": "W.safetensors",
    "--work": "WORK",
}  # option -> text for its value, a local folder


def cache_arrays(tool: str, inputs: Any, compute: Callable[[], Arrays]) -> Arrays:
    """Return arrays from the cache, or from `compute`, so that an interrupted tool resumes.

    Parameters
    ----------
    tool : module of the tool; its source, and that of all that it imports from our packages, is part of the key
    inputs : JSON: everything else that the arrays depend on
    """
    key = {"inputs": inputs, "source": provenance.hash_modules(tool), "environment": environment.describe_platform()}
    return store.fetch(tool.replace("_", "-"), key, lambda: (compute(), {}))[0]


def format_interval(value: Interval, digits: int, sign: str = "") -> str:
    """Return the mean and the ends of an interval. `sign` "+" shows the sign of positive numbers."""
    return f"{value.mean:{sign}.{digits}f} [{value.low:{sign}.{digits}f}, {value.high:{sign}.{digits}f}]"


def list_values(records: Sequence[Record], metric: str) -> np.ndarray:
    """List the values of a metric. -> (samples,), without samples that have none"""
    return np.array([value for record in records if (value := record["metrics"].get(metric)) is not None])


def write_page(name: str, text: str, configurations: Iterable[Mapping[str, Any]]) -> None:
    """Write a page of docs/results/ that ends with the command of this process and the files that `configurations` refer to."""
    section = format_provenance(format_command(sys.argv), configurations)
    choose_path(RESULTS / name).write_text(f"{text.rstrip()}\n\n{section}", encoding="utf-8")


def save_figure(figure: Figure, path: Path, configurations: Iterable[Mapping[str, Any]]) -> None:
    """Write a picture that holds the command of this process and the files that `configurations` refer to."""
    metadata = {CHUNK: format_provenance(format_command(sys.argv), configurations)}
    figure.savefig(choose_path(path), dpi=110, metadata=metadata)


def choose_path(path: Path) -> Path:
    """Return the path of a page or picture, or one in `OTHER_RESULTS` if it belongs to another command than this process."""
    if not path.exists() or f"\n{format_command(sys.argv)}\n".encode() in path.read_bytes():
        return path
    OTHER_RESULTS.mkdir(parents=True, exist_ok=True)
    other = OTHER_RESULTS / path.name
    print(f"Written to {other}. {path} has results of a command with other options; to replace it, move the new file there.")
    return other


def format_command(argv: list[str]) -> str:
    """Return the command line of a tool, with placeholders for local folders.

    >>> format_command(["tools/tune_attacks.py", "--data", "/home/me/photographs"])
    'python tools/tune_attacks.py --data DATA'
    """
    words = [PLACEHOLDERS.get(before, word) for before, word in itertools.pairwise(argv)]
    return shlex.join(["python", f"tools/{Path(argv[0]).name}", *words])
