"""Repeated releases of the same features (not in the paper): the probability of finding the true word, and the bound of T ε."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from leaderboard import multi_release
from leaderboard.reproduce import scale
from leaderboard.reproduce.drawing import Drawing, FigureData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS, SUBSET, EPSILONS = 256_000, 2, (10, 12)  # the paper's operating point for localization, and the next ε
RELEASES = 8


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    factor = data.setting.profile.scale
    for epsilon in EPSILONS:
        curve = multi_release.build_rows(scale.epsilon(epsilon, factor), scale.words(WORDS, factor), SUBSET, RELEASES)
        yield f"epsilon{epsilon}", multi_release.draw(curve)


DRAWING = Drawing(name="repeated-releases", draw=draw_figures)
