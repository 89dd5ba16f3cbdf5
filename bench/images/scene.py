"""A place that was photographed: reference images whose poses are known, and queries to be localized or reconstructed.

One convention everywhere, COLMAP's. A pose is `cam_from_world`: x_camera = R x_world + t; the camera's x goes right, its y down,
its z forward, and its centre is -Rᵀt. In an image the centre of the top-left pixel is (0.5, 0.5). Quaternions in files are
written w x y z (pycolmap's own arrays are x y z w).
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
    """Where an image's pixels come from; nothing is read before it is asked for. Can be pickled, for other processes."""

    @abstractmethod
    def content_hash(self) -> str:
        """What caches and records know the image by; never its name."""

    @abstractmethod
    def read(self) -> Bytes:
        """(H, W, 3) uint8 RGB, of the size that the image's camera says."""

    def foreground(self) -> Mask | None:
        """(H, W), True where something hides the scene that moves; None where that is not known."""
        return None


@dataclass(frozen=True, kw_only=True)
class File(Pixels):
    """A photograph on disk as it is stored, without EXIF rotation: intrinsics are of the stored image."""

    path: Path
    size: tuple[int, int]  # width, height that the camera says
    mask: Path | None = None  # an image that is white where the foreground is

    def content_hash(self) -> str:
        return Source(self.path.name, self.path).content_hash()

    def read(self) -> Bytes:
        """Raises UnitError if the file cannot be decoded or is of another size."""
        return np.array(self._decoded(self.path))

    def foreground(self) -> Mask | None:
        return None if self.mask is None else np.asarray(self._decoded(self.mask).convert("L")) > 127

    def _decoded(self, path: Path) -> Image:
        image, _ = decode(path, upright=False)
        if image.size != self.size:
            raise SampleError(f"{path}: {image.width} x {image.height} pixels; its camera says {self.size[0]} x {self.size[1]}")
        return image


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneImage:
    """One image of a scene."""

    name: str  # as lists and models call it, with / between folders
    camera: pycolmap.Camera  # intrinsics; its id means nothing
    cam_from_world: pycolmap.Rigid3d | None  # in the scene's unit of length; None where it is withheld
    condition: Condition
    pixels: Pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference(SceneImage):
    """An image of the map: its pose is known."""

    cam_from_world: pycolmap.Rigid3d


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Reference images, each with its pose, and queries."""

    name: str
    references: tuple[Reference, ...]
    queries: tuple[SceneImage, ...]
    unit: str = "metre"  # of length, in words
    left_out: tuple[str, ...] = ()  # photographs that have no pose, so that nothing could be measured with them
