"""A folder of photographs of one scene by one camera; structure from motion gives the poses.

The ground truth are poses from raw descriptors of all photographs, as for Aachen. By default every fifth photograph is a query.
The map and the dictionary are built from references alone. Structure from motion does not determine the unit of length. The
distance of two cameras defines it: by default those of the first photograph by name and of the middle one.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.api import Dataset
from bench.cache import provenance, store
from bench.core.colmap_log import silence_colmap
from bench.core.errors import UserError
from bench.formats import colmap_model
from bench.formats.colmap_model import PosedImage
from bench.images.photographs import Source, list_photographs
from bench.images.scene import File, Reference, Scene

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class Captured(Dataset):
    """Photographs of one scene by one camera; poses come from structure from motion, and are cached."""

    path: Path
    held_out: int = 5  # every photograph whose index is a multiple of this is a query
    leading: int = 0  # if not 0, the first `leading` photographs by name are the queries instead, for structure from motion
    first: str | None = None  # first and second: the photographs whose cameras define the unit of length
    second: str | None = None
    length: float = 1.0  # distance between the two cameras

    def __post_init__(self) -> None:
        if self.held_out < 2:
            raise UserError("captured: held_out must be at least 2, or there are no references")
        if self.leading < 0:
            raise UserError("captured: leading must be at least 0")
        if not 0 < self.length < np.inf:
            raise UserError("captured: length must be finite and above zero")

    def scene(self) -> Scene:
        import pycolmap

        sources = list_photographs(self.path)
        queries = sources[: self.leading] if self.leading else sources[:: self.held_out]
        if len(queries) == len(sources):
            raise UserError(
                f"{self.path}: all {len(sources)} photographs would be queries, and none a reference; lower leading or add some"
            )
        posed = colmap_model.read(_load_model(self.path, sources))
        first, second = self.first or sources[0].name, self.second or sources[len(sources) // 2].name
        scale = self.length / _measure_distance(posed, first, second)
        held_out = {source.name for source in queries}
        images = {
            name: _create_reference(self.path / name, camera, pycolmap.Rigid3d(pose.rotation, pose.translation * scale), name)
            for name, (_, camera, pose) in sorted(posed.items())
        }
        return Scene(
            name=self.path.name,
            references=tuple(image for name, image in images.items() if name not in held_out),
            queries=tuple(image for name, image in images.items() if name in held_out),
            excluded_images=tuple(source.name for source in sources if source.name not in posed),
            unit=f"{self.length:g} between the cameras of {first} and {second}",
        )


def _load_model(directory: Path, sources: list[Source]) -> Path:
    """Return the folder with the cached model of these photographs. A missing model is built."""
    import pycolmap

    def build(path: Path) -> None:
        with tempfile.TemporaryDirectory() as scratch, silence_colmap():
            _run_structure_from_motion(directory, [source.name for source in sources], Path(scratch)).write(path)

    photographs = {source.name: source.content_hash() for source in sources}
    return store.fetch_folder(
        "models",
        {"pycolmap": pycolmap.__version__, "photographs": photographs, "source": provenance.hash_modules(__name__)},
        build,
    )


def _run_structure_from_motion(directory: Path, names: list[str], scratch: Path) -> pycolmap.Reconstruction:
    """Run COLMAP's pipeline with its default SIFT and one camera for all images, and return the largest model."""
    import pycolmap

    database = scratch / "database.db"
    pycolmap.extract_features(database, directory, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    # One thread and a seed, since the order of summation varies with more threads.
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1)
    models = pycolmap.incremental_mapping(database, directory, scratch, options)
    if not models:
        raise UserError(f"{directory}: structure from motion found no model; do the photographs overlap?")
    return max(models.values(), key=lambda model: model.num_reg_images())


def _measure_distance(posed: dict[str, PosedImage], first: str, second: str) -> float:
    for name in (first, second):
        if name not in posed:
            raise UserError(f"captured: {name}, which defines the unit of length, has no pose; give another (first=, second=)")
    a, b = (posed[name][2].inverse().translation for name in (first, second))
    distance = float(np.linalg.norm(a - b))
    if distance == 0:
        raise UserError(f"captured: {first} and {second} have the same position, which defines no unit of length; give others")
    return distance


def _create_reference(path: Path, camera: pycolmap.Camera, pose: pycolmap.Rigid3d, name: str) -> Reference:
    pixels = File(path=path, size=(camera.width, camera.height), name=name)
    return Reference(name=name, camera=camera, cam_from_world=pose, condition="day", pixels=pixels)


PLUGIN = Captured
