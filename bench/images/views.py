"""The views of a photograph that dictionaries are made from and networks are trained on."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import overload

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.core.progress import Progress
from bench.images.photographs import Source, decode, square
from bench.types import Bytes, Features

SIDES = (256, 320)  # pixels
MIRRORED = (False, True)


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
        for mirrored in MIRRORED:
            yield _view(pixels, mirrored, photograph, source, extractor)


def _view(pixels: Bytes, mirrored: bool, photograph: str, source: Source, extractor: Extractor) -> PhotographView:
    if mirrored:
        pixels = np.ascontiguousarray(pixels[:, ::-1])
    return PhotographView(photograph, pixels, extractor.extract(pixels, source.path))


class OnDemand(Sequence[PhotographView]):
    """The same views of more photographs than memory holds, in the same order, each made whenever it is asked for.

    Iterating leaves out those that cannot be made.
    """

    def __init__(self, sources: Sequence[Source], extractor: Extractor) -> None:
        self._extractor = extractor
        self._which = [(source, side, mirrored) for source in sources for side in SIDES for mirrored in MIRRORED]
        self._photograph = functools.cache(Source.content_hash)  # which reads the whole file

    @property
    def photographs(self) -> set[str]:
        """Content hashes, for which every photograph is read once."""
        return {self._photograph(source) for source, _, _ in self._which}

    def __len__(self) -> int:
        return len(self._which)

    @overload
    def __getitem__(self, place: int) -> PhotographView: ...
    @overload
    def __getitem__(self, place: slice) -> OnDemand: ...
    def __getitem__(self, place: int | slice) -> PhotographView | OnDemand:
        """One view, or some of them, still to be made.

        Raises
        ------
        UnitError
            if the photograph cannot be read or has no keypoint.
        """
        if isinstance(place, slice):
            some = OnDemand((), self._extractor)
            some._which, some._photograph = self._which[place], self._photograph
            return some
        source, side, mirrored = self._which[place]
        image, _ = decode(source.path)
        return _view(square(image, side), mirrored, self._photograph(source), source, self._extractor)

    def __iter__(self) -> Iterator[PhotographView]:
        for place in range(len(self)):
            with suppress(SampleError):
                yield self[place]


def photographs_of(some: Sequence[PhotographView]) -> set[str]:
    """The content hashes of their photographs."""
    return some.photographs if isinstance(some, OnDemand) else {view.photograph for view in some}


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
            except SampleError as error:
                progress.say(f"left out: {error}")
            progress.advance()
    if not collected:
        raise UserError("none of the photographs could be used")
    return collected
