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
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from bench.api import Dataset
from bench.core import paths
from bench.core.errors import UserError
from bench.formats import colmap_model, lists
from bench.formats.colmap_model import PosedImage
from bench.images.scene import Condition, File, Reference, Scene, SceneImage

if TYPE_CHECKING:
    import pycolmap


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
    models = [folder for folder in (root / "sparse", root / "sparse" / "0") if colmap_model.is_model(folder)]
    if not models:
        raise UserError(f"{root / 'sparse'}: no COLMAP model (cameras, images and points3D, .txt or .bin)")
    listed: dict[Condition, Path] = {condition: lists.queries_path(root, condition) for condition in get_args(Condition)}
    present = {condition: path for condition, path in listed.items() if path.is_file()}
    if not present:
        raise UserError(f"{root / 'queries'}: no list of queries; expected {' or '.join(path.name for path in listed.values())}")
    return assemble(
        root.name,
        references=colmap_model.read(models[0]),
        queries=present,
        images=root / "images",
        ground_truth=find_ground_truth(root),
        masks=root / "foreground",
    )


def find_ground_truth(root: Path) -> Path | None:
    """Return the file or folder with the poses of the queries; None if there is none."""
    return next((path for path in (root / "ground_truth.txt", root / "ground_truth") if path.exists()), None)


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


def _read_poses(path: Path) -> dict[str, tuple[str, pycolmap.Rigid3d]]:
    """Read a list of poses or a model. -> by name: file and line, and camera from world"""
    if path.is_dir():
        return {name: (where, pose) for name, (where, _, pose) in colmap_model.read(path).items()}
    return {name: (f"{path}:{line}", pose) for name, (line, pose) in lists.read_poses(path).items()}


def _find_image(name: str, where: str, camera: pycolmap.Camera, images: Path, masks: Path | None) -> File:
    try:
        path = paths.find_file(images, name)
        mask = None if masks is None else paths.find_file(masks, name).with_suffix(".png")
    except UserError as error:
        raise UserError(f"{where}: {error}") from None
    if not os.path.isfile(path):
        raise UserError(f"{where}: there is no image {path}")
    mask = mask if mask is not None and os.path.isfile(mask) else None
    return File(path=path, size=(camera.width, camera.height), mask=mask, name=name)


PLUGIN = Colmap
