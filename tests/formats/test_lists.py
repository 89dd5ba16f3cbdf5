"""Lists of intrinsics and poses: names with spaces, byte order marks, and numbers of any size."""

from pathlib import Path

import pycolmap
import pytest

from bench.core.errors import UserError
from bench.formats import lists, nvm

CAMERA = "SIMPLE_RADIAL 80 64 70 40 32 0.01"
POSE = "1 0 0 0 1.5 2 3"
NAMES = ("q/1.png", "q 1.png", "a  b c.png", "PINHOLE", "PINHOLE 1.png", "été.png", "1 SIMPLE_RADIAL.png")


@pytest.mark.parametrize("name", NAMES)
def test_names_are_read_whole(tmp_path: Path, name: str) -> None:
    path = tmp_path / "list.txt"
    path.write_text(f"{name} {CAMERA}\n")
    ((found, (line, camera)),) = lists.read_intrinsics(path).items()
    assert (found, line, camera.params.tolist()) == (name, 1, [70, 40, 32, 0.01])
    path.write_text(f"{name} {POSE}\n")
    ((found, (_, pose)),) = lists.read_poses(path).items()
    assert (found, pose.translation.tolist()) == (name, [1.5, 2, 3])
    path.write_text(f"NVM_V3\n1\n{name} 500 {POSE} 0 0\n0\n")
    ((found, (_, pose)),) = nvm.read(path).items()
    assert (found, pose.translation.tolist()) == (name, [-1.5, -2, -3])


@pytest.mark.parametrize("name", NAMES)
def test_names_are_read_as_written(tmp_path: Path, name: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 70, 80, 64)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.0, 1.0]), [1.0, 2.0, 3.0])
    lists.write_intrinsics(tmp_path / "a", {name: camera})
    lists.write_poses(tmp_path / "b", {name: pose})
    nvm.write(tmp_path / "c", {name: (camera, pose)})
    assert [*lists.read_intrinsics(tmp_path / "a"), *lists.read_poses(tmp_path / "b"), *nvm.read(tmp_path / "c")] == [name] * 3


@pytest.mark.parametrize("name", ["", "#1.png", "a\n1.png", " a.png", "a.png ", "a 1", "a\u2028b", "caf\udce9.png"])
def test_names_that_would_be_read_otherwise_are_not_written(tmp_path: Path, name: str) -> None:
    pose = pycolmap.Rigid3d()
    for write in (
        lambda: lists.write_poses(tmp_path / "a", {name: pose}),
        lambda: nvm.write(tmp_path / "a", {name: (pycolmap.Camera.create_from_model_name(1, "PINHOLE", 70, 80, 64), pose)}),
    ):
        with pytest.raises(UserError, match="a list of images cannot hold this name"):
            write()
    assert not (tmp_path / "a").exists()


def test_byte_order_marks_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text(f"q/1.png {CAMERA}\n", encoding="utf-8-sig")
    assert path.read_bytes().startswith(b"\xef\xbb\xbf")
    assert list(lists.read_intrinsics(path)) == ["q/1.png"]
    path.write_text("# a comment\nq/1.png 1 0 0 0 0 0 0", encoding="utf-8-sig")
    assert list(lists.read_poses(path)) == ["q/1.png"]
    path.write_text(f"NVM_V3\n1\na.png 500 {POSE} 0 0\n", encoding="utf-8-sig")
    assert list(nvm.read(path)) == ["a.png"]


LONG = "9" * 5000  # digits: Python refuses to convert more than 4,300


@pytest.mark.parametrize("number", [LONG, str(2**64), str(2**63), str(2**31), "-1", "0", "1_0", "٣", "1e2"])
def test_sizes_beyond_all_limits_are_refused(tmp_path: Path, number: str) -> None:
    path = tmp_path / "list.txt"
    path.write_text(f"a.png PINHOLE {number} 64 70 70 40 32\n")
    with pytest.raises(UserError, match=r"list\.txt:1: width and height must be whole numbers above zero") as caught:
        lists.read_intrinsics(path)
    assert len(str(caught.value)) < 300 + len(str(path))


@pytest.mark.parametrize("number", [LONG, "1e999", "-inf"])
def test_parameters_beyond_float64_are_refused(tmp_path: Path, number: str) -> None:
    path = tmp_path / "list.txt"
    path.write_text(f"a.png PINHOLE 80 64 70 {number} 40 32\n")
    with pytest.raises(UserError, match=r"list\.txt:1: .*: not all of these are finite") as caught:
        lists.read_intrinsics(path)
    assert len(str(caught.value)) < 300 + len(str(path))


@pytest.mark.parametrize("count", [LONG, str(2**64), "-1", "1.0", "٣", "1 1"])
def test_counts_of_nvm_beyond_all_limits_are_refused(tmp_path: Path, count: str) -> None:
    (tmp_path / "a.nvm").write_text(f"NVM_V3\n{count}\na.png 500 {POSE} 0 0\n0\n")
    with pytest.raises(UserError, match=r"a\.nvm:2: expected the number of cameras, not"):
        nvm.read(tmp_path / "a.nvm")


def test_vast_count_of_nvm_ends_with_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.nvm").write_text(f"NVM_V3\n{10**17}\na.png 500 {POSE} 0 0\n")
    with pytest.raises(UserError, match="a camera has 11 fields, but there are 0; the header announces 100000000000000000"):
        nvm.read(tmp_path / "a.nvm")


def test_nvm_with_more_cameras_than_announced_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.nvm").write_text(f"NVM_V3\n1\na.png 500 {POSE} 0 0\nb.png 500 {POSE} 0 0\n0\n")
    with pytest.raises(UserError, match=r"a\.nvm:4: expected the number of points after the 1 cameras"):
        nvm.read(tmp_path / "a.nvm")


def test_extra_numbers_are_no_part_of_a_name(tmp_path: Path) -> None:
    (tmp_path / "a").write_text(f"a.png 7 {POSE}\n")
    with pytest.raises(UserError, match="there are 8 fields"):
        lists.read_poses(tmp_path / "a")
