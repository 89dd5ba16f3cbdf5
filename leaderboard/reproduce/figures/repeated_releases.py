"""Repeated releases of the same features (in no paper): the chance that the true word is told, beside the bound that T ε sets."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from leaderboard import multi_release
from leaderboard.reproduce import scale
from leaderboard.reproduce.drawing import Drawing, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS, SUBSET, EPSILONS = 256_000, 2, (10, 12)  # the paper's operating point for localization, and the next
RELEASES = 8


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    factor = scene.setting.profile.scale
    for epsilon in EPSILONS:
        curve = multi_release.rows(scale.epsilon(epsilon, factor), scale.words(WORDS, factor), SUBSET, RELEASES)
        yield f"epsilon{epsilon}", multi_release.draw(curve)


DRAWING = Drawing(name="repeated-releases", draw=drawn)
