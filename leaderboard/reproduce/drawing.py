"""What a figure of the paper is to us: rows to run, and a function that draws what came out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from bench.datasets import photographs
from bench.datasets.photographs import Source
from bench.errors import UnitError
from bench.rundir import picture
from bench.types import Bytes
from leaderboard.figures import Panel
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.run import Judged, Ran, of
from leaderboard.reproduce.study import Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None}}  # so that a run gives the same files again


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """What a figure is drawn from."""

    setting: Setting
    judged: Judged
    ran: Ran
    out: Path

    def originals(self) -> Iterator[tuple[Source, Bytes]]:
        """The photographs that can be read, and their pixels."""
        for source in self.judged.chosen:
            with contextlib.suppress(UnitError):
                yield source, photographs.read(source.path).pixels

    def panel(self, row: str, source: Source, title: str = "") -> Panel:
        """The reconstruction of a photograph in a row of a table, with its SSIM beneath; or why there is none."""
        for record in of(self.ran, row):
            if record["status"] == "n/a":
                return Panel(None, title, "n/a")
            if record["unit"] == source.name:
                path = picture(self.out, record)
                score = record["metrics"].get("ssim")
                beneath = record["status"] if score is None else f"SSIM {score:.3f}"
                return Panel(np.asarray(Image.open(path)) if path.is_file() else None, title, beneath)
        return Panel(None, title, "not run")


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A figure, or several of a kind. `name` begins the names of its files."""

    name: str
    draw: Callable[[Scene], Iterator[tuple[str, Figure]]]  # yields what is added to the name, and the figure
    rows: Callable[[Setting], tuple[Row, ...]] = field(default=lambda setting: ())
    left_out: Callable[[], str | None] = field(default=lambda: None)  # why it cannot be drawn here, if it cannot


def save(figure: Figure, path: Path) -> list[Path]:
    """Write the figure in all formats and return their paths."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files = [path.with_name(f"{path.name}.{suffix}") for suffix in FORMATS]
    for file, metadata in zip(files, FORMATS.values(), strict=True):
        figure.savefig(file, metadata=metadata)
    return files
