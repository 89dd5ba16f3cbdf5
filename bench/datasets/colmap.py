"""Any COLMAP model as a scene. Its images are the references; lists with names and intrinsics define the queries.

The folder contains

    images/                                     references and queries
    sparse/ or sparse/0/                        the model, as text or binary
    queries/{day,night}_queries_with_intrinsics.txt    either or both
    ground_truth.txt                            optional: poses of the queries, or a folder of that name with a model
    foreground/                                 optional: masks by the images' names, white where something moves
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from bench.api import Dataset
from bench.core import paths
from bench.core.errors import UserError
from bench.formats import lists
from bench.images.scene import Condition, File, Reference, Scene, SceneImage

if TYPE_CHECKING:
    import pycolmap

PARTS = ("cameras", "images", "points3D")


@dataclass(frozen=True, kw_only=True)
class Colmap(Dataset):
    """A folder with a COLMAP model, its images, and lists of queries."""

    path: Path

    def scene(self) -> Scene:
        return load(self.path)


def load(root: Path) -> Scene:
    """Return the scene in a folder of the layout above.

    Raises
    ------
    UserError
        if a part is missing or damaged; the message names file and line.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    models = [folder for folder in (root / "sparse", root / "sparse" / "0") if is_model(folder)]
    if not models:
        raise UserError(f"{root / 'sparse'}: no COLMAP model (cameras, images and points3D, .txt or .bin)")
    listed: dict[Condition, Path] = {condition: lists.queries_path(root, condition) for condition in get_args(Condition)}
    present = {condition: path for condition, path in listed.items() if path.is_file()}
    if not present:
        raise UserError(f"{root / 'queries'}: no list of queries; expected {' or '.join(path.name for path in listed.values())}")
    return assemble(
        root.name,
        references=read_model(models[0]),
        queries=present,
        images=root / "images",
        ground_truth=find_ground_truth(root),
        masks=root / "foreground",
    )


def find_ground_truth(root: Path) -> Path | None:
    """Return the file or folder with the poses of the queries; None if there is none."""
    return next((path for path in (root / "ground_truth.txt", root / "ground_truth") if path.exists()), None)


PosedImage = tuple[str, "pycolmap.Camera", "pycolmap.Rigid3d"]  # file and line, for messages; intrinsics; camera from world


def assemble(
    name: str,
    *,
    references: Mapping[str, PosedImage],
    queries: Mapping[Condition, Path],
    images: Path,
    ground_truth: Path | None = None,
    masks: Path | None = None,
) -> Scene:
    """Return the scene of given references, lists of queries, and the folder of all images.

    Raises
    ------
    UserError
        if a list is damaged, an image is missing, a name is used twice, or a pose belongs to no query. The message names file and
        line.
    """
    poses = {} if ground_truth is None else _read_poses(ground_truth)
    reference_images = [
        Reference(
            name=name, camera=camera, cam_from_world=pose, condition="day", pixels=_find_image(name, where, camera, images, masks)
        )
        for name, (where, camera, pose) in sorted(references.items())
    ]
    query_images: dict[str, SceneImage] = {}
    for condition, path in queries.items():
        for query, (line, camera) in lists.read_intrinsics(path).items():
            where = f"{path}:{line}"
            if query in references or query in query_images:
                raise UserError(f"{where}: {query} is {'a reference' if query in references else 'in another list'} as well")
            pixels, pose = _find_image(query, where, camera, images, masks), poses.pop(query, (where, None))[1]
            query_images[query] = SceneImage(name=query, camera=camera, cam_from_world=pose, condition=condition, pixels=pixels)
    if poses:
        stray, (where, _) = next(iter(poses.items()))
        raise UserError(f"{where}: {stray} has a pose but is no query; add it to a list of queries, or remove the pose")
    return Scene(name=name, references=tuple(reference_images), queries=tuple(query_images.values()))


def read_model(folder: Path) -> dict[str, PosedImage]:
    """Return the images of a COLMAP model that have a pose, by name.

    Raises
    ------
    UserError
        if the model is damaged or contains no pose; the message names the file and, for text, the line.
    """
    import pycolmap

    wheres = _check_text(folder) if (folder / "images.txt").is_file() else {}
    try:
        model = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"{folder}: not a whole COLMAP model: {error}") from None
    posed: dict[str, PosedImage] = {}
    for number, image in sorted(model.images.items()):
        where = wheres.get(image.name, f"{folder}, image {number}")
        if not image.has_pose:
            continue
        if image.name in posed:
            raise UserError(f"{where}: {image.name} is in this model twice")
        # Copies: pycolmap returns references into the model, which is freed on return.
        camera, pose = deepcopy(image.camera), image.cam_from_world()
        if not (np.isfinite(pose.matrix()).all() and np.isfinite(camera.params).all()):
            raise UserError(f"{where}: the pose or the intrinsics of {image.name} are not finite")
        posed[image.name] = where, camera, pose
    if not posed:
        raise UserError(f"{folder}: no image of this model has a pose")
    return posed


def is_model(folder: Path) -> bool:
    return any(all((folder / f"{part}.{suffix}").is_file() for part in PARTS) for suffix in ("txt", "bin"))


def _check_text(folder: Path) -> dict[str, str]:
    """Check faults that pycolmap accepts, or reports without file and line. -> name of an image: its file and line"""
    cameras = set()
    for number, fields in lists.read_fields(folder / "cameras.txt"):
        lists.parse_camera(fields[1:], f"{folder / 'cameras.txt'}:{number}")
        cameras.add(fields[0])
    path, wheres, points = folder / "images.txt", {}, False
    for number, line in lists.read_lines(path):
        where = f"{path}:{number}"
        if points or line.startswith("#") or not line.strip():
            points = False  # the line after an image's holds its points, if any
            continue
        fields = line.split()
        if len(fields) != 10:
            raise UserError(f"{where}: an image has 10 fields (id qw qx qy qz tx ty tz camera name), but there are {len(fields)}")
        lists.parse_pose(fields[1:8], where)
        if fields[8] not in cameras:
            raise UserError(f"{where}: there is no camera {fields[8]} in {folder / 'cameras.txt'}")
        wheres[fields[9]] = where
        points = True
    return wheres


def _read_poses(path: Path) -> dict[str, tuple[str, pycolmap.Rigid3d]]:
    """Read a list of poses or a model. -> by name: file and line, and camera from world"""
    if path.is_dir():
        return {name: (where, pose) for name, (where, _, pose) in read_model(path).items()}
    return {name: (f"{path}:{line}", pose) for name, (line, pose) in lists.read_poses(path).items()}


def _find_image(name: str, where: str, camera: pycolmap.Camera, images: Path, masks: Path | None) -> File:
    try:
        path = paths.find_file(images, name)
        mask = None if masks is None else paths.find_file(masks, name).with_suffix(".png")
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
    if not os.path.isfile(path):
        raise UserError(f"{where}: there is no image {path}")
    return File(path=path, size=(camera.width, camera.height), mask=mask if mask is not None and os.path.isfile(mask) else None)


PLUGIN = Colmap
