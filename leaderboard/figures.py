"""Figures of a run: each photograph beside the reconstructions of every attack."""

from __future__ import annotations

import importlib.util
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
PIXELS = 312  # per panel of a picture
MARGIN = 5  # pixels
LINE_PIXELS = 17
FONT_SIZE = 13  # pixels


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
    height = 0.3 + sum(SIDE + 0.3 + LINE * max(len(_split_lines(panel.title)) for panel in row) for row in rows)
    figure = Figure(figsize=(columns * SIDE, height), layout="constrained", dpi=120)
    figure.suptitle(escape_text(heading), fontsize=9)
    for axes, panel in zip(figure.subplots(len(rows), columns, squeeze=False).flat, panels, strict=False):
        axes.set_title("\n".join(_split_lines(escape_text(panel.title))), fontsize=8)
        axes.set_xlabel(escape_text(panel.caption), fontsize=8)
        if panel.pixels is not None:
            axes.imshow(panel.pixels)
    for axes in figure.axes:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    return figure


def lay_out(figure: Figure) -> None:
    """Position the axes of a figure for all formats. `savefig` draws a figure with a layout engine twice in each format."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def draw_picture(panels: Sequence[Panel], heading: str, columns: int = COLUMNS) -> Image.Image:
    """Return a picture of the panels like `draw`, by Pillow: without the import of matplotlib, and five times as fast."""
    from PIL import ImageDraw, ImageFont, ImageOps

    columns = min(columns, len(panels))
    width = columns * PIXELS
    above = [_split_lines(panel.title) for panel in panels]
    below = [textwrap.wrap(_replace_surrogates(panel.caption), WRAP) for panel in panels]
    heads = textwrap.wrap(_replace_surrogates(heading), WRAP * columns)
    rows = [range(start, min(start + columns, len(panels))) for start in range(0, len(panels), columns)]
    lines = [(max(len(above[index]) for index in row), max(len(below[index]) for index in row)) for row in rows]
    height = MARGIN + LINE_PIXELS * (len(heads) + sum(map(sum, lines))) + len(rows) * (PIXELS + MARGIN)
    picture = Image.new("RGB", (width, height), "white")
    drawing, font = ImageDraw.Draw(picture), ImageFont.truetype(str(_find_font()), FONT_SIZE)

    def write(texts: Sequence[str], centre: float, top: float) -> None:
        for number, text in enumerate(texts):
            drawing.text((centre, top + number * LINE_PIXELS), text, "black", font, anchor="ma")

    write(heads, width / 2, MARGIN)
    top = MARGIN + LINE_PIXELS * len(heads)
    for row, (most, least) in zip(rows, lines, strict=True):
        for column, index in enumerate(row):
            centre = (column + 0.5) * PIXELS
            write(above[index], centre, top + LINE_PIXELS * (most - len(above[index])))
            pixels = panels[index].pixels
            if pixels is not None:
                image = ImageOps.contain(Image.fromarray(pixels).convert("RGB"), (PIXELS - 2 * MARGIN, PIXELS - 2 * MARGIN))
                corner = round(centre - image.width / 2), top + LINE_PIXELS * most + (PIXELS - image.height) // 2
                picture.paste(image, corner)
            write(below[index], centre, top + LINE_PIXELS * most + PIXELS)
        top += LINE_PIXELS * (most + least) + PIXELS + MARGIN
    return picture


def _find_font() -> Path:
    """Return the path of matplotlib's font, without an import of matplotlib."""
    found = importlib.util.find_spec("matplotlib")
    assert found is not None
    assert found.submodule_search_locations is not None
    return Path(found.submodule_search_locations[0]) / "mpl-data" / "fonts" / "ttf" / "DejaVuSans.ttf"


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


def _split_lines(title: str) -> list[str]:
    """Return the lines of a title, with breaks between fields."""
    text = add_breaks(_replace_surrogates(title))
    return [part for line in text.split("\n") for part in textwrap.wrap(line, WRAP, break_on_hyphens=False)]


def escape_text(text: str) -> str:
    """Return text that matplotlib draws literally: dollar signs start no mathematics, and lone surrogates are replaced."""
    return _replace_surrogates(text.replace("$", r"\$"))


def _replace_surrogates(text: str) -> str:
    return text.encode(errors="replace").decode()
