"""Text files of intrinsics and poses, in the formats of localization benchmarks. Errors name file and line.

Intrinsics: `name MODEL width height params...`, with the models and parameters of COLMAP.
Poses: `name qw qx qy qz tx ty tz`, world to camera. Empty lines, lines that begin with #, and a byte order mark are ignored.
A name may contain spaces, since the fields after it are counted from the end of the line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from bench.core.errors import UserError, unknown_name

if TYPE_CHECKING:
    import pycolmap

MAX_SIDE = 2**31 - 1  # pixels
DIGITS = 18  # of a whole number: the most that 64 bits always hold
POSE = 7  # fields of a pose
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
    return _read_entries(path, _split_camera, parse_camera, "name MODEL width height params")


def read_poses(path: Path) -> dict[str, tuple[int, pycolmap.Rigid3d]]:
    """Return name -> (line number, camera from world).

    Raises
    ------
    UserError
        if the file or a line is malformed, or a name occurs twice.
    """
    return _read_entries(path, lambda text: split_name(text, POSE), parse_pose, "name qw qx qy qz tx ty tz")


def write_intrinsics(path: Path, cameras: Mapping[str, pycolmap.Camera]) -> None:
    """Write intrinsics. `read_intrinsics` returns the same ones. Raises UserError for a name that a list cannot hold."""
    check_names(cameras)
    _write_lines(path, (f"{name} {c.model.name} {c.width} {c.height} {_format_numbers(c.params)}" for name, c in cameras.items()))


def write_poses(path: Path, poses: Mapping[str, pycolmap.Rigid3d]) -> None:
    """Write poses. `read_poses` returns the same doubles. Raises UserError for a name that a list cannot hold."""
    check_names(poses)
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
    for number, text in read_rows(path):
        yield number, text.split()


def read_rows(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each line that is neither empty nor a comment, without spaces at its ends.

    Raises
    ------
    UserError
        if there is no such file, or it is not text.
    """
    for number, line in read_lines(path):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def split_name(text: str, count: int) -> tuple[str, list[str]]:
    """Split a line into a name, which may contain spaces, and the `count` fields after it.

    The last word of a name with spaces is no number. If there are other than `count` fields, the name is the first word.

    >>> split_name("a b.png 1 2", 2)
    ('a b.png', ['1', '2'])
    >>> split_name("a.png 1 2 3", 2)
    ('a.png', ['1', '2', '3'])
    """
    name, *fields = text.rsplit(maxsplit=count)
    if len(fields) == count and not _is_number(name.split()[-1]):
        return name, fields
    name, *fields = text.split()
    return name, fields


def is_utf8(name: str) -> bool:
    """Return whether a file name can be written as UTF-8. Python replaces the bytes of other names by surrogates."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def check_names(names: Iterable[str]) -> None:
    """Raise UserError for a name that a list of intrinsics or poses cannot hold, so that it would be read as another one."""
    for name in names:
        is_line = name.splitlines() == [name.strip()] and is_utf8(name)
        if not is_line or name.startswith("#") or split_name(f"{name} 1", 1) != (name, ["1"]):
            raise UserError(f"{name!r}: a list of images cannot hold this name; rename the image")


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield all lines with their numbers, from 1; raise UserError if there is no such file, or it is not text."""
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with path.open(encoding="utf-8-sig") as opened:
        try:
            yield from enumerate(opened, 1)
        except UnicodeDecodeError as error:
            raise UserError(f"{path}: not a text file: {error}") from None


def parse_camera(fields: Sequence[str], where: str) -> pycolmap.Camera:
    """Parse MODEL width height params. `where` begins the message of the UserError for malformed fields."""

    if len(fields) < 3:
        raise UserError(f"{where}: expected MODEL width height params, not {shorten(' '.join(fields))!r}")
    model, width, height = fields[:3]
    models = _list_camera_models()
    if model not in models:
        raise UserError(f"{where}: {unknown_name('camera model', shorten(model), models)}")
    size = parse_whole(width), parse_whole(height)
    if size[0] is None or size[1] is None:
        raise UserError(f"{where}: width and height must be whole numbers above zero, not {shorten(width)} {shorten(height)}")
    return build_camera(model, (size[0], size[1]), parse_numbers(fields[3:], where), where)


def build_camera(model: str, size: tuple[int, int], params: np.ndarray, where: str) -> pycolmap.Camera:
    """Return a camera of a COLMAP model. `where` begins the message of the UserError for impossible values."""
    import pycolmap

    if not all(0 < side <= MAX_SIDE for side in size):
        raise UserError(
            f"{where}: width and height must be whole numbers above zero and at most {MAX_SIDE}, not {size[0]} {size[1]}"
        )
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, *size)
    if len(params) != len(camera.params):
        raise UserError(
            f"{where}: {model} has {len(camera.params)} parameters ({camera.params_info}), but {len(params)} are given"
        )
    camera.params = params.tolist()
    if not all(params[index] > 0 for index in camera.focal_length_idxs()):
        raise UserError(f"{where}: the focal length must be above zero, not {_format_numbers(params)}")
    return camera


def parse_pose(fields: Sequence[str], where: str) -> pycolmap.Rigid3d:
    """Parse qw qx qy qz tx ty tz. `where` begins the message of the UserError for malformed fields."""
    import pycolmap

    if len(fields) != POSE:
        raise UserError(f"{where}: expected qw qx qy qz tx ty tz, but there are {len(fields)} fields")
    values = parse_numbers(fields, where)
    return pycolmap.Rigid3d(parse_rotation(values[:4], where), values[4:])


def parse_rotation(wxyz: np.ndarray, where: str) -> pycolmap.Rotation3d:
    """Return the rotation of a unit quaternion (4,) w x y z; raise UserError if its norm is not 1."""
    import pycolmap

    with np.errstate(over="ignore"):  # then the norm is infinite
        norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > ROUNDING:
        raise UserError(f"{where}: the quaternion {_format_numbers(wxyz)} has norm {norm:.6g}, not 1")
    return pycolmap.Rotation3d(np.roll(wxyz, -1) / norm)


def parse_whole(text: str) -> int | None:
    """Return the whole number, at least zero, that a text of ASCII digits states; None for other texts, or beyond 64 bits."""
    digits = text.lstrip("0") or text[-1:]
    return int(digits) if digits.isascii() and digits.isdecimal() and len(digits) <= DIGITS else None


def shorten(text: str, length: int = 60) -> str:
    """Return a text for a message, cut to `length` characters."""
    return text if len(text) <= length else f"{text[:length]}..."


def parse_numbers(fields: Sequence[str], where: str) -> np.ndarray:
    """Parse finite float64 numbers; raise UserError if one is not finite or not a number."""
    try:
        values = np.array([float(field) for field in fields])
    except ValueError as error:
        raise UserError(f"{where}: {shorten(str(error))}") from None
    if not np.isfinite(values).all():
        raise UserError(f"{where}: {shorten(' '.join(fields))}: not all of these are finite")
    return values


def _read_entries(
    path: Path,
    split: Callable[[str], tuple[str, list[str]]],
    parse: Callable[[Sequence[str], str], T],
    layout: str,
) -> dict[str, tuple[int, T]]:
    entries: dict[str, tuple[int, T]] = {}
    for number, text in read_rows(path):
        name, fields = split(text)
        where = f"{path}:{number}"
        if name in entries:
            raise UserError(f"{where}: {name} occurs a second time; the first is line {entries[name][0]}")
        entries[name] = number, parse(fields, where)
    if not entries:
        raise UserError(f"{path}: the file is empty; expected lines of {layout}")
    return entries


def _split_camera(text: str) -> tuple[str, list[str]]:
    """Split `name MODEL width height params`. The last word that names a model ends the name, since numbers follow it."""
    words, models = text.split(), _list_camera_models()
    indices = [index for index, word in enumerate(words) if index > 0 and word in models]
    count = len(words) - (indices[-1] if indices else 1)
    name, *fields = text.rsplit(maxsplit=count) if count else [text]
    return name, fields


@lru_cache(maxsize=1)
def _list_camera_models() -> frozenset[str]:
    import pycolmap

    return frozenset(pycolmap.CameraModelId.__members__) - {"INVALID"}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _format_numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
