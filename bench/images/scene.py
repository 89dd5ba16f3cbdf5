"""Scenes: reference images with known poses, and queries to localize or reconstruct.

All conventions are COLMAP's. A pose is `cam_from_world`: x_camera = R x_world + t. The camera's x axis points right, its y axis
down, its z axis forward, and its centre is -Rᵀt. The centre of the top-left pixel is (0.5, 0.5). Quaternions in files are written
w x y z; the arrays of pycolmap are x y z w.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from bench.core.errors import SampleError
from bench.images.photographs import Source, decode
from bench.types import Bytes

if TYPE_CHECKING:
    import pycolmap
    from PIL.Image import Image

Condition = Literal["day", "night"]
Mask = NDArray[np.bool_]


class Pixels(ABC):
    """Pixels of an image, read on demand. Objects can be pickled for other processes."""

    @abstractmethod
    def content_hash(self) -> str:
        """Return the hash that identifies the image in caches and records."""

    @abstractmethod
    def read(self) -> Bytes:
        """Return (H, W, 3) uint8 RGB, in the size of the image's camera."""

    def file(self) -> Source | None:
        """Return the photograph's file and its name below the image folder; None if it has none."""
        return None

    def foreground(self) -> Mask | None:
        """Return the mask of moving objects in front of the scene, (H, W); None if it is not known."""
        return None


@dataclass(frozen=True, kw_only=True)
class File(Pixels):
    """A photograph on disk, read without EXIF rotation, since intrinsics are those of the stored image."""

    path: Path
    size: tuple[int, int]  # width, height of the camera
    mask: Path | None = None  # an image that is white on the foreground
    name: str | None = None  # below the image folder; None if there is no such folder

    def content_hash(self) -> str:
        return Source(self.path.name, self.path).content_hash()

    def read(self) -> Bytes:
        """Return the pixels; raise SampleError if the file cannot be decoded or has another size."""
        return np.array(self._decode(self.path))

    def file(self) -> Source | None:
        return None if self.name is None else Source(self.name, self.path)

    def foreground(self) -> Mask | None:
        return None if self.mask is None else np.asarray(self._decode(self.mask).convert("L")) > 127

    def _decode(self, path: Path) -> Image:
        image, _ = decode(path, upright=False, whole=True)
        if image.size != self.size:
            raise SampleError(f"{path}: {image.width} x {image.height} pixels; its camera says {self.size[0]} x {self.size[1]}")
        return image


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneImage:
    """One image of a scene."""

    name: str  # as in lists and models, with / as the separator of folders
    camera: pycolmap.Camera  # intrinsics; its id is not used
    cam_from_world: pycolmap.Rigid3d | None  # in the scene's unit of length; None if withheld
    condition: Condition
    pixels: Pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference(SceneImage):
    """An image of the map, with its pose."""

    cam_from_world: pycolmap.Rigid3d


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Reference images with poses, and queries."""

    name: str
    references: tuple[Reference, ...]
    queries: tuple[SceneImage, ...]
    unit: str = "metre"  # of length
    excluded_images: tuple[str, ...] = ()  # names of photographs without a pose
