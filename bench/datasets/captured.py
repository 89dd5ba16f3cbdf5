"""A folder of photographs of one place by one camera, as a scene: structure from motion gives the poses.

The poses, of all photographs with raw descriptors, are the ground truth, as they were for Aachen. Every fifth photograph is a
query unless told otherwise; it has no part in the map or the dictionary, which are made from references alone. Structure from
motion leaves the unit of length open; here it is fixed by the distance of two cameras: unless two are named, those of the first
photograph by name and of the one halfway down the list.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from bench.api import Dataset
from bench.cache import provenance, store
from bench.core.colmap_log import quietly
from bench.core.errors import UserError
from bench.datasets import colmap
from bench.datasets.colmap import Placed
from bench.images.photographs import Source, folder
from bench.images.scene import File, Reference, Scene


@dataclass(frozen=True, kw_only=True)
class Captured(Dataset):
    """Photographs of one place by one camera; poses come from structure from motion, done once and kept."""

    path: Path
    held_out: int = 5  # every so-manieth photograph is a query,
    leading: int = 0  # or, unless this is 0, so many from the first by name on: a stretch, for structure from motion
    first: str | None = None  # the two photographs whose cameras fix the unit of length
    second: str | None = None
    length: float = 1.0  # of the distance between them

    def __post_init__(self) -> None:
        if self.held_out < 2:
            raise UserError("captured: held_out must be at least 2, or there are no references")
        if self.leading < 0:
            raise UserError("captured: leading must be at least 0")
        if not 0 < self.length < np.inf:
            raise UserError("captured: length must be finite and above zero")

    def scene(self) -> Scene:
        sources = folder(self.path)
        chosen = sources[: self.leading] if self.leading else sources[:: self.held_out]
        if len(chosen) == len(sources):
            raise UserError(f"{self.path}: all {len(sources)} photographs would be queries, and none a reference")
        found = colmap.read_model(_model(self.path, sources))
        first, second = self.first or sources[0].name, self.second or sources[len(sources) // 2].name
        scale = self.length / _distance(found, first, second)
        held_out = {source.name for source in chosen}
        images = {
            name: _image(self.path / name, camera, pycolmap.Rigid3d(pose.rotation, pose.translation * scale), name)
            for name, (_, camera, pose) in sorted(found.items())
        }
        return Scene(
            name=self.path.name,
            references=tuple(image for name, image in images.items() if name not in held_out),
            queries=tuple(image for name, image in images.items() if name in held_out),
            left_out=tuple(source.name for source in sources if source.name not in found),
            unit=f"{self.length:g} between the cameras of {first} and {second}",
        )


def _model(directory: Path, sources: list[Source]) -> Path:
    """The folder of the model of these very photographs, made unless it is kept."""

    def make(kept: Path) -> None:
        with tempfile.TemporaryDirectory() as scratch, quietly():
            _structure_from_motion(directory, [source.name for source in sources], Path(scratch)).write(kept)

    photographs = {source.name: source.content_hash() for source in sources}
    return store.folder(
        "models", {"pycolmap": pycolmap.__version__, "photographs": photographs, "source": provenance.source(__name__)}, make
    )


def _structure_from_motion(directory: Path, names: list[str], scratch: Path) -> pycolmap.Reconstruction:
    """COLMAP's own pipeline with its default SIFT and one camera for all; the largest model, if there are several."""
    database = scratch / "database.db"
    pycolmap.extract_features(database, directory, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    # One thread and a seed: more of them add up in another order each time.
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1)
    models = pycolmap.incremental_mapping(database, directory, scratch, options)
    if not models:
        raise UserError(f"{directory}: structure from motion found no model; do the photographs overlap?")
    return max(models.values(), key=lambda model: model.num_reg_images())


def _distance(found: dict[str, Placed], first: str, second: str) -> float:
    for name in (first, second):
        if name not in found:
            raise UserError(f"captured: {name}, which fixes the unit of length, has no pose; name another (first=, second=)")
    a, b = (found[name][2].inverse().translation for name in (first, second))
    distance = float(np.linalg.norm(a - b))
    if distance == 0:
        raise UserError(f"captured: {first} and {second} were taken from one place, which fixes no unit of length; name others")
    return distance


def _image(path: Path, camera: pycolmap.Camera, pose: pycolmap.Rigid3d, name: str) -> Reference:
    pixels = File(path=path, size=(camera.width, camera.height))
    return Reference(name=name, camera=camera, cam_from_world=pose, condition="day", pixels=pixels)


PLUGIN = Captured
