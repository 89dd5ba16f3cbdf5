"""A part of a walk through the gallery's courtyard, with small distances between views, for structure from motion.

The queries are consecutive views of the second lap, which looks across the courtyard, without people. The references, which serve
the dictionary, are views of both laps outside that part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bench.api import Dataset
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.images.scene import Scene


@dataclass(frozen=True, kw_only=True)
class Walk(Dataset):
    """Consecutive views of a walk through a synthetic courtyard, rendered on demand; poses are exact and in metres."""

    seed: int = 0
    views: int = 25  # number of queries
    others: int = 150  # number of references, views of the courtyard outside that part
    start: float = 0.3  # of that part, as a fraction of the lap
    steps: int = 340  # number of views of a lap
    width: int = 640  # pixels
    height: int = 480
    detail: float = 1.0  # of textures and light; 1 is about a texel a pixel from 1.5 m away

    def __post_init__(self) -> None:
        if self.views < 2 or self.others < 1:
            raise UserError("walk: at least two views, and one other")
        if not 0 <= self.start <= 1 or self.views + self.others > self.steps:
            raise UserError("walk: start is from 0 to 1, and a lap has at least as many steps as there are views and others")

    def scene(self) -> Scene:
        gallery = Gallery(
            seed=self.seed,
            views=2 * self.steps,
            queries=0,
            rooms=1,
            people=0.0,
            width=self.width,
            height=self.height,
            detail=self.detail,
        )
        images = gallery.scene().references  # the first lap, then the second
        first = self.steps + round(self.start * (self.steps - self.views))
        stretch = range(first, first + self.views)
        rest = [index for index in range(len(images)) if index not in stretch]
        references = [rest[position] for position in np.linspace(0, len(rest) - 1, self.others).round().astype(int)]
        return Scene(
            name="walk",
            references=tuple(images[index] for index in references),
            queries=tuple(replace(images[index]) for index in stretch),
        )


PLUGIN = Walk
