"""Aachen Day-Night, versions 1 and 1.1, in the layout of the download, and results for its evaluation server.

Sources: Sattler et al., CVPR 2018; Zhang et al., IJCV 2020. The folder contains

    images/images_upright/ or images_upright/   references and queries
    3D-models/                                  v1: aachen_cvpr2018_db.nvm, here or in aachen_v_1/, with database_intrinsics.txt;
                                                v1.1: aachen_v_1_1/, a COLMAP model, or an NVM with database_intrinsics_v1_1.txt
    queries/{day,night}_time_queries_with_intrinsics*.txt

The poses of its queries are withheld. A file ground_truth.txt is read if it exists. The download has none, but the gallery can be
exported in this layout, too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from bench.api import Dataset
from bench.core import paths
from bench.core.errors import UserError
from bench.datasets import colmap
from bench.formats import colmap_model, lists, nvm
from bench.formats.colmap_model import PosedImage
from bench.images.scene import Condition, Scene

if TYPE_CHECKING:
    import pycolmap

Version = Literal["v1", "v1.1"]

MODELS: Mapping[Version, tuple[str, ...]] = {
    "v1": ("aachen_v_1/aachen_cvpr2018_db.nvm", "aachen_cvpr2018_db.nvm"),
    "v1.1": ("aachen_v_1_1", "aachen_v_1_1/aachen_v_1_1.nvm"),
}
INTRINSICS = "database_intrinsics*.txt"  # beside the NVM
QUERIES = "{}_time_queries_with_intrinsics*.txt"
VERSION_1_1 = re.compile(r"v?1[._]1\.txt$")  # the end of the name of a list of version 1.1


@dataclass(frozen=True, kw_only=True)
class Aachen(Dataset):
    """Aachen Day-Night, in the layout of the download."""

    path: Path
    version: Version | None = None  # required if the folder holds both

    def scene(self) -> Scene:
        return load(self.path, self.version)


def load(root: Path, version: Version | None = None) -> Scene:
    """Return the scene of the download.

    If the folder holds both versions, `version` selects one. If a condition has only one list of queries, it is used for either
    version.

    Raises
    ------
    UserError
        if a part is missing or damaged, or `version` is needed; the message names file and line.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    upright = [folder for folder in (root / "images" / "images_upright", root / "images_upright") if folder.is_dir()]
    if not upright:
        raise UserError(f"{root}: neither images_upright/ nor images/images_upright/ exists")
    return colmap.assemble(
        "aachen",
        references=_read_references(root, version),
        queries={condition: _find_query_list(root, condition, version) for condition in get_args(Condition)},
        images=upright[0],
        ground_truth=colmap.find_ground_truth(root),
        masks=root / "foreground",
    )


def write_evaluation(folder: Path, method: str, poses: Mapping[str, pycolmap.Rigid3d | None]) -> tuple[Path, int]:
    """Write `Aachen_eval_[method].txt` for the evaluation server.

    Parameters
    ----------
    poses : camera from world of each query, by name; None for queries that were not localized, which are left out

    Returns
    -------
    The path of the file, and the number of queries left out.

    Raises
    ------
    UserError
        if the method's name cannot be part of a file name, or two queries have the same basename.
    """
    if not re.fullmatch(r"[\w.+-]+", method):
        raise UserError(f"method {method!r}: use only letters, digits and . _ + -")
    by_base: dict[str, pycolmap.Rigid3d | None] = {}
    for name, pose in poses.items():
        base = name.rpartition("/")[2]
        if base in by_base:
            raise UserError(f"{name}: another query has the same basename {base}, by which the server identifies queries")
        by_base[base] = pose
    path = paths.assign_path(folder, f"Aachen_eval_{method}", ".txt")
    localized = {base: pose for base, pose in by_base.items() if pose is not None}
    lists.write_poses(path, localized)
    return path, len(poses) - len(localized)


def _read_references(root: Path, version: Version | None) -> dict[str, PosedImage]:
    folder = root / "3D-models"
    models = [
        (number, path)
        for number, names in MODELS.items()
        if version in (None, number)
        for path in [next((folder / name for name in names if _is_model(folder / name)), None)]
        if path is not None
    ]
    if not models:
        raise UserError(f"{folder}: no model of Aachen {version or 'v1 or v1.1'}; bench/datasets/aachen.py describes the layout")
    if len(models) > 1:
        raise UserError(f"{folder}: holds models of both versions; give version=v1 or version=v1.1")
    path = models[0][1]
    return colmap_model.read(path) if path.is_dir() else _read_nvm(path)


def _is_model(path: Path) -> bool:
    return path.is_file() if path.suffix == ".nvm" else colmap_model.is_model(path)


def _read_nvm(path: Path) -> dict[str, PosedImage]:
    """Return the poses of an NVM file with the intrinsics beside it."""
    beside = sorted(path.parent.glob(INTRINSICS))
    if len(beside) != 1:
        raise UserError(f"{path.parent}: {len(beside)} files {INTRINSICS} beside {path.name}; expected one")
    cameras = lists.read_intrinsics(beside[0])
    references = {}
    for name, (line, pose) in nvm.read(path).items():
        key = name.removeprefix("./")
        if key not in cameras:
            raise UserError(f"{path}:{line}: {name} has no intrinsics in {beside[0]}")
        references[key] = f"{path}:{line}", cameras[key][1], pose
    return references


def _find_query_list(root: Path, condition: Condition, version: Version | None) -> Path:
    """Return the path of the list of queries of that condition and version."""
    folder, pattern = root / "queries", QUERIES.format(condition)
    candidates = sorted(folder.glob(pattern))
    if not candidates:
        raise UserError(f"{folder / pattern}: no such file")
    if len(candidates) > 1 and version is None:
        names = " and ".join(path.name for path in candidates)
        raise UserError(f"{folder}: holds both {names}; give version=v1 or version=v1.1")
    if len(candidates) > 1:
        candidates = [path for path in candidates if bool(VERSION_1_1.search(path.name)) == (version == "v1.1")]
    if len(candidates) != 1:
        raise UserError(f"{folder / pattern}: not exactly one of these lists is of version {version}")
    return candidates[0]


PLUGIN = Aachen
