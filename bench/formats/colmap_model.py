"""Cameras and poses of COLMAP's sparse models, as text or binary.

Format: https://colmap.github.io/format.html. Points are not read: maps are triangulated again. The poses of images are complete,
so the rigs and frames of COLMAP 4 are not needed either.

pycolmap's reader is not used. It drops images of a text file without lines of points, cuts names at spaces, needs minutes for a
damaged count of points, and raises errors without a file and a line. It is the reference of the tests.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.core.errors import UserError
from bench.formats import lists

if TYPE_CHECKING:
    import pycolmap

PARTS = ("cameras", "images", "points3D")
IMAGE = "an image has 10 fields (id qw qx qy qz tx ty tz camera name)"
POINTS = "a line of points (x y point, repeated; empty without points) follows each image's"
COUNT = re.compile(r"# Number of images: (\d{1,18})\b")
UNIT = 1e-12  # difference from 1 of the norm of a quaternion that was written in full precision
POINT_BYTES = 24  # x, y, number of the 3D point

PosedImage = tuple[str, "pycolmap.Camera", "pycolmap.Rigid3d"]  # file and line, for messages; intrinsics; camera from world


def is_model(folder: Path) -> bool:
    """Return whether a folder holds a model."""
    return any(_holds(folder, suffix) for suffix in ("bin", "txt"))


def read(folder: Path) -> dict[str, PosedImage]:
    """Return the images of a model, by name. If the folder holds both forms, the binary one is read, as by COLMAP.

    Raises
    ------
    UserError
        if the model is damaged or contains no image; the message names the file and the line or the image.
    """
    if _holds(folder, "bin"):
        images = _read_binary_images(folder / "images.bin", _read_binary_cameras(folder / "cameras.bin"))
    else:
        images = _read_text_images(folder / "images.txt", _read_text_cameras(folder / "cameras.txt"))
    posed: dict[str, PosedImage] = {}
    for name, image in images:
        if name in posed:
            raise UserError(f"{image[0]}: {name} is in this model twice")
        posed[name] = image
    if not posed:
        raise UserError(f"{folder}: no image of this model has a pose")
    return posed


def _holds(folder: Path, suffix: str) -> bool:
    return all((folder / f"{part}.{suffix}").is_file() for part in PARTS)


def _read_text_cameras(path: Path) -> dict[str, pycolmap.Camera]:
    cameras: dict[str, pycolmap.Camera] = {}
    for number, (camera, *fields) in lists.read_fields(path):
        if camera in cameras:
            raise UserError(f"{path}:{number}: camera {camera} occurs a second time")
        cameras[camera] = lists.parse_camera(fields, f"{path}:{number}")
    return cameras


def _read_text_images(path: Path, cameras: dict[str, pycolmap.Camera]) -> Iterator[tuple[str, PosedImage]]:
    lines = lists.read_lines(path)
    identifiers: set[str] = set()
    announced = None
    for number, line in lines:
        where, text = f"{path}:{number}", line.strip()
        if match := COUNT.match(text):
            announced = int(match[1])
        if not text or text.startswith("#"):
            continue
        fields = text.split(maxsplit=9)
        if len(fields) != 10:
            raise UserError(f"{where}: {IMAGE}, but there are {len(fields)}")
        if fields[0] in identifiers:
            raise UserError(f"{where}: image {lists.shorten(fields[0])} occurs a second time")
        identifiers.add(fields[0])
        pose = _build_pose(lists.parse_numbers(fields[1:8], where), where)
        if fields[8] not in cameras:
            raise UserError(f"{where}: there is no camera {lists.shorten(fields[8])} in {path.with_name('cameras.txt')}")
        number, line = next(lines, (number, ""))
        if not _is_points(line):
            raise UserError(f"{path}:{number}: {POINTS}, not {lists.shorten(line.strip())!r}")
        yield fields[9], (where, cameras[fields[8]], pose)
    if announced not in (None, count := len(identifiers)):
        raise UserError(f"{path}: its comment announces {announced} images, but there are {count}; correct or remove the comment")


def _is_points(line: str) -> bool:
    fields = line.split()
    try:
        _ = [float(field) for field in fields], [int(field) for field in fields[2::3]]
    except ValueError:
        return False
    return len(fields) % 3 == 0


class _Binary:
    """A binary file that is read from its beginning to its end. Time and memory are bounded by its size, not by its counts."""

    def __init__(self, path: Path) -> None:
        self._path, self._content, self._offset = path, path.read_bytes(), 0

    def take(self, layout: str, where: str) -> tuple[Any, ...]:
        """Return the values of a little-endian struct."""
        start = self._offset
        self.skip(struct.calcsize(f"<{layout}"), where)
        return struct.unpack_from(f"<{layout}", self._content, start)

    def take_name(self, where: str) -> str:
        """Return a text that ends with a zero byte."""
        start, end = self._offset, self._content.find(b"\0", self._offset)
        self.skip((end if end >= 0 else len(self._content)) + 1 - start, where)
        try:
            return self._content[start:end].decode()
        except UnicodeDecodeError:
            raise UserError(f"{self._path}: the name of {where} is not UTF-8") from None

    def skip(self, size: int, where: str) -> None:
        self._offset += size
        if self._offset > len(self._content):
            raise UserError(f"{self._path}: not a whole COLMAP model: it ends within {where}")

    def finish(self, count: int) -> None:
        """Check that nothing follows the last of `count` entries."""
        if self._offset != len(self._content):
            rest = len(self._content) - self._offset
            raise UserError(f"{self._path}: not a whole COLMAP model: {rest} bytes follow the {count} entries that it announces")


def _read_binary_cameras(path: Path) -> dict[int, pycolmap.Camera]:
    import pycolmap

    models = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    opened = _Binary(path)
    (count,) = opened.take("Q", "its header")
    cameras: dict[int, pycolmap.Camera] = {}
    for index in range(count):
        number, model, width, height = opened.take("IiQQ", f"camera {index + 1} of {count}")
        where = f"{path}, camera {number}"
        if model not in models:
            raise UserError(f"{where}: {model} is no camera model of COLMAP")
        if number in cameras:
            raise UserError(f"{where}: occurs a second time")
        length = len(pycolmap.Camera.create_from_model_name(1, models[model], 1.0, 1, 1).params)
        params = np.array(opened.take(f"{length}d", f"camera {number}"))
        if not np.isfinite(params).all():
            raise UserError(f"{where}: its intrinsics are not finite")
        cameras[number] = lists.build_camera(models[model], (width, height), params, where)
    opened.finish(count)
    return cameras


def _read_binary_images(path: Path, cameras: dict[int, pycolmap.Camera]) -> Iterator[tuple[str, PosedImage]]:
    opened = _Binary(path)
    (count,) = opened.take("Q", "its header")
    numbers: set[int] = set()
    for index in range(count):
        number, *pose, camera = opened.take("I7dI", f"image {index + 1} of {count}")
        where = f"{path}, image {number}"
        name = opened.take_name(f"image {number}")
        (points,) = opened.take("Q", f"image {number}")
        opened.skip(points * POINT_BYTES, f"the points of image {number}")
        if number in numbers:
            raise UserError(f"{where}: occurs a second time")
        numbers.add(number)
        if camera not in cameras:
            raise UserError(f"{where}: there is no camera {camera} in {path.with_name('cameras.bin')}")
        values = np.array(pose)
        if not np.isfinite(values).all():
            raise UserError(f"{where}: the pose of {name} is not finite")
        yield name, (where, cameras[camera], _build_pose(values, where))
    opened.finish(count)


def _build_pose(values: np.ndarray, where: str) -> pycolmap.Rigid3d:
    """Return the pose of qw qx qy qz tx ty tz (7,). A quaternion of norm 1 keeps its bits, as in pycolmap."""
    import pycolmap

    rotation = lists.parse_rotation(values[:4], where)
    if abs(np.linalg.norm(values[:4]) - 1) < UNIT:
        rotation = pycolmap.Rotation3d(np.roll(values[:4], -1))
    return pycolmap.Rigid3d(rotation, values[4:])
