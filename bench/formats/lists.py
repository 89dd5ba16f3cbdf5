"""Text files of intrinsics and poses, as localization benchmarks have them. What does not fit is refused by file and line.

Intrinsics: `name MODEL width height params...`, models and parameters as COLMAP has them.
Poses: `name qw qx qy qz tx ty tz`, world to camera. Lines that are empty or begin with # say nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap

from bench.core.errors import UserError, unknown_name

ROUNDING = 1e-3  # how far the norm of a quaternion in a file may be from one
MODELS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID"})

T = TypeVar("T")


def queries_path(root: Path, condition: str) -> Path:
    """Return the path of the list of queries with intrinsics of one condition, in a folder of the layout `colmap`."""
    return root / "queries" / f"{condition}_queries_with_intrinsics.txt"


def read_intrinsics(path: Path) -> dict[str, tuple[int, pycolmap.Camera]]:
    """Name -> the line's number, and the camera.

    Raises
    ------
    UserError
        if the file or a line of it does not fit, or a name stands twice.
    """
    return _read(path, lambda fields, where: camera(fields, where), "name MODEL width height params")


def read_poses(path: Path) -> dict[str, tuple[int, pycolmap.Rigid3d]]:
    """Name -> the line's number, and camera from world.

    Raises
    ------
    UserError
        if the file or a line of it does not fit, or a name stands twice.
    """
    return _read(path, pose, "name qw qx qy qz tx ty tz")


def write_intrinsics(path: Path, cameras: Mapping[str, pycolmap.Camera]) -> None:
    _write(path, (f"{name} {c.model.name} {c.width} {c.height} {_numbers(c.params)}" for name, c in cameras.items()))


def write_poses(path: Path, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """Numbers are written so that they are read as the same doubles."""
    _write(path, (f"{name} {_numbers([*quaternion(pose), *pose.translation])}" for name, pose in poses.items()))


def quaternion(cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
    """The rotation as w x y z. -> (4,)"""
    return np.roll(cam_from_world.rotation.quat, 1)


def lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The numbers and the fields of all lines that say something, read as they are asked for: models are large.

    Raises
    ------
    UserError
        if there is no such file, or it is no text.
    """
    for number, line in rows(path):
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            yield number, fields


def rows(path: Path) -> Iterator[tuple[int, str]]:
    """All lines with their numbers, from 1; raises UserError if there is no such file, or it is no text."""
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with path.open(encoding="utf-8") as opened:
        try:
            yield from enumerate(opened, 1)
        except UnicodeDecodeError as error:
            raise UserError(f"{path}: not a text file: {error}") from None


def camera(fields: Sequence[str], where: str) -> pycolmap.Camera:
    """MODEL width height params; `where` begins the message of the UserError that is raised if they do not fit."""
    if len(fields) < 3:
        raise UserError(f"{where}: expected MODEL width height params, not {' '.join(fields)!r}")
    model, width, height = fields[:3]
    if model not in MODELS:
        raise UserError(f"{where}: {unknown_name('camera model', model, MODELS)}")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UserError(f"{where}: width and height must be whole numbers above zero, not {width} {height}")
    found = pycolmap.Camera.create_from_model_name(1, model, 1.0, int(width), int(height))
    params = numbers(fields[3:], where)
    if len(params) != len(found.params):
        raise UserError(f"{where}: {model} has {len(found.params)} parameters ({found.params_info}), but {len(params)} are given")
    found.params = params.tolist()
    if not all(params[index] > 0 for index in found.focal_length_idxs()):
        raise UserError(f"{where}: the focal length must be above zero, not {' '.join(fields[3:])}")
    return found


def pose(fields: Sequence[str], where: str) -> pycolmap.Rigid3d:
    """qw qx qy qz tx ty tz; `where` begins the message of the UserError that is raised if they do not fit."""
    if len(fields) != 7:
        raise UserError(f"{where}: expected qw qx qy qz tx ty tz, but there are {len(fields)} fields")
    values = numbers(fields, where)
    return pycolmap.Rigid3d(rotation(values[:4], where), values[4:])


def rotation(wxyz: np.ndarray, where: str) -> pycolmap.Rotation3d:
    """The rotation of a unit quaternion (4,) w x y z; raises UserError if it is not one."""
    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > ROUNDING:
        raise UserError(f"{where}: the quaternion {_numbers(wxyz)} has norm {norm:.6g}, not 1")
    return pycolmap.Rotation3d(np.roll(wxyz, -1) / norm)


def numbers(fields: Sequence[str], where: str) -> np.ndarray:
    """Finite float64 numbers; raises UserError if some are not."""
    try:
        values = np.array([float(field) for field in fields])
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None
    if not np.isfinite(values).all():
        raise UserError(f"{where}: {' '.join(fields)}: not all of these are finite")
    return values


def _read(path: Path, parse: Callable[[Sequence[str], str], T], layout: str) -> dict[str, tuple[int, T]]:
    found: dict[str, tuple[int, T]] = {}
    for number, (name, *fields) in lines(path):
        where = f"{path}:{number}"
        if name in found:
            raise UserError(f"{where}: {name} stands here for the second time; the first is line {found[name][0]}")
        found[name] = number, parse(fields, where)
    if not found:
        raise UserError(f"{path}: nothing in it; expected lines of {layout}")
    return found


def _write(path: Path, rows: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{row}\n" for row in rows), encoding="utf-8")


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
