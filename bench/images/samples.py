"""Samples: a photograph, a pair of images, a query of a scene, or a whole scene. Each record is about one sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.core.errors import SampleError, UserError
from bench.core.hashing import digest
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.scene import Mask, Pixels, Scene, SceneImage
from bench.types import Bytes

if TYPE_CHECKING:
    from bench.api import Dataset
    from bench.task_api import Task

ImageSource = Source | Pixels
Images = Path | str | Sequence[Path | str | Source] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One sample of an experiment. The runner extracts and protects all of its images."""

    name: str
    images: tuple[ImageSource, ...]
    condition: str | None = None  # such as "night"; tables group results by it
    subject: Any = None  # task-specific data

    def content_hash(self) -> str:
        """Return the hash of all images. An unreadable image contributes its error."""
        hashes = [_content_hash(image) for image in self.images]
        return hashes[0] if len(hashes) == 1 else digest(hashes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Collection:
    """The samples of a run."""

    name: str
    samples: tuple[Sample, ...]
    scene: Scene | None = None  # the scene of all samples; None if they have no common scene
    extra_inputs: Mapping[str, str] = field(default_factory=dict)  # digests of inputs other than the samples' images


def collect_photographs(images: Images) -> Collection:
    """Return one sample for each photograph of a folder, of a torchvision dataset or of a list; None: the built-in photographs.

    Raises
    ------
    UserError
        if there is no such folder, no photograph in it, or a name occurs twice.
    """
    name, sources = _list_sources(images)
    return Collection(name=name, samples=tuple(Sample(name=source.name, images=(source,)) for source in sources))


def collect_only_photographs(task: Task, images: Images, dataset: Dataset | None) -> Collection:
    """Call `collect_photographs` for a task that takes no dataset; raise UserError if a dataset is given."""
    if dataset is not None:
        raise UserError(f"{task.name()} takes photographs, not a dataset; give --images")
    return collect_photographs(images)


def collect_queries(dataset: Dataset) -> Collection:
    """Return one sample for each query of a dataset's scene.

    Raises
    ------
    UserError
        if there is no query, or the dataset is damaged.
    """
    scene = dataset.scene()
    if not scene.queries:
        raise UserError(f"{scene.name}: the scene has no queries")
    queries = (
        Sample(name=query.name, images=(query.pixels,), condition=query.condition, subject=query) for query in scene.queries
    )
    return Collection(
        name=scene.name,
        samples=tuple(queries),
        scene=scene,
        extra_inputs={"scene": digest([scene.unit, hash_scene_images(scene.references), hash_scene_images(scene.queries)])},
    )


def hash_scene_images(images: Sequence[SceneImage]) -> str:
    """Return a digest of images of a scene: contents, cameras and poses."""
    described = [
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
    return digest(described)


def read_pixels(image: ImageSource) -> tuple[Bytes, tuple[str, ...]]:
    """Return the pixels, (H, W, 3) uint8 RGB, and notes on their conversion.

    Raises
    ------
    SampleError
        if the image cannot be read.
    """
    if isinstance(image, Source):
        photograph = photographs.read(image)
        return photograph.pixels, photograph.notes
    return image.read(), ()


def read_foreground(image: ImageSource) -> Mask | None:
    """Return the mask of moving objects in front of the scene, (H, W); None if it is not known."""
    return None if isinstance(image, Source) else image.foreground()


def _content_hash(image: ImageSource) -> str:
    try:
        return image.content_hash()
    except OSError as error:
        return f"unreadable: {error.strerror}"  # its record will be `failed`
    except SampleError as error:
        return f"unreadable: {error}"


def _list_sources(images: Images) -> tuple[str, list[Source]]:
    if images is None:
        return "builtin", photographs.list_builtin()
    if isinstance(images, (str, Path)):
        return photographs.name_images(Path(images)), photographs.list_photographs(Path(images))
    sources = [image if isinstance(image, Source) else Source(Path(image).name, Path(image)) for image in images]
    if len({source.name for source in sources}) < len(sources):
        raise UserError("two of the photographs have the same file name; rename one of them")
    if not sources:
        raise UserError("no photograph was given; give at least one, or None for the built-in ones")
    return "files", sources
