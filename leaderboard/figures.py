"""Figures of a run: each photograph beside the reconstructions of every attack."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from bench.runner.records import Record
from bench.types import Bytes
from leaderboard.tables import add_breaks, build_labels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 6  # panels per row, including the original
SIDE = 2.6  # inches per panel
LINE = 0.2  # inches per line of a title
WRAP = 34  # characters per line of a title


@dataclass(frozen=True, eq=False)
class Panel:
    """One image with a title above it and a caption below."""

    pixels: Bytes | None  # (H, W, 3), or None if there is no image
    title: str
    caption: str


def draw(panels: Sequence[Panel], heading: str, columns: int = COLUMNS) -> Figure:
    """Return a figure of the panels, at most `columns` in a row."""
    from matplotlib.figure import Figure

    columns = min(columns, len(panels))
    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    height = 0.3 + sum(SIDE + 0.3 + LINE * max(_count_lines(panel) for panel in row) for row in rows)
    figure = Figure(figsize=(columns * SIDE, height), layout="constrained", dpi=120)
    figure.suptitle(escape_text(heading), fontsize=9)
    for axes, panel in zip(figure.subplots(len(rows), columns, squeeze=False).flat, panels, strict=False):
        axes.set_title(_wrap(escape_text(panel.title)), fontsize=8)
        axes.set_xlabel(escape_text(panel.caption), fontsize=8)
        if panel.pixels is not None:
            axes.imshow(panel.pixels)
    for axes in figure.axes:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    return figure


def build_panels(original: Bytes, records: Sequence[Record], images: Sequence[Path]) -> list[Panel]:
    """Return the panels of one photograph: the original, then the reconstruction of each record."""
    names = build_labels([(record["defense"], record["attack"]) for record in records])
    panels = [Panel(original, "original", "")]
    for record, (defense, attack), image in zip(records, names, images, strict=True):
        pixels = np.asarray(Image.open(image)) if os.path.isfile(image) else None
        panels.append(Panel(pixels, f"{defense}\n{attack}", _caption(record)))
    return panels


def _caption(record: Record) -> str:
    if record["status"] == "failed":
        return "failed: " + textwrap.shorten(record["reason"], 2 * WRAP)
    score = record["metrics"].get("ssim")
    return "no image" if score is None else f"SSIM {score:.3f}"


def _count_lines(panel: Panel) -> int:
    return _wrap(panel.title).count("\n") + 1 if panel.title else 0


def _wrap(title: str) -> str:
    """Return the title with line breaks between fields."""
    return "\n".join(part for line in add_breaks(title).split("\n") for part in textwrap.wrap(line, WRAP, break_on_hyphens=False))


def escape_text(text: str) -> str:
    """Return text that matplotlib draws literally: dollar signs start no mathematics, and lone surrogates are replaced."""
    return text.replace("$", r"\$").encode(errors="replace").decode()
