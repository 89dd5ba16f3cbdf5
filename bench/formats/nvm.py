"""Cameras of VisualSFM's models (NVM_V3). Points are not read, since they are triangulated again.

A header and the number of cameras come first. Then each camera is a line `name focal qw qx qy qz cx cy cz distortion 0`. The
quaternion is the rotation from world to camera, and cx cy cz is the camera's centre in the world. The focal length and the
distortion are not used: according to Aachen's notes, the intrinsics beside the model are the right ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bench.core.errors import UserError
from bench.formats import lists

if TYPE_CHECKING:
    import pycolmap

FIELDS = 10  # of a camera, after its name


def read(path: Path) -> dict[str, tuple[int, pycolmap.Rigid3d]]:
    """Return name -> (line number, camera from world).

    Raises
    ------
    UserError
        if the file or one of its cameras is malformed.
    """
    import pycolmap

    rows = lists.read_rows(path)
    number, header = next(rows, (1, ""))
    if header.split()[:1] != ["NVM_V3"]:
        raise UserError(f"{path}:{number}: an NVM model begins with NVM_V3")
    number, text = next(rows, (number, ""))
    if (count := lists.parse_whole(text)) is None:
        raise UserError(f"{path}:{number}: expected the number of cameras, not {lists.shorten(text)!r}")
    poses: dict[str, tuple[int, pycolmap.Rigid3d]] = {}
    while len(poses) < count:
        number, text = next(rows, (number, ""))
        where = f"{path}:{number}"
        name, fields = lists.split_name(text, FIELDS) if text else ("", [])
        if len(fields) != FIELDS:
            raise UserError(
                f"{where}: a camera has 11 fields, but there are {len(text.split())}; the header announces {count} cameras"
            )
        if name in poses:
            raise UserError(f"{where}: {name} occurs a second time; the first is line {poses[name][0]}")
        values = lists.parse_numbers(fields, where)
        rotation = lists.parse_rotation(values[1:5], where)
        poses[name] = number, pycolmap.Rigid3d(rotation, -(rotation.matrix() @ values[5:8]))
    number, text = next(rows, (number, "0"))
    if lists.parse_whole(text) is None:
        raise UserError(
            f"{path}:{number}: expected the number of points after the {count} cameras of the header, not {lists.shorten(text)!r}"
        )
    return poses


def write(path: Path, images: Mapping[str, tuple[pycolmap.Camera, pycolmap.Rigid3d]]) -> None:
    """Write cameras and poses, without points. Raises UserError for a name that the file cannot hold."""
    lists.check_names(images)
    rows = ["NVM_V3", "", str(len(images))]
    for name, (camera, pose) in images.items():
        values = [camera.mean_focal_length(), *lists.to_wxyz(pose), *pose.inverse().translation]
        rows.append(f"{name} {' '.join(repr(float(value)) for value in values)} 0 0")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*rows, "", "0", ""]), encoding="utf-8")
