"""Text files of intrinsics and poses, in the formats of localization benchmarks. Errors name file and line.

Intrinsics: `name MODEL width height params...`, with the models and parameters of COLMAP.
Poses: `name qw qx qy qz tx ty tz`, world to camera. Empty lines and lines that begin with # are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from bench.core.errors import UserError, unknown_name

if TYPE_CHECKING:
    import pycolmap

ROUNDING = 1e-3  # tolerated difference of the norm of a quaternion in a file from 1

T = TypeVar("T")


def queries_path(root: Path, condition: str) -> Path:
    """Return the path of the list of queries of one condition in a folder of the layout `colmap`."""
    return root / "queries" / f"{condition}_queries_with_intrinsics.txt"


def read_intrinsics(path: Path) -> dict[str, tuple[int, pycolmap.Camera]]:
    """Return name -> (line number, camera).

    Raises
    ------
    UserError
        if the file or a line is malformed, or a name occurs twice.
    """
    return _read_entries(path, lambda fields, where: parse_camera(fields, where), "name MODEL width height params")


def read_poses(path: Path) -> dict[str, tuple[int, pycolmap.Rigid3d]]:
    """Return name -> (line number, camera from world).

    Raises
    ------
    UserError
        if the file or a line is malformed, or a name occurs twice.
    """
    return _read_entries(path, parse_pose, "name qw qx qy qz tx ty tz")


def write_intrinsics(path: Path, cameras: Mapping[str, pycolmap.Camera]) -> None:
    _write_lines(path, (f"{name} {c.model.name} {c.width} {c.height} {_format_numbers(c.params)}" for name, c in cameras.items()))


def write_poses(path: Path, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """Write poses. `read_poses` returns the same doubles."""
    _write_lines(path, (f"{name} {_format_numbers([*to_wxyz(pose), *pose.translation])}" for name, pose in poses.items()))


def to_wxyz(cam_from_world: pycolmap.Rigid3d) -> np.ndarray:
    """Return the rotation as a quaternion w x y z. -> (4,)"""
    return np.roll(cam_from_world.rotation.quat, 1)


def read_fields(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the fields of each line that is neither empty nor a comment, while reading the file.

    Raises
    ------
    UserError
        if there is no such file, or it is not text.
    """
    for number, line in read_lines(path):
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            yield number, fields


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield all lines with their numbers, from 1; raise UserError if there is no such file, or it is not text."""
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with path.open(encoding="utf-8") as opened:
        try:
            yield from enumerate(opened, 1)
        except UnicodeDecodeError as error:
            raise UserError(f"{path}: not a text file: {error}") from None


def parse_camera(fields: Sequence[str], where: str) -> pycolmap.Camera:
    """Parse MODEL width height params. `where` begins the message of the UserError for malformed fields."""
    import pycolmap

    if len(fields) < 3:
        raise UserError(f"{where}: expected MODEL width height params, not {' '.join(fields)!r}")
    model, width, height = fields[:3]
    models = set(pycolmap.CameraModelId.__members__) - {"INVALID"}
    if model not in models:
        raise UserError(f"{where}: {unknown_name('camera model', model, models)}")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UserError(f"{where}: width and height must be whole numbers above zero, not {width} {height}")
    parsed = pycolmap.Camera.create_from_model_name(1, model, 1.0, int(width), int(height))
    params = parse_numbers(fields[3:], where)
    if len(params) != len(parsed.params):
        raise UserError(
            f"{where}: {model} has {len(parsed.params)} parameters ({parsed.params_info}), but {len(params)} are given"
        )
    parsed.params = params.tolist()
    if not all(params[index] > 0 for index in parsed.focal_length_idxs()):
        raise UserError(f"{where}: the focal length must be above zero, not {' '.join(fields[3:])}")
    return parsed


def parse_pose(fields: Sequence[str], where: str) -> pycolmap.Rigid3d:
    """Parse qw qx qy qz tx ty tz. `where` begins the message of the UserError for malformed fields."""
    import pycolmap

    if len(fields) != 7:
        raise UserError(f"{where}: expected qw qx qy qz tx ty tz, but there are {len(fields)} fields")
    values = parse_numbers(fields, where)
    return pycolmap.Rigid3d(parse_rotation(values[:4], where), values[4:])


def parse_rotation(wxyz: np.ndarray, where: str) -> pycolmap.Rotation3d:
    """Return the rotation of a unit quaternion (4,) w x y z; raise UserError if its norm is not 1."""
    import pycolmap

    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > ROUNDING:
        raise UserError(f"{where}: the quaternion {_format_numbers(wxyz)} has norm {norm:.6g}, not 1")
    return pycolmap.Rotation3d(np.roll(wxyz, -1) / norm)


def parse_numbers(fields: Sequence[str], where: str) -> np.ndarray:
    """Parse finite float64 numbers; raise UserError if one is not finite or not a number."""
    try:
        values = np.array([float(field) for field in fields])
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None
    if not np.isfinite(values).all():
        raise UserError(f"{where}: {' '.join(fields)}: not all of these are finite")
    return values


def _read_entries(path: Path, parse: Callable[[Sequence[str], str], T], layout: str) -> dict[str, tuple[int, T]]:
    entries: dict[str, tuple[int, T]] = {}
    for number, (name, *fields) in read_fields(path):
        where = f"{path}:{number}"
        if name in entries:
            raise UserError(f"{where}: {name} occurs a second time; the first is line {entries[name][0]}")
        entries[name] = number, parse(fields, where)
    if not entries:
        raise UserError(f"{path}: the file is empty; expected lines of {layout}")
    return entries


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _format_numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
