"""Export of a scene to the layouts that `bench.datasets.aachen` and `bench.datasets.colmap` read.

Images are written as PNG, so no pixel changes, and `.png` is appended to other names. Foreground masks and ground truth are
written, too, if they are known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, TypeVar, get_args

import numpy as np
from PIL import Image

from bench.core import paths
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.formats import lists, nvm
from bench.images.scene import Condition, Reference, Scene, SceneImage

if TYPE_CHECKING:
    import pycolmap

SUFFIX = ".png"

S = TypeVar("S", bound=SceneImage)


def write(scene: Scene, layout: str, out: Path) -> None:
    """Write a scene into a new folder.

    Raises
    ------
    UserError
        if the folder is not empty, the layout is unknown, or the layout cannot represent the scene. Names of images must not lead
        out of the folder, nor need the path of another one.
    """
    if layout not in LAYOUTS:
        raise UserError(f"--layout {layout}: unknown layout; available: {', '.join(LAYOUTS)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"--out {out}: exists already; give a new folder")
    references, queries = tuple(map(_rename, scene.references)), tuple(map(_rename, scene.queries))
    scene, images_to_write = dataclasses.replace(scene, references=references, queries=queries), references + queries
    _check_names([image.name for image in images_to_write], out)
    images = LAYOUTS[layout](scene, out)
    poses = {query.name: query.cam_from_world for query in scene.queries if query.cam_from_world is not None}
    if poses:
        lists.write_poses(out / "ground_truth.txt", poses)
    with Progress(f"writing {layout}", len(images_to_write)) as progress:
        for image in images_to_write:
            _save_png(paths.find_file(images, image.name), image.pixels.read())
            mask = image.pixels.foreground()
            if mask is not None:
                _save_png(paths.find_file(out / "foreground", image.name), mask.astype(np.uint8) * 255)
            progress.advance(note=image.name)


def _rename(image: S) -> S:
    """Return an image with the name of its file."""
    return image if image.name.endswith(SUFFIX) else dataclasses.replace(image, name=image.name + SUFFIX)


def _check_names(names: list[str], out: Path) -> None:
    """Raise UserError, before anything is written, for a name that a list or the folder cannot hold beside the others."""
    lists.check_names(names)
    seen: set[str] = set()
    folders = {str(folder) for name in names for folder in PurePosixPath(name).parents}
    for name in names:
        paths.find_file(out, name)
        path = str(PurePosixPath(name))
        if path in seen or path in folders:
            raise UserError(f"{name}: two images would need this path; rename one of them")
        seen.add(path)


def _write_aachen(scene: Scene, out: Path) -> Path:
    """Write Aachen version 1: an NVM model with a list of intrinsics. -> the folder for images"""
    queries = _group_by_condition(scene)
    if len(queries) != len(get_args(Condition)):
        raise UserError(f"--layout aachen: needs queries by day and by night, but has only {' and '.join(queries) or 'neither'}")
    models = out / "3D-models"
    nvm.write(models / "aachen_cvpr2018_db.nvm", {image.name: (image.camera, image.cam_from_world) for image in scene.references})
    lists.write_intrinsics(models / "database_intrinsics.txt", {image.name: image.camera for image in scene.references})
    for condition, cameras in queries.items():
        lists.write_intrinsics(out / "queries" / f"{condition}_time_queries_with_intrinsics.txt", cameras)
    return out / "images_upright"


def _write_colmap(scene: Scene, out: Path) -> Path:
    """Write a text model without points. -> the folder for images"""
    folder = out / "sparse"
    folder.mkdir(parents=True)
    build_model(scene.references).write_text(folder)
    for condition, cameras in _group_by_condition(scene).items():
        lists.write_intrinsics(lists.queries_path(out, condition), cameras)
    return out / "images"


def write_binary_model(references: tuple[Reference, ...], folder: Path) -> None:
    """Write the cameras and poses of references as a binary model without points, which hloc reads and COLMAP triangulates.

    Raises
    ------
    UserError
        if the folder exists already.
    """
    if folder.exists():
        raise UserError(f"{folder}: exists already; give a new folder")
    folder.mkdir(parents=True)
    build_model(references).write_binary(folder)


def build_model(images: tuple[Reference, ...]) -> pycolmap.Reconstruction:
    """Return a reconstruction of cameras and poses without points. Images with equal intrinsics share a camera.

    Images are numbered from 1 in the given order.
    """
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    numbers: dict[tuple[object, ...], int] = {}
    for number, image in enumerate(images, 1):
        camera = image.camera
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            shared = pycolmap.Camera.create_from_model_name(numbers[key], camera.model.name, 1.0, camera.width, camera.height)
            shared.params = camera.params.tolist()
            reconstruction.add_camera_with_trivial_rig(shared)
        added = pycolmap.Image(name=image.name, camera_id=numbers[key], image_id=number)
        reconstruction.add_image_with_trivial_frame(added, image.cam_from_world)
    return reconstruction


def _group_by_condition(scene: Scene) -> dict[Condition, dict[str, pycolmap.Camera]]:
    groups: dict[Condition, dict[str, pycolmap.Camera]] = {}
    for query in scene.queries:
        groups.setdefault(query.condition, {})[query.name] = query.camera
    return groups


def _save_png(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, compress_level=4)


LAYOUTS: Mapping[str, Callable[[Scene, Path], Path]] = {"aachen": _write_aachen, "colmap": _write_colmap}
