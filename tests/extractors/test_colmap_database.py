"""Databases of COLMAP 3 and 4, intact and damaged. The files are written by pycolmap."""

import hashlib
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fakes import draw_texture
from PIL import Image

from bench.core.errors import SampleError, UserError
from bench.extractors.colmap_database import ColmapDatabase
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs
from bench.images.photographs import Source
from bench.types import Features

SIDE = 256  # pixels: the square is the whole photograph
KEYPOINTS = np.array([[10, 20], [30, 40], [50, 60]], np.float32)  # from top to bottom
KINDS = pycolmap.FeatureExtractorType


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    draw_texture(0, (SIDE, SIDE)).save(tmp_path / "photos" / "1.png")
    return tmp_path / "photos"


@pytest.fixture
def codes(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(1, 255, (3, 128), dtype=np.uint8)


def write(path: Path, codes: np.ndarray, kind: KINDS = KINDS.SIFT, name: str = "1.png", xy: np.ndarray = KEYPOINTS) -> Path:
    path.parent.mkdir(exist_ok=True)
    with pycolmap.Database.open(path) as database:
        camera = database.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300, SIDE, SIDE))
        number = database.write_image(pycolmap.Image(name=name, camera_id=camera))
        database.write_keypoints(number, xy)
        database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, codes))
    return path


def execute(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as database:
        for statement in statements:
            database.execute(statement)
        database.commit()


def extract(path: Path, root: Path, name: str = "1.png") -> Features:
    return ColmapDatabase(path=path).extract(np.asarray(Image.open(root / name)), Source(name, root / name))


def test_stored_features_are_read(root: Path, tmp_path: Path, codes: np.ndarray) -> None:
    found = extract(write(tmp_path / "a.db", codes), root)
    np.testing.assert_array_equal(found.keypoints, KEYPOINTS)
    np.testing.assert_array_equal(found.codes, codes)
    np.testing.assert_array_equal(found.descriptors, unit_rows(codes))


def test_names_are_compared_whole(root: Path, tmp_path: Path, codes: np.ndarray) -> None:
    """A database that knows `1.png` has no features of `night/1.png`, nor of a link by another name."""
    path = write(tmp_path / "a.db", codes)
    (root / "night").mkdir()
    draw_texture(1, (SIDE, SIDE)).save(root / "night" / "1.png")
    (root / "0.png").symlink_to("1.png")
    for name in ("night/1.png", "0.png"):
        with pytest.raises(
            SampleError, match=rf"^{name}: .*a\.db has no image of that name; names are paths below the image folder"
        ):
            extract(path, root, name)
    write(path, codes[::-1].copy(), name="0.png")
    np.testing.assert_array_equal(extract(path, root, "0.png").codes, codes[::-1])
    np.testing.assert_array_equal(extract(path, root).codes, codes)
    assert [source.name for source in photographs.list_photographs(root)] == ["0.png", "1.png", "night/1.png"]


@pytest.mark.parametrize("kind", [kind for kind in KINDS.__members__.values() if kind != KINDS.SIFT])
def test_descriptors_of_other_types_are_refused_by_name(
    root: Path, tmp_path: Path, rng: np.random.Generator, kind: KINDS
) -> None:
    """32 floats have as many bytes as one SIFT descriptor."""
    floats = rng.normal(size=(3, 32)).astype(np.float32)
    path = write(tmp_path / "a.db", floats.view(np.uint8), kind)
    with pytest.raises(SampleError, match=rf"its descriptors are {kind.name}, and only SIFT is read"):
        extract(path, root)


def test_sift_of_another_length_is_refused(root: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "a.db", np.ones((3, 512), np.uint8))
    with pytest.raises(SampleError, match=r"descriptors \(3, 512\), expected \(N, 2\) and \(N, 128\)"):
        extract(path, root)


def test_databases_of_colmap_3_are_read_and_not_migrated(root: Path, tmp_path: Path, codes: np.ndarray) -> None:
    folder = tmp_path / "old"
    path = write(folder / "a.db", codes)
    execute(path, "ALTER TABLE descriptors DROP COLUMN type", "PRAGMA user_version = 3900")
    before, changed = hashlib.sha256(path.read_bytes()).digest(), folder.stat().st_mtime_ns
    np.testing.assert_array_equal(extract(path, root).codes, codes)
    assert hashlib.sha256(path.read_bytes()).digest() == before
    assert folder.stat().st_mtime_ns == changed  # no file was created beside it, so a read-only folder serves
    assert list(folder.iterdir()) == [path]
    with pycolmap.Database.open(path):
        pass
    assert hashlib.sha256(path.read_bytes()).digest() != before  # the negative control: pycolmap migrates


def test_changes_that_are_not_in_the_file_yet_are_refused(root: Path, tmp_path: Path, codes: np.ndarray) -> None:
    """They would be missing, and the digest in the records is of the file alone."""
    path = write(tmp_path / "a.db", codes)
    with closing(sqlite3.connect(path)) as writer:
        writer.execute("UPDATE images SET name = '2.png'")
        writer.commit()
        with pytest.raises(UserError, match=r"a\.db-wal holds changes that are not in a\.db yet"):
            extract(path, root)
    with pytest.raises(SampleError, match="no image of that name"):
        extract(path, root)


@pytest.mark.parametrize(
    ("statement", "complaint"),
    [
        ("UPDATE keypoints SET data = substr(data, 1, 7)", "the keypoints of it are damaged: 3 x 2 do not match"),
        ("UPDATE descriptors SET rows = 4", "the descriptors of it are damaged: 4 x 128"),
        ("UPDATE descriptors SET rows = 1e18", "the descriptors of it are damaged"),
        (
            "UPDATE keypoints SET rows = 2, data = substr(data, 1, 16)",
            r"keypoints have shape \(2, 2\) and descriptors \(3, 128\)",
        ),
        ("UPDATE keypoints SET cols = -2", "the keypoints of it are damaged"),
        ("UPDATE keypoints SET rows = 0, data = NULL", r"keypoints have shape \(0, 2\)"),
        ("DELETE FROM descriptors", "has no descriptors of it"),
        ("DELETE FROM keypoints", "has no keypoints of it"),
        ("UPDATE cameras SET width = 0", "no camera with a width and a height"),
        ("UPDATE cameras SET width = 'wide'", "no camera with a width and a height"),
        ("DELETE FROM cameras", "no camera with a width and a height"),
        ("UPDATE cameras SET width = 255", "the photograph has"),
        ("DROP TABLE keypoints", "is damaged, or no database of COLMAP: no such table: keypoints"),
    ],
)
def test_damaged_tables_are_explained(root: Path, tmp_path: Path, codes: np.ndarray, statement: str, complaint: str) -> None:
    path = write(tmp_path / "a.db", codes)
    execute(path, statement)
    with pytest.raises(SampleError, match=complaint):
        extract(path, root)


def test_endless_views_are_interrupted(root: Path, tmp_path: Path, codes: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.extractors.colmap_database.MAX_CHECKS", 10)
    path = write(tmp_path / "a.db", codes)
    # A million rows: more than the limit allows, and few enough that a missing limit fails this test and does not block it.
    numbers = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 1000000)"
    endless = f"{numbers} SELECT 1 AS image_id, i AS rows, i AS cols, i AS data FROM n WHERE i < 0"
    execute(path, "DROP TABLE keypoints", f"CREATE VIEW keypoints AS {endless}")
    with pytest.raises(SampleError, match="interrupted"):
        extract(path, root)
