"""COLMAP's sparse models against pycolmap's reader, and damaged ones."""

import contextlib
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from bench.core.errors import UserError
from bench.formats import colmap_model

NAMES = ("db/1.png", "db/2.png", "night/db/1.png")
BINARY_IMAGE = 64  # bytes before an image's name


def build_model(names: tuple[str, ...] = NAMES) -> pycolmap.Reconstruction:
    """Return a model of a rig with two cameras of different types, and images with 0, 1 and 2 points."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    for number, kind in enumerate(("SIMPLE_RADIAL", "OPENCV"), 1):
        model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(number, kind, 70 + number, 80, 64))
    for number, name in enumerate(names, 1):
        points = [pycolmap.Point2D(rng.uniform(0, 60, 2)) for _ in range(number - 1)]
        image = pycolmap.Image(name=name, camera_id=1 + number % 2, image_id=number)
        image.points2D = pycolmap.Point2DList(points)
        rotation = pycolmap.Rotation3d(Rotation.random(random_state=number).as_quat())
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, rng.normal(0, 20, 3)))
    return model


@pytest.fixture
def text(tmp_path: Path) -> Path:
    (tmp_path / "text").mkdir()
    build_model().write_text(tmp_path / "text")
    return tmp_path / "text"


@pytest.fixture
def binary(tmp_path: Path) -> Path:
    (tmp_path / "binary").mkdir()
    build_model().write_binary(tmp_path / "binary")
    return tmp_path / "binary"


def edit(path: Path, change: Callable[[str], str]) -> None:
    before = path.read_text()
    path.write_text(change(before))
    assert path.read_text() != before


@pytest.mark.parametrize("form", ["text", "binary"])
def test_cameras_and_poses_equal_those_of_pycolmap_bit_by_bit(form: str, request: pytest.FixtureRequest) -> None:
    folder = request.getfixturevalue(form)
    found = colmap_model.read(folder)
    model = pycolmap.Reconstruction(folder)  # its images refer to it
    reference = {image.name: image for image in model.images.values()}
    assert found.keys() == reference.keys() == set(NAMES)
    for name, (where, camera, pose) in found.items():
        assert np.array_equal(pose.matrix(), reference[name].cam_from_world().matrix())
        assert (camera.model, camera.width, camera.height) == (reference[name].camera.model, 80, 64)
        assert np.array_equal(camera.params, reference[name].camera.params)
        assert str(folder / "images.") in where


def test_poses_of_rigs_are_complete(tmp_path: Path) -> None:
    """The second camera of a rig has a pose in the rig, which pycolmap composes with the pose of the frame."""
    model, sensors = pycolmap.Reconstruction(), [pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=i) for i in (1, 2)]
    rig, frame = pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, np.sin(0.3), np.cos(0.3)])), [1.0, 2.0, 3.0]))
    for number in (1, 2):
        model.add_camera(pycolmap.Camera.create_from_model_name(number, "PINHOLE", 70, 80, 64))
        frame.add_data_id(pycolmap.data_t(sensor_id=sensors[number - 1], id=number))
    model.add_rig(rig)
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(random_state=0).as_quat()), [4.0, 5.0, 6.0])
    model.add_frame(frame)
    for number in (1, 2):
        image = pycolmap.Image(name=f"{number}.png", camera_id=number, image_id=number)
        image.frame_id = 1
        model.add_image(image)
    model.register_frame(1)
    expected = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    assert np.abs(expected["1.png"] - expected["2.png"]).max() > 0.5
    model.write_text(tmp_path)
    assert all(np.array_equal(pose.matrix(), expected[name]) for name, (_, _, pose) in colmap_model.read(tmp_path).items())
    model.write_binary(tmp_path)
    assert all(np.array_equal(pose.matrix(), expected[name]) for name, (_, _, pose) in colmap_model.read(tmp_path).items())


@pytest.mark.parametrize("form", ["text", "binary"])
def test_names_with_spaces_are_read_whole(tmp_path: Path, form: str) -> None:
    names = ("a b.png", "a  c d.png", "1 2 3.png")
    getattr(build_model(names), f"write_{form}")(tmp_path)
    assert colmap_model.read(tmp_path).keys() == set(names)


def test_rounded_quaternions_are_normalised(text: Path) -> None:
    for name, (_, _, exact) in colmap_model.read(text).items():
        edit(text / "images.txt", lambda content, name=name: round_quaternion(content, name))
        rounded = colmap_model.read(text)[name][2].matrix()[:, :3]
        np.testing.assert_allclose(rounded @ rounded.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(rounded, exact.matrix()[:, :3], atol=1e-3)


def round_quaternion(content: str, name: str) -> str:
    rows = [row.split() for row in content.split("\n")]
    changed = [row[:1] + [f"{float(v):.4f}" for v in row[1:5]] + row[5:] if row[-1:] == [name] else row for row in rows]
    return "\n".join(" ".join(row) for row in changed)


# ---- text


def test_every_image_needs_its_line_of_points(text: Path) -> None:
    """Without these lines COLMAP takes every second image for points, and drops it without a word."""
    edit(
        text / "images.txt", lambda content: "\n".join(row for row in content.split("\n") if len(row.split()) == 10 or "#" in row)
    )
    with contextlib.suppress(ValueError):  # COLMAP 4.0 stops at the name
        assert pycolmap.Reconstruction(text).num_images() < len(NAMES)  # the reference shows the fault
    with pytest.raises(UserError, match=r"images\.txt:6: a line of points .* follows each image's, not '2 "):
        colmap_model.read(text)


@pytest.mark.parametrize("name", ["b.png", "b c.png", "b c d.png", "1 2.png", "b 7"])
def test_an_image_is_never_taken_for_points(text: Path, name: str) -> None:
    (text / "images.txt").write_text(f"1 1 0 0 0 0.5 0 0 1 a.png\n2 1 0 0 0 0.5 0 0 1 {name}\n")
    with pytest.raises(UserError, match=r"images\.txt:2: a line of points"):
        colmap_model.read(text)
    (text / "images.txt").write_text(f"1 1 0 0 0 0.5 0 0 1 a.png\n\n2 1 0 0 0 0.5 0 0 1 {name}")
    assert colmap_model.read(text).keys() == {"a.png", name}


@pytest.mark.parametrize("points", ["1 2", "1 2 3 4", "1 2 x", "1 2 0.5", "1 x 3", f"1 2 {'9' * 5000}"])
def test_damaged_points_are_refused_by_line(text: Path, points: str) -> None:
    (text / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 a.png\n{points}\n")
    with pytest.raises(UserError, match=r"images\.txt:2: a line of points"):
        colmap_model.read(text)


def test_lost_images_are_counted(text: Path) -> None:
    lines = (text / "images.txt").read_text().split("\n")
    (text / "images.txt").write_text("\n".join(lines[:-3]))
    with pytest.raises(UserError, match=r"images\.txt: its comment announces 3 images, but there are 2"):
        colmap_model.read(text)


@pytest.mark.parametrize(
    ("file", "old", "new", "complaint"),
    [
        (
            "cameras",
            "80 64",
            f"{'9' * 5000} 64",
            "cameras.txt:4: width and height must be whole numbers above zero, not 9{60}... 64",
        ),
        ("cameras", "80 64", f"{2**64} 64", "width and height must be whole numbers"),
        ("cameras", "80 64", f"{2**40} 64", "whole numbers above zero and at most 2147483647"),
        ("cameras", "80 64", "٨٠ 64", "width and height must be whole numbers"),
        ("cameras", "\n2 ", "\n1 ", r"cameras\.txt:5: camera 1 occurs a second time"),
        ("images", "db/2.png", "db/1.png", r"images\.txt:7: db/1\.png is in this model twice"),
        ("images", "\n2 ", "\n1 ", r"images\.txt:7: image 1 occurs a second time"),
    ],
)
def test_damaged_text_is_refused_by_line(text: Path, file: str, old: str, new: str, complaint: str) -> None:
    edit(text / f"{file}.txt", lambda content: content.replace(old, new))
    with pytest.raises(UserError, match=complaint):
        colmap_model.read(text)


def test_byte_order_marks_are_ignored(text: Path) -> None:
    """A mark before the first image would otherwise be a part of its number, or hide a comment."""
    expected = colmap_model.read(text)
    for file in text.glob("*.txt"):
        rows = [row for row in file.read_text().split("\n") if not row.startswith("#")]
        file.write_text("\n".join(rows), encoding="utf-8-sig")
    assert colmap_model.read(text).keys() == expected.keys()


# ---- binary


@pytest.mark.parametrize(
    ("file", "offset", "layout", "value", "complaint"),
    [
        ("images", 0, "Q", 2**63, r"images\.bin: not a whole COLMAP model: it ends within image 4 of 9223372036854775808"),
        ("images", 0, "Q", 2, r"images\.bin: not a whole COLMAP model: \d+ bytes follow the 2 entries"),
        ("images", 8 + 60, "I", 9, r"images\.bin, image 1: there is no camera 9 in .*cameras\.bin"),
        ("images", 8 + 4, "d", float("nan"), r"images\.bin, image 1: the pose of db/1\.png is not finite"),
        ("images", 8 + 4, "d", 3.0, r"images\.bin, image 1: the quaternion .* has norm"),
        ("images", 8 + 4, "d", 1e300, r"images\.bin, image 1: the quaternion .* has norm inf, not 1"),
        ("images", 8, "I", 2, r"images\.bin, image 2: occurs a second time"),
        ("images", 8 + BINARY_IMAGE, "B", 255, r"the name of image 1 is not UTF-8"),
        ("images", 8 + BINARY_IMAGE + len("db/1.png") + 1, "Q", 2**61, "it ends within the points of image 1"),
        ("cameras", 0, "Q", 2**64 - 1, r"cameras\.bin: not a whole COLMAP model: it ends within camera 3 of 1844"),
        ("cameras", 8, "I", 2, r"cameras\.bin, camera 2: occurs a second time"),
        ("cameras", 12, "i", 99, r"cameras\.bin, camera \d: 99 is no camera model of COLMAP"),
        ("cameras", 16, "Q", 2**40, "whole numbers above zero and at most 2147483647"),
        ("cameras", 32, "d", -1.0, "the focal length must be above zero"),
    ],
)
def test_damaged_binary_files_are_refused(
    binary: Path, file: str, offset: int, layout: str, value: float, complaint: str
) -> None:
    path = binary / f"{file}.bin"
    content = bytearray(path.read_bytes())
    struct.pack_into(f"<{layout}", content, offset, value)
    path.write_bytes(content)
    with pytest.raises(UserError, match=complaint):
        colmap_model.read(binary)


def test_vast_counts_of_points_cost_nothing(binary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pycolmap allocates and reads as many points as the file announces, which takes minutes."""
    monkeypatch.setattr(pycolmap, "Reconstruction", None)  # a call of it fails this test, and does not block it
    expected = colmap_model.read(binary)
    (binary / "points3D.bin").write_bytes(struct.pack("<Q", 2**62) + b"\0" * 1000)
    assert colmap_model.read(binary).keys() == expected.keys()
