"""Definition of a figure: rows to run, and a function that draws their records."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from bench.core.errors import SampleError
from bench.images import samples
from bench.runner.directory import reconstruction_path
from bench.types import Bytes
from leaderboard.figures import Panel, lay_out
from leaderboard.provenance import CHUNK
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.run import EvaluationSet, RunResult, select_records
from leaderboard.reproduce.study import Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Metadata without dates and versions: the same run writes the same files.
FORMATS = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None}}

SSIM = {"SSIM": "ssim"}


@dataclass(frozen=True, kw_only=True, eq=False)
class FigureData:
    """The input of a figure."""

    setting: Setting
    evaluation_set: EvaluationSet
    result: RunResult
    out: Path

    def load_originals(self) -> Iterator[tuple[str, Bytes]]:
        """Yield the name and the pixels of each readable sample."""
        for sample in self.evaluation_set.samples:
            with contextlib.suppress(SampleError):
                yield sample.name, samples.read_pixels(sample.images[0])[0]

    def build_panel(self, row: str, sample: str, title: str = "", metrics: Mapping[str, str] = SSIM, digits: int = 3) -> Panel:
        """Return a panel with the reconstruction of a sample in a row. `metrics` (label -> metric) are in the caption."""
        for record in select_records(self.result, row):
            if record["status"] == "n/a":
                return Panel(None, title, "n/a")
            if record["sample"] == sample:
                path = reconstruction_path(self.out, record)
                scores = {label: record["metrics"].get(metric) for label, metric in metrics.items()}
                caption = ", ".join(f"{label} {score:.{digits}f}" for label, score in scores.items() if score is not None)
                return Panel(np.asarray(Image.open(path)) if path.is_file() else None, title, caption or record["status"])
        return Panel(None, title, "not run")


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A figure, or several of a kind. `name` is the prefix of its file names."""

    name: str
    draw: Callable[[FigureData], Iterator[tuple[str, Figure]]]  # yields suffixes of the name, and figures
    build_rows: Callable[[Setting], tuple[Row, ...]] = field(default=lambda setting: ())
    uses_queries: bool = False  # whether it shows queries of a dataset; the figure is then a target of its own


def save(figure: Figure, path: Path, provenance: str) -> list[Path]:
    """Write the figure in all formats and return their paths. The PNG holds `provenance` as a text chunk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lay_out(figure)
    files = [path.with_name(f"{path.name}.{suffix}") for suffix in FORMATS]
    for file, metadata in zip(files, FORMATS.values(), strict=True):
        figure.savefig(file, metadata=metadata | ({CHUNK: provenance} if file.suffix == ".png" else {}))
    return files
