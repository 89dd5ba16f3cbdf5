"""Reconstructions by DIA from LDP-Feat, with one row per ε, one column per m and one figure per photograph."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from leaderboard.figures import Panel, draw
from leaderboard.reproduce import scale
from leaderboard.reproduce.drawing import Drawing, FigureData
from leaderboard.reproduce.tables import table4

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS = 256_000  # |K| in the paper
SUBSETS = (1, 2, 4)


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    factor = data.setting.profile.scale
    heading = f"DIA on LDP-Feat, |K| = {scale.words(WORDS, factor):,}"
    for name, original in data.load_originals():
        panels = []
        for number, epsilon in enumerate(table4.EPSILONS):
            panels.append(Panel(original, "original", "") if number == 0 else Panel(None, "", ""))
            ours = scale.epsilon(epsilon, factor)
            for subset in SUBSETS:
                title = f"ε = {ours:.2f}, m = {subset}" + ("" if factor == 1 else f" (paper's ε {epsilon})")
                panels.append(data.build_panel(table4.format_name(WORDS, epsilon, subset), name, title))
        yield name, draw(panels, f"{heading}; {name}", columns=1 + len(SUBSETS))


DRAWING = Drawing(name="epsilon-grid", draw=draw_figures, build_rows=table4.build_rows)
