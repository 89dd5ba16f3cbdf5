"""A part of a walk through the gallery: references, and queries between them. A process renders each image once."""

import functools
from dataclasses import dataclass, replace

from bench.datasets.gallery import Gallery, Rendered, Shot, render
from bench.images.scene import Mask, Pixels, Reference
from bench.types import Bytes

WALK = Gallery(views=150, rooms=1, width=320, height=240, detail=0.5)
STRETCH = range(84, 104)  # along one wall of the courtyard
QUERY = 4  # every fourth view is a query
WORDS = 300
REFERENCES = [index for index in range(len(STRETCH)) if index % QUERY != QUERY // 2]  # the other views


@functools.cache
def list_images() -> tuple[Reference, ...]:
    """Return the images of the stretch, references and queries."""
    images = WALK.scene().references
    return tuple(replace(images[number], pixels=InMemory(number=number)) for number in STRETCH)


def list_references() -> tuple[Reference, ...]:
    return tuple(list_images()[index] for index in REFERENCES)


def list_queries() -> tuple[Reference, ...]:
    return tuple(image for index, image in enumerate(list_images()) if index not in REFERENCES)


@functools.cache
def render_view(number: int) -> Shot:
    return render(WALK, "reference", number)


@dataclass(frozen=True, kw_only=True)
class InMemory(Pixels):
    """A view that stays in memory: several files of tests read it."""

    number: int

    def content_hash(self) -> str:
        return Rendered(gallery=WALK, kind="reference", index=self.number).content_hash()

    def read(self) -> Bytes:
        return render_view(self.number).pixels

    def foreground(self) -> Mask:
        return render_view(self.number).foreground
