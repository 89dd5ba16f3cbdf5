"""What each attack paints from subspaces: rows photographs, columns attacks, a figure for each dimension."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from leaderboard.figures import Panel, draw
from leaderboard.reproduce.drawing import Drawing, Scene
from leaderboard.reproduce.tables import table1

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLES = {"database": "database", "clustering": "clustering", "dia": "DIA", "nearest": "nearest"}  # strongest first


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    for dim in table1.DIMS:
        panels = []
        for number, (name, original) in enumerate(scene.originals()):
            shown = [
                Panel(original, "original", ""),
                scene.panel("raw", name, "raw descriptors"),
                *(scene.panel(table1.name(attack, dim), name, title) for attack, title in TITLES.items()),
            ]
            panels += shown if number == 0 else [Panel(panel.pixels, "", panel.beneath) for panel in shown]
        yield f"dim{dim}", draw(panels, f"What attacks recover from affine subspaces of dimension {dim}", columns=len(TITLES) + 2)


DRAWING = Drawing(name="attacks", draw=drawn, rows=table1.rows)
