"""Affine and LDP-Feat reconstructions at matched recall. Recall is measured by the localization task."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bench import registry
from leaderboard.reproduce.drawing import Drawing, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    yield from ()


def left_out() -> str | None:
    if "localization" not in registry.discover(registry.TASK):
        return "recall is measured by the localization task, and none is registered"
    return "settings of equal recall have not been looked up yet"


DRAWING = Drawing(name="matched-recall", draw=drawn, left_out=left_out)
