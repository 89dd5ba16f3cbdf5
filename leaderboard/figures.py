"""Records made into pictures: each photograph beside what every attack made of its releases."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from bench.runner.records import Record
from bench.types import Bytes
from leaderboard.tables import labels, spaced

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 6  # panels in a row, the original included
SIDE = 2.6  # inches a panel
LINE = 0.2  # inches a line of a title
WRAP = 34  # characters of a label's line


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture with its title, and a line beneath."""

    pixels: Bytes | None  # (H, W, 3), or None where there is none
    title: str
    beneath: str


def draw(panels: Sequence[Panel], heading: str, columns: int = COLUMNS) -> Figure:
    """Lay panels side by side, at most `columns` in a row."""
    from matplotlib.figure import Figure

    columns = min(columns, len(panels))
    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    height = 0.3 + sum(SIDE + 0.3 + LINE * max(_lines(panel) for panel in row) for row in rows)
    figure = Figure(figsize=(columns * SIDE, height), layout="constrained", dpi=120)
    figure.suptitle(drawable(heading), fontsize=9)
    for axes, panel in zip(figure.subplots(len(rows), columns, squeeze=False).flat, panels, strict=False):
        axes.set_title(_wrapped(drawable(panel.title)), fontsize=8)
        axes.set_xlabel(drawable(panel.beneath), fontsize=8)
        if panel.pixels is not None:
            axes.imshow(panel.pixels)
    for axes in figure.axes:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    return figure


def panels(original: Bytes, records: Sequence[Record], pictures: Sequence[Path]) -> list[Panel]:
    """The panels of one photograph: the original, then one for each record, with the picture kept of it."""
    names = labels([(record["defense"], record["attack"]) for record in records])
    found = [Panel(original, "original", "")]
    for record, (defense, attack), picture in zip(records, names, pictures, strict=True):
        pixels = np.asarray(Image.open(picture)) if picture.is_file() else None
        found.append(Panel(pixels, f"{defense}\n{attack}", _beneath(record)))
    return found


def _beneath(record: Record) -> str:
    if record["status"] == "failed":
        return "failed: " + textwrap.shorten(record["reason"], 2 * WRAP)
    score = record["metrics"].get("ssim")
    return "no image" if score is None else f"SSIM {score:.3f}"


def _lines(panel: Panel) -> int:
    return _wrapped(panel.title).count("\n") + 1 if panel.title else 0


def _wrapped(title: str) -> str:
    """Lines that break between fields."""
    return "\n".join(part for line in spaced(title).split("\n") for part in textwrap.wrap(line, WRAP, break_on_hyphens=False))


def drawable(text: str) -> str:
    """Text that is drawn as it is: matplotlib reads dollar signs as mathematics, and has no glyph for half a character."""
    return text.replace("$", r"\$").encode(errors="replace").decode()
