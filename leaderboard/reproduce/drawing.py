"""What a figure of the paper is to us: rows to run, and a function that draws what came out."""

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
from leaderboard.figures import Panel
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.run import Judged, Ran, of
from leaderboard.reproduce.study import Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None}}  # so that a run gives the same files again


SSIM = {"SSIM": "ssim"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """What a figure is drawn from."""

    setting: Setting
    judged: Judged
    ran: Ran
    out: Path

    def originals(self) -> Iterator[tuple[str, Bytes]]:
        """The names of the units that can be read, and their pixels."""
        for unit in self.judged.units:
            with contextlib.suppress(SampleError):
                yield unit.name, samples.read_pixels(unit.images[0])[0]

    def panel(self, row: str, unit: str, title: str = "", shown: Mapping[str, str] = SSIM, digits: int = 3) -> Panel:
        """The picture made of a unit in a row of a table, with metrics beneath, by label; or why there is none."""
        for record in of(self.ran, row):
            if record["status"] == "n/a":
                return Panel(None, title, "n/a")
            if record["unit"] == unit:
                path = reconstruction_path(self.out, record)
                scores = {label: record["metrics"].get(metric) for label, metric in shown.items()}
                told = ", ".join(f"{label} {score:.{digits}f}" for label, score in scores.items() if score is not None)
                return Panel(np.asarray(Image.open(path)) if path.is_file() else None, title, told or record["status"])
        return Panel(None, title, "not run")


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A figure, or several of a kind. `name` begins the names of its files."""

    name: str
    draw: Callable[[Scene], Iterator[tuple[str, Figure]]]  # yields what is added to the name, and the figure
    rows: Callable[[Setting], tuple[Row, ...]] = field(default=lambda setting: ())
    place: bool = False  # whether it is about the queries of a place; such a figure is a command of its own


def save(figure: Figure, path: Path) -> list[Path]:
    """Write the figure in all formats and return their paths."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files = [path.with_name(f"{path.name}.{suffix}") for suffix in FORMATS]
    for file, metadata in zip(files, FORMATS.values(), strict=True):
        figure.savefig(file, metadata=metadata)
    return files
