"""The views of a photograph that dictionaries are made from and networks are trained on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.datasets.photographs import Source, decode, square
from bench.errors import UnitError, UserError
from bench.plugin import Extractor
from bench.progress import Progress
from bench.types import Bytes, Features

SIDES = (256, 320)  # pixels


@dataclass(frozen=True, eq=False)
class PhotographView:
    """A photograph at one size, as it is or mirrored."""

    photograph: str  # the photograph's content hash
    pixels: Bytes  # (S, S, 3)
    features: Features


def views(source: Source, extractor: Extractor) -> Iterator[PhotographView]:
    """The centred square at 256 and at 320 pixels, as it is and mirrored, each with its own features.

    Raises
    ------
    UnitError
        if the photograph cannot be read or has no keypoint.
    """
    image, _ = decode(source.path)
    photograph = source.content_hash()
    for side in SIDES:
        pixels = square(image, side)
        for seen in (pixels, np.ascontiguousarray(pixels[:, ::-1])):
            yield PhotographView(photograph, seen, extractor.extract(seen, source.path))


def collect(sources: list[Source], extractor: Extractor) -> list[PhotographView]:
    """All views of all photographs; a photograph that cannot be read is named on stderr and left out.

    Raises
    ------
    UserError
        if no photograph is left.
    """
    collected: list[PhotographView] = []
    with Progress("features", len(sources)) as progress:
        for source in sources:
            try:
                collected += list(views(source, extractor))
            except UnitError as error:
                progress.say(f"left out: {error}")
            progress.advance()
    if not collected:
        raise UserError("none of the photographs could be used")
    return collected
