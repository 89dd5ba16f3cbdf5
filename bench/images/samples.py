"""What records are about, one each: a photograph, a pair of images, a query of a place, or a whole place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.core.errors import UserError
from bench.core.hashing import digest
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.scene import Mask, Pixels, Scene, SceneImage
from bench.types import Bytes

if TYPE_CHECKING:
    from bench.api import Dataset, Task

ImageSource = Source | Pixels
Images = Path | str | Sequence[Path | str | Source] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One thing that is judged. The runner extracts and protects each of its images."""

    name: str
    images: tuple[ImageSource, ...]
    condition: str | None = None  # such as "night"; results are told apart by it
    subject: Any = None  # what else its task must know of it

    def content_hash(self) -> str:
        """Of all of its images; of one that cannot be read, that it cannot."""
        hashes = [_content_hash(image) for image in self.images]
        return hashes[0] if len(hashes) == 1 else digest(hashes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Collection:
    """The units of a run, and what they share."""

    name: str
    samples: tuple[Sample, ...]
    scene: Scene | None = None  # the place that they are of, if they are of one
    beside: Mapping[str, str] = field(default_factory=dict)  # digests of what results depend on beside the units' images


def collect_photographs(images: Images) -> Collection:
    """A unit for each photograph of a folder, or of those given; the built-in ones for None.

    Raises
    ------
    UserError
        if there is no such folder, it holds no photograph, or two have one name.
    """
    name, sources = _photographs(images)
    return Collection(name=name, samples=tuple(Sample(name=source.name, images=(source,)) for source in sources))


def collect_only_photographs(task: Task, images: Images, dataset: Dataset | None) -> Collection:
    """`of_photographs`, for a task that judges nothing else; raises UserError if it is given a place."""
    if dataset is not None:
        raise UserError(f"{task.name()} judges photographs and takes no dataset; give --images")
    return collect_photographs(images)


def collect_queries(dataset: Dataset) -> Collection:
    """A unit for each query of a dataset's scene.

    Raises
    ------
    UserError
        if it has none, or is damaged.
    """
    scene = dataset.scene()
    if not scene.queries:
        raise UserError(f"{scene.name}: the scene has no queries")
    units = (Sample(name=query.name, images=(query.pixels,), condition=query.condition, subject=query) for query in scene.queries)
    return Collection(
        name=scene.name,
        samples=tuple(units),
        scene=scene,
        beside={"scene": digest([scene.unit, fingerprint(scene.references), fingerprint(scene.queries)])},
    )


def fingerprint(images: Sequence[SceneImage]) -> str:
    """A digest of images of a scene: their contents, and what is known of their cameras and poses."""
    known = [
        [
            image.name,
            image.condition,
            _content_hash(image.pixels),
            image.camera.model.name,
            [image.camera.width, image.camera.height, *image.camera.params.tolist()],
            None if image.cam_from_world is None else image.cam_from_world.matrix().tolist(),
        ]
        for image in images
    ]
    return digest(known)


def read_pixels(image: ImageSource) -> tuple[Bytes, tuple[str, ...]]:
    """The pixels, (H, W, 3) uint8 RGB, and notes on what was converted.

    Raises
    ------
    UnitError
        if it cannot be read.
    """
    if isinstance(image, Source):
        photograph = photographs.read(image.path)
        return photograph.pixels, photograph.notes
    return image.read(), ()


def read_foreground(image: ImageSource) -> Mask | None:
    """(H, W), True where something hides the scene that moves; None where that is not known."""
    return None if isinstance(image, Source) else image.foreground()


def image_path(image: ImageSource) -> Path | None:
    """The file that an image is in, if it is in one."""
    return getattr(image, "path", None)


def _content_hash(image: ImageSource) -> str:
    try:
        return image.content_hash()
    except OSError as error:
        return f"unreadable: {error.strerror}"  # its record will be `failed`


def _photographs(images: Images) -> tuple[str, list[Source]]:
    if images is None:
        return "builtin", photographs.builtin()
    if isinstance(images, (str, Path)):
        return Path(images).resolve().name, photographs.folder(Path(images))
    sources = [image if isinstance(image, Source) else Source(Path(image).name, Path(image)) for image in images]
    if len({source.name for source in sources}) < len(sources):
        raise UserError("two of the photographs have the same file name")
    if not sources:
        raise UserError("no photograph was given")
    return "files", sources
