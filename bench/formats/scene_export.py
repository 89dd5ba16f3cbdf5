"""Writes a scene to disk in the layouts that `bench.datasets.aachen` and `bench.datasets.colmap` read.

Images are PNG, so what is read back is what was rendered. Masks of what moves and the ground truth stand beside, where known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import get_args

import numpy as np
import pycolmap
from PIL import Image

from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.formats import lists, nvm
from bench.images.scene import Condition, Reference, Scene


def write(scene: Scene, layout: str, out: Path) -> None:
    """Write all of a scene into a new folder.

    Raises
    ------
    UserError
        if the folder holds something already, there is no such layout, or the layout cannot say what the scene is.
    """
    if layout not in LAYOUTS:
        raise UserError(f"--layout {layout}: there is {' and '.join(LAYOUTS)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"--out {out}: exists already; name a new folder")
    images = LAYOUTS[layout](scene, out)
    poses = {query.name: query.cam_from_world for query in scene.queries if query.cam_from_world is not None}
    if poses:
        lists.write_poses(out / "ground_truth.txt", poses)
    everything = scene.references + scene.queries
    with Progress(f"writing {layout}", len(everything)) as progress:
        for image in everything:
            _save(images / image.name, image.pixels.read())
            mask = image.pixels.foreground()
            if mask is not None:
                _save(out / "foreground" / image.name, mask.astype(np.uint8) * 255)
            progress.advance(note=image.name)


def _as_aachen(scene: Scene, out: Path) -> Path:
    """Version 1: an NVM model with intrinsics beside it. -> the folder for images"""
    queries = _by_condition(scene)
    if len(queries) != len(get_args(Condition)):
        raise UserError(f"--layout aachen: needs queries by day and by night; these are by {' and '.join(queries) or 'neither'}")
    models = out / "3D-models"
    nvm.write(models / "aachen_cvpr2018_db.nvm", {image.name: (image.camera, image.cam_from_world) for image in scene.references})
    lists.write_intrinsics(models / "database_intrinsics.txt", {image.name: image.camera for image in scene.references})
    for condition, cameras in queries.items():
        lists.write_intrinsics(out / "queries" / f"{condition}_time_queries_with_intrinsics.txt", cameras)
    return out / "images_upright"


def _as_colmap(scene: Scene, out: Path) -> Path:
    """A text model without points. -> the folder for images"""
    folder = out / "sparse"
    folder.mkdir(parents=True)
    model(scene.references).write_text(folder)
    for condition, cameras in _by_condition(scene).items():
        lists.write_intrinsics(lists.queries_path(out, condition), cameras)
    return out / "images"


def model(images: tuple[Reference, ...]) -> pycolmap.Reconstruction:
    """A reconstruction of the images' cameras and poses, without points; images with equal intrinsics share a camera.

    Images are numbered from 1 in the order given.
    """
    built = pycolmap.Reconstruction()
    numbers: dict[tuple[object, ...], int] = {}
    for number, image in enumerate(images, 1):
        camera = image.camera
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            shared = pycolmap.Camera.create_from_model_name(numbers[key], camera.model.name, 1.0, camera.width, camera.height)
            shared.params = camera.params.tolist()
            built.add_camera_with_trivial_rig(shared)
        added = pycolmap.Image(name=image.name, camera_id=numbers[key], image_id=number)
        built.add_image_with_trivial_frame(added, image.cam_from_world)
    return built


def _by_condition(scene: Scene) -> dict[Condition, dict[str, pycolmap.Camera]]:
    found: dict[Condition, dict[str, pycolmap.Camera]] = {}
    for query in scene.queries:
        found.setdefault(query.condition, {})[query.name] = query.camera
    return found


def _save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path.with_suffix(".png"), compress_level=4)


LAYOUTS: Mapping[str, Callable[[Scene, Path], Path]] = {"aachen": _as_aachen, "colmap": _as_colmap}
