"""Damaged files of other programs give a right result or one line, never another error, and end soon.

hypothesis changes bytes of whole files. A reader may accept a change that leaves the file valid: its result then has the
properties of any valid file, and for binary models it equals that of pycolmap.
"""

from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
from effort import EFFORT
from fakes import draw_texture
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bench.core.errors import SampleError, UserError
from bench.extractors.colmap_database import ColmapDatabase
from bench.extractors.hloc import Hloc
from bench.formats import colmap_model, lists, nvm, pairs
from bench.images.photographs import Source
from bench.testing import check_extractor

SIDE = 256  # pixels
COUNT = 12  # keypoints
END = timedelta(seconds=20)  # of one example: far beyond any of them, so that only an endless one fails
few = settings(derandomize=EFFORT == 1, database=None, max_examples=100 * EFFORT, deadline=END)

INTERESTING = [b"\xff" * 8, b"\0" * 8, b"9" * 40, b" ", b"\n", b"\xef\xbb\xbf", b"nan", b"-", b"#", b"\x7f" + b"\xff" * 7]
EDITS = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 12), st.binary(max_size=8) | st.sampled_from(INTERESTING)), min_size=1, max_size=4
)


def damage(content: bytes, edits: list[tuple[float, int, bytes]], cut: float) -> bytes:
    """Replace `length` bytes at each position by others, and cut the end off. Positions are fractions of the file."""
    for position, length, replacement in edits:
        start = round(position * len(content))
        content = content[:start] + replacement + content[start + length :]
    return content[: round(cut * len(content))]


damaged = given(edits=EDITS, cut=st.sampled_from([1.0] * 9) | st.floats(0, 1))


def read_or_explain(read: Callable[[], object], file: Path) -> object:
    """Return the result, or None if the reader refuses the file in a message that names it."""
    try:
        return read()
    except (UserError, SampleError) as error:
        message = str(error)
    assert file.name in message or file.parent.name in message
    assert len(message) < 2000
    return None


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


# ---- models


def build_model(folder: Path) -> Path:
    model = pycolmap.Reconstruction()
    for number, kind in enumerate(("SIMPLE_RADIAL", "OPENCV"), 1):
        model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(number, kind, 70, 80, 64))
    for number in range(1, 6):
        image = pycolmap.Image(name=f"db/{number}.png", camera_id=1 + number % 2, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.5, 2.5])) for _ in range(number % 3)])
        rotation = pycolmap.Rotation3d(Rotation.random(random_state=number).as_quat())
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.array([1.0, 2.0, 3.0])))
    for form in ("text", "binary"):
        (folder / form).mkdir(parents=True)
        getattr(model, f"write_{form}")(folder / form)
        for part in ("rigs", "frames"):
            (folder / form / f"{part}.{'txt' if form == 'text' else 'bin'}").unlink()
    return folder


def check_images(images: object) -> None:
    assert isinstance(images, dict)
    for name, (_, camera, pose) in images.items():
        assert name
        assert camera.width > 0
        assert np.isfinite(camera.params).all()
        np.testing.assert_allclose(pose.matrix()[:, :3] @ pose.matrix()[:, :3].T, np.eye(3), atol=1e-9)
        assert np.isfinite(pose.translation).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "file", ["text/cameras.txt", "text/images.txt", "binary/cameras.bin", "binary/images.bin", "binary/points3D.bin"]
)
def test_models(folder: Path, file: str) -> None:
    path = build_model(folder / Path(file).name) / file
    whole, accepted = path.read_bytes(), []

    @few
    @damaged
    def check(edits: list[tuple[float, int, bytes]], cut: float) -> None:
        path.write_bytes(damage(whole, edits, cut))
        found = read_or_explain(partial(colmap_model.read, path.parent), path)
        accepted.append(found is not None)
        if found is not None:
            check_images(found)

    check()
    assert not all(accepted) or file.endswith("points3D.bin")  # points are not read
    path.write_bytes(whole)
    assert len(colmap_model.read(path.parent)) == 5


@pytest.mark.slow
def test_accepted_binary_images_equal_those_of_pycolmap(folder: Path) -> None:
    path = build_model(folder / "compared") / "binary" / "images.bin"
    whole, compared = path.read_bytes(), []

    @few
    @given(position=st.integers(0, len(whole) - 1), bit=st.integers(0, 7))
    def check(position: int, bit: int) -> None:
        content = bytearray(whole)
        content[position] ^= 1 << bit
        path.write_bytes(content)
        found = read_or_explain(partial(colmap_model.read, path.parent), path)
        if not isinstance(found, dict):
            return
        model = pycolmap.Reconstruction(path.parent)  # its images refer to it
        reference = {image.name: image for image in model.images.values()}
        assert found.keys() == reference.keys()
        for name, (_, camera, pose) in found.items():
            np.testing.assert_allclose(pose.translation, reference[name].cam_from_world().translation, rtol=0, atol=0)
            np.testing.assert_allclose(pose.matrix(), reference[name].cam_from_world().matrix(), atol=1e-2)
            assert np.array_equal(camera.params, reference[name].camera.params)
        compared.append(position)

    check()
    assert len(compared) > 10


# ---- lists

POSE = "0.5 0.5 0.5 0.5 1.5 2 3"
LISTS: dict[str, tuple[Callable[[Path], dict], str]] = {
    "intrinsics": (lists.read_intrinsics, "".join(f"q/{i}.png SIMPLE_RADIAL 80 64 70.5 40 32 0.01\n" for i in range(6))),
    "poses": (lists.read_poses, "".join(f"q/{i}.png {POSE}\n" for i in range(6))),
    "nvm": (nvm.read, "NVM_V3\n\n6\n" + "".join(f"db/{i}.jpg 500 {POSE} 0 0\n" for i in range(6)) + "\n0\n"),
    "pairs": (pairs.read, "".join(f"q/{i}.png db/{i}.png\n" for i in range(6))),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", LISTS)
def test_lists(folder: Path, kind: str) -> None:
    read, text = LISTS[kind]
    path, accepted = folder / f"{kind}.txt", []

    @few
    @damaged
    def check(edits: list[tuple[float, int, bytes]], cut: float) -> None:
        path.write_bytes(damage(text.encode(), edits, cut))
        found = read_or_explain(partial(read, path), path)
        accepted.append(found is not None)
        for name, entry in found.items() if isinstance(found, dict) else ():
            assert name == name.strip()
            assert kind == "pairs" or 0 < entry[0] <= path.read_bytes().count(b"\n") + path.read_bytes().count(b"\r") + 1

    check()
    assert not all(accepted)
    path.write_text(text)
    assert len(read(path)) == 6


@pytest.mark.slow
@few
@given(name=st.text())
def test_names_are_read_as_written_or_refused(folder: Path, name: str) -> None:
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d([0.0, 0.0, 0.0, 1.0]), [1.0, 2.0, 3.0])
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 70, 80, 64)
    path = folder / "names.txt"
    try:
        lists.check_names([name])
    except UserError:
        return
    lists.write_poses(path, {name: pose})
    assert list(lists.read_poses(path)) == [name]
    lists.write_intrinsics(path, {name: camera})
    assert list(lists.read_intrinsics(path)) == [name]
    nvm.write(path, {name: (camera, pose)})
    assert list(nvm.read(path)) == [name]


# ---- stored features


def write_hloc(path: Path, **options: object) -> None:
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as opened:
        group = opened.create_group("a.png")
        group.create_dataset("keypoints", data=rng.uniform(0, SIDE - 1, (COUNT, 2)).astype(np.float32), **options)
        group.create_dataset("descriptors", data=rng.random((128, COUNT)).astype(np.float16), **options)
        group.create_dataset("image_size", data=np.array([SIDE, SIDE]))


def write_database(path: Path) -> None:
    rng = np.random.default_rng(0)
    with pycolmap.Database.open(path) as database:
        camera = database.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300, SIDE, SIDE))
        number = database.write_image(pycolmap.Image(name="a.png", camera_id=camera))
        codes = rng.integers(1, 255, (COUNT, 128), dtype=np.uint8)
        database.write_keypoints(number, rng.uniform(0, SIDE - 1, (COUNT, 2)).astype(np.float32))
        database.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, codes))


STORED = {
    "plain.h5": (write_hloc, Hloc),
    "packed.h5": (partial(write_hloc, compression="gzip"), Hloc),
    "database.db": (write_database, ColmapDatabase),
}


@pytest.mark.slow
@pytest.mark.parametrize("file", STORED)
def test_stored_features(folder: Path, file: str) -> None:
    """No damage of the user's file is an error of the plugin."""
    path, photograph = folder / file, folder / "a.png"
    picture = draw_texture(0, (SIDE, SIDE))
    picture.save(photograph)
    write, extractor = STORED[file]
    write(path)
    whole, pixels, source, accepted = path.read_bytes(), np.asarray(picture), Source("a.png", photograph), []

    def extract() -> bool:
        check_extractor(extractor(path=path), pixels, source)
        return True

    @few
    @damaged
    def check(edits: list[tuple[float, int, bytes]], cut: float) -> None:
        path.write_bytes(damage(whole, edits, cut))
        accepted.append(read_or_explain(extract, path) is not None)

    check()
    assert not all(accepted)
    path.write_bytes(whole)
    assert extract()
