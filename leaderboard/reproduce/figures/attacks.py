"""Reconstructions from subspaces, with one row per photograph, one column per attack and one figure per dimension."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from leaderboard.figures import Panel, draw
from leaderboard.reproduce.drawing import Drawing, FigureData
from leaderboard.reproduce.tables import table1

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLES = {"database": "database", "clustering": "clustering", "dia": "DIA", "nearest": "nearest"}  # strongest first


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    for dim in table1.DIMS:
        panels = []
        for number, (name, original) in enumerate(data.load_originals()):
            row = [
                Panel(original, "original", ""),
                data.build_panel("raw", name, "raw descriptors"),
                *(data.build_panel(table1.format_name(attack, dim), name, title) for attack, title in TITLES.items()),
            ]
            panels += row if number == 0 else [Panel(panel.pixels, "", panel.caption) for panel in row]
        yield f"dim{dim}", draw(panels, f"Reconstructions from affine subspaces of dimension {dim}", columns=len(TITLES) + 2)


DRAWING = Drawing(name="attacks", draw=draw_figures, build_rows=table1.build_rows)
