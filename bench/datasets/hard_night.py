"""The gallery with a harder night: more noise, more blur, and viewpoints farther from the walks, for the queries by night alone.

References and queries by day are those of the gallery, so that map and dictionaries are the same. The defaults of noise and blur
are chosen by the recall of raw descriptors alone (`tools/tune_night.py`), on a gallery of another seed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from bench.api import Dataset
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.images.scene import Scene
from bench.rendering.rooms import ROOMS

BY_NIGHT = ("viewpoint", "blur", "noise")  # fields of `HardNight` that differ by night


@dataclass(frozen=True, kw_only=True)
class HardNight(Dataset):
    """A synthetic building whose queries by night are hard to localize, rendered on demand; poses are exact and in metres."""

    seed: int = 0
    views: int = 300  # reference images
    queries: int = 300
    night: float = 1 / 3  # fraction of the queries
    width: int = 640  # pixels
    height: int = 480
    rooms: int = len(ROOMS)  # rooms visited, the courtyard first
    detail: float = 1.0  # of textures and light; 1 is about a texel a pixel from 1.5 m away
    viewpoint: float = 1.0  # by night, distance of queries from the walks: 1 is about 0.7 m and 20 degrees
    blur: float = 4.0  # by night; 1 is about a pixel
    noise: float = 6.0  # by night; 1 is a good sensor's

    def __post_init__(self) -> None:
        try:
            self.by_day(), self.by_night()
        except UserError as error:
            raise UserError(str(error).replace("gallery:", "hard-night:")) from None

    def by_day(self) -> Gallery:
        """Return the gallery of the references and of the queries by day."""
        return Gallery(**select_shared(self))

    def by_night(self) -> Gallery:
        """Return the gallery of the queries by night."""
        return replace(self.by_day(), **{name: getattr(self, name) for name in BY_NIGHT})

    def scene(self) -> Scene:
        day = self.by_day().scene()
        pairs = zip(day.queries, self.by_night().scene().queries, strict=True)
        queries = tuple(hard if query.condition == "night" else query for query, hard in pairs)
        return replace(day, name="hard-night", queries=queries)


def select_shared(dataset: Gallery | HardNight) -> dict[str, Any]:
    """Return the values of the fields of `HardNight` that are equal by day and by night."""
    return {field.name: getattr(dataset, field.name) for field in fields(HardNight) if field.name not in BY_NIGHT}


PLUGIN = HardNight
