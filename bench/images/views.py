"""Views of photographs, for the construction of dictionaries and the training of networks."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import overload

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.core.progress import Progress
from bench.images.photographs import Source, crop_square, decode
from bench.types import Bytes, Features

SIDES = (256, 320)  # pixels
MIRRORED = (False, True)
LIMIT = "max_keypoints"  # field of an extractor: the greatest number of keypoints, those of highest score


@dataclass(frozen=True, eq=False)
class PhotographView:
    """A photograph at one size, mirrored or not."""

    photograph: str  # the photograph's content hash
    pixels: Bytes  # (S, S, 3)
    features: Features


def extract_views(source: Source, extractor: Extractor) -> Iterator[PhotographView]:
    """Yield the centred square at 256 and 320 pixels, each unmirrored and mirrored, with its own features.

    Raises
    ------
    SampleError
        if the photograph cannot be read or has no keypoint.
    """
    image, _ = decode(source)
    photograph = source.content_hash()
    for side in SIDES:
        pixels = crop_square(image, side)
        for mirrored in MIRRORED:
            yield _extract_view(pixels, mirrored, photograph, source, extractor)


def _extract_view(pixels: Bytes, mirrored: bool, photograph: str, source: Source, extractor: Extractor) -> PhotographView:
    if mirrored:  # features that are stored with the file are those of the unmirrored photograph
        mirror = np.ascontiguousarray(pixels[:, ::-1])
        return PhotographView(photograph, mirror, extractor.extract(mirror, None))
    return PhotographView(photograph, pixels, extractor.extract(pixels, source))


@dataclass(frozen=True, kw_only=True)
class RandomLimit(Extractor):
    """Extracts a number of keypoints that depends on the image: log-uniform within `limits`, those of highest score.

    Views of a training then have as few or as many keypoints as the limits of the extractors that its network is to serve.
    """

    extractor: Extractor  # with a field `max_keypoints`
    limits: tuple[int, int]

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        rng = np.random.default_rng(list(hashlib.sha256(image.tobytes()).digest()))
        count = round(math.exp(rng.uniform(*np.log(self.limits))))
        limited: Extractor = dataclasses.replace(self.extractor, **{LIMIT: count})  # type: ignore[type-var]
        return limited.extract(image, source)


class LazyViews(Sequence[PhotographView]):
    """Sequence of the views of `extract_views` for any number of photographs, extracted at each access.

    Iteration skips views that cannot be extracted.
    """

    def __init__(self, sources: Sequence[Source], extractor: Extractor) -> None:
        self._extractor = extractor
        self._keys = [(source, side, mirrored) for source in sources for side in SIDES for mirrored in MIRRORED]
        self._hash = functools.cache(Source.content_hash)  # reads the whole file

    @property
    def photographs(self) -> set[str]:
        """Content hashes of the photographs. Each photograph is read once."""
        return {self._hash(source) for source, _, _ in self._keys}

    def __len__(self) -> int:
        return len(self._keys)

    @overload
    def __getitem__(self, index: int) -> PhotographView: ...
    @overload
    def __getitem__(self, index: slice) -> LazyViews: ...
    def __getitem__(self, index: int | slice) -> PhotographView | LazyViews:
        """Return one view, or a slice that is extracted on demand.

        Raises
        ------
        SampleError
            if the photograph cannot be read or has no keypoint.
        """
        if isinstance(index, slice):
            subset = LazyViews((), self._extractor)
            subset._keys, subset._hash = self._keys[index], self._hash
            return subset
        source, side, mirrored = self._keys[index]
        image, _ = decode(source)
        return _extract_view(crop_square(image, side), mirrored, self._hash(source), source, self._extractor)

    def __iter__(self) -> Iterator[PhotographView]:
        for index in range(len(self)):
            with suppress(SampleError):
                yield self[index]


def collect_photograph_hashes(views: Sequence[PhotographView]) -> set[str]:
    """Return the content hashes of the photographs of `views`."""
    return views.photographs if isinstance(views, LazyViews) else {view.photograph for view in views}


def collect_views(sources: list[Source], extractor: Extractor) -> list[PhotographView]:
    """Return all views of all photographs. An unreadable photograph is reported on stderr and skipped.

    Raises
    ------
    UserError
        if no photograph can be used.
    """
    views: list[PhotographView] = []
    with Progress("features", len(sources)) as progress:
        for source in sources:
            try:
                views += list(extract_views(source, extractor))
            except SampleError as error:
                progress.log(f"skipped: {error}")
            progress.advance()
    if not views:
        raise UserError("none of the photographs could be used; see the messages above")
    return views
