"""Scenes are written and read again in both layouts; errors of damaged files name file and line."""

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from fakes import write_scene
from PIL import Image
from scipy.spatial.transform import Rotation

from bench.core.errors import SampleError, UserError
from bench.datasets import aachen, colmap
from bench.formats import lists, nvm, scene_export
from bench.images.scene import Scene, SceneImage
from bench.registry import discovery
from bench.registry.spec import read

LOADERS: dict[str, Callable[[Path], Scene]] = {"aachen": aachen.load, "colmap": colmap.load}


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_scene(tmp_path_factory.mktemp("noise"))


@pytest.fixture(scope="module")
def written(original: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The scene in each layout; tests do not change it."""
    folder = tmp_path_factory.mktemp("layouts")
    for layout in LOADERS:
        scene_export.write(original, layout, folder / layout)
    return {layout: folder / layout for layout in LOADERS}


@pytest.fixture
def copies(written: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """Copies of the layouts, for tests that damage them."""
    return {layout: Path(shutil.copytree(folder, tmp_path / layout)) for layout, folder in written.items()}


def is_same(one: SceneImage, other: SceneImage) -> bool:
    assert one.cam_from_world is not None
    assert other.cam_from_world is not None
    return (
        (one.name, one.condition, one.camera.model) == (other.name, other.condition, other.camera.model)
        and (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
        and np.array_equal(one.camera.params, other.camera.params)
        and np.abs(one.cam_from_world.matrix() - other.cam_from_world.matrix()).max() < 1e-12
        and np.array_equal(one.pixels.read(), other.pixels.read())
    )


def edit(path: Path, line: int, change: Callable[[str], str]) -> None:
    """Change one line of a file; lines count from 1."""
    rows = path.read_text().split("\n")
    rows[line - 1] = change(rows[line - 1])
    path.write_text("\n".join(rows))


def query_list(root: Path, condition: str) -> Path:
    """Return the list of queries of a condition."""
    (path,) = (root / "queries").glob(f"{condition}_*")
    return path


def replace_field(number: int, value: str) -> Callable[[str], str]:
    """Return an edit that replaces a field (counted from 0) by `value`."""

    def change(row: str) -> str:
        parts = row.split(" ")
        parts[number] = value
        return " ".join(parts)

    return change


@pytest.mark.parametrize("layout", LOADERS)
def test_written_scene_is_read_again(layout: str, original: Scene, written: dict[str, Path]) -> None:
    found = LOADERS[layout](written[layout])
    assert len(found.references) == len(original.references)
    for one, other in zip(original.references + original.queries, found.references + found.queries, strict=True):
        assert is_same(one, other)
    assert not is_same(original.queries[0], found.queries[1])  # the comparison can fail
    assert [query.condition for query in found.queries] == ["day", "day", "night", "night"]


def test_plugins_read_the_layouts(written: dict[str, Path]) -> None:
    for layout, folder in written.items():
        assert len(read(f"{layout}:path={folder}", discovery.DATASET).scene().references) == 3


def test_pycolmap_reads_the_same_poses(original: Scene, written: dict[str, Path]) -> None:
    model = pycolmap.Reconstruction(written["colmap"] / "sparse")
    by_name = {image.name: image for image in model.images.values()}
    for reference in original.references:
        found = by_name[reference.name]
        np.testing.assert_allclose(found.cam_from_world().matrix(), reference.cam_from_world.matrix(), atol=1e-12)
        np.testing.assert_array_equal(found.camera.params, reference.camera.params)
    assert len(model.cameras) == 2  # equal intrinsics are one camera


def test_binary_models_and_models_in_a_subfolder_are_read(original: Scene, copies: dict[str, Path]) -> None:
    sparse = copies["colmap"] / "sparse"
    model = pycolmap.Reconstruction(sparse)
    for file in sparse.iterdir():
        file.unlink()
    (sparse / "0").mkdir()
    model.write_binary(sparse / "0")
    found = colmap.load(copies["colmap"])
    assert all(is_same(one, other) for one, other in zip(original.references, found.references, strict=True))
    model.cameras[2].params = [np.nan, 40, 30, 0]
    model.write_binary(sparse / "0")
    with pytest.raises(UserError, match=r"cameras\.bin, camera 2: its intrinsics are not finite"):
        colmap.load(copies["colmap"])
    model.cameras[2].params = [70, 40, 30, 0]
    model.write_binary(sparse / "0")
    (sparse / "0" / "images.bin").write_bytes((sparse / "0" / "images.bin").read_bytes()[:-30])
    with pytest.raises(UserError, match="not a whole COLMAP model"):
        colmap.load(copies["colmap"])


def test_models_without_rigs_are_read(original: Scene, copies: dict[str, Path]) -> None:
    for part in ("rigs", "frames"):
        (copies["colmap"] / "sparse" / f"{part}.txt").unlink()
    assert is_same(original.references[0], colmap.load(copies["colmap"]).references[0])


def test_ground_truth_may_be_a_model_a_list_or_absent(original: Scene, copies: dict[str, Path]) -> None:
    root = copies["colmap"]
    (root / "ground_truth.txt").unlink()
    assert all(query.cam_from_world is None for query in colmap.load(root).queries)
    (root / "ground_truth").mkdir()
    scene_export.build_model(original.queries).write(root / "ground_truth")
    assert all(is_same(one, other) for one, other in zip(original.queries, colmap.load(root).queries, strict=True))


def test_foreground_is_read(copies: dict[str, Path]) -> None:
    mask = np.zeros((64, 80), np.uint8)
    mask[10:20] = 255
    name = "query/day/0.png"
    (copies["colmap"] / "foreground" / name).parent.mkdir(parents=True)
    Image.fromarray(mask).save(copies["colmap"] / "foreground" / name)
    queries = colmap.load(copies["colmap"]).queries
    np.testing.assert_array_equal(queries[0].pixels.foreground(), mask > 0)
    assert queries[1].pixels.foreground() is None


def test_images_are_read_as_stored_and_must_have_the_size_of_the_camera(copies: dict[str, Path]) -> None:
    path = copies["colmap"] / "images" / "db" / "0.png"
    exif = Image.Exif()
    exif[0x0112] = 6  # says: turn me
    before = np.asarray(Image.open(path))
    Image.fromarray(before).save(path, exif=exif)
    found = colmap.load(copies["colmap"]).references[0]
    np.testing.assert_array_equal(found.pixels.read(), before)
    Image.fromarray(before[:50]).save(path)
    with pytest.raises(SampleError, match=r"0\.png: 80 x 50 pixels; its camera says 80 x 64"):
        found.pixels.read()


def test_content_hash_depends_on_content_only(copies: dict[str, Path]) -> None:
    images = colmap.load(copies["colmap"]).references
    before = images[0].pixels.content_hash()
    assert before != images[1].pixels.content_hash()
    shutil.copy(images[1].pixels.path, images[0].pixels.path)
    assert images[0].pixels.content_hash() == images[1].pixels.content_hash() != before


# Damage: the file, its line (None for no line), the edit, and the message.
LISTED = [
    (1, lambda row: row.rpartition(" ")[0], r"SIMPLE_RADIAL has 4 parameters \(f, cx, cy, k\), but 3 are given"),
    (2, lambda row: row + " 0", r"SIMPLE_RADIAL has 4 parameters \(f, cx, cy, k\), but 5 are given"),
    (1, lambda row: row.split()[0], "expected MODEL width height params"),
    (1, replace_field(1, "SIMPLE_RADAIL"), "unknown camera model 'SIMPLE_RADAIL'; did you mean 'SIMPLE_RADIAL'"),
    (1, replace_field(1, "INVALID"), "unknown camera model 'INVALID'"),
    (1, replace_field(2, "80.5"), "width and height must be whole numbers above zero, not 80.5 64"),
    (1, replace_field(3, "0"), "width and height must be whole numbers above zero"),
    (1, replace_field(4, "nan"), "not all of these are finite"),
    (1, replace_field(4, "-75"), "the focal length must be above zero"),
    (1, replace_field(5, "four"), "could not convert string to float: 'four'"),
    (2, replace_field(0, "query/day/0.png"), r"query/day/0\.png occurs a second time; the first is line 1"),
    (1, replace_field(0, "query/day/absent.png"), r"there is no image .*absent\.png"),
    (1, replace_field(0, "db/0.png"), r"db/0\.png is a reference as well"),
    (1, replace_field(0, "../ground_truth.txt"), r"expected a name of a file below .*, without '\.\.'"),
    (1, replace_field(0, "/etc/hostname"), "expected a name of a file below"),
    (1, replace_field(0, "x" * 300), "no name of a file is longer than 255 bytes"),
]
POSES = [
    (1, lambda row: row + " 1", "expected qw qx qy qz tx ty tz, but there are 8 fields"),
    (2, lambda row: row.rpartition(" ")[0], "expected qw qx qy qz tx ty tz, but there are 6 fields"),
    (1, replace_field(5, "inf"), "not all of these are finite"),
    (1, replace_field(1, "2"), "the quaternion .* has norm 2"),
    (3, replace_field(0, "query/day/9.png"), r"query/day/9\.png has a pose but is no query"),
    (3, replace_field(0, "query/day/0.png"), "occurs a second time"),
]


@pytest.mark.parametrize("layout", LOADERS)
@pytest.mark.parametrize(("line", "change", "complaint"), LISTED)
def test_damaged_lists_of_queries_are_refused(
    copies: dict[str, Path], layout: str, line: int, change: Callable, complaint: str
) -> None:
    path = query_list(copies[layout], "day")
    edit(path, line, change)
    with pytest.raises(UserError, match=rf"{re.escape(str(path))}:{line}: .*{complaint}"):
        LOADERS[layout](copies[layout])


@pytest.mark.parametrize("layout", LOADERS)
def test_query_in_both_lists_is_refused(copies: dict[str, Path], layout: str) -> None:
    path = query_list(copies[layout], "night")
    edit(path, 2, replace_field(0, "query/day/0.png"))
    with pytest.raises(UserError, match=rf"{re.escape(str(path))}:2: query/day/0\.png is in another list as well"):
        LOADERS[layout](copies[layout])


@pytest.mark.parametrize(("line", "change", "complaint"), POSES)
def test_damaged_poses_are_refused(copies: dict[str, Path], line: int, change: Callable, complaint: str) -> None:
    path = copies["colmap"] / "ground_truth.txt"
    edit(path, line, change)
    with pytest.raises(UserError, match=rf"{re.escape(str(path))}:{line}: .*{complaint}"):
        colmap.load(copies["colmap"])


@pytest.mark.parametrize(
    ("file", "line", "change", "complaint"),
    [
        ("cameras", 4, replace_field(1, "SIMPLE"), "unknown camera model 'SIMPLE'"),
        ("cameras", 4, lambda row: row.rpartition(" ")[0], "has 4 parameters"),
        ("cameras", 4, replace_field(4, "nan"), "not all of these are finite"),
        ("images", 5, lambda row: row.rpartition(" ")[0], "an image has 10 fields"),
        ("images", 7, replace_field(2, "nan"), "not all of these are finite"),
        ("images", 7, replace_field(1, "3"), "the quaternion .* has norm 3"),
        ("images", 9, replace_field(8, "77"), "there is no camera 77 in .*cameras.txt"),
        ("images", 7, replace_field(9, "db/0.png"), r"db/0\.png is in this model twice"),
        ("images", 5, replace_field(9, "db/absent.png"), r"there is no image .*absent\.png"),
        ("images", 5, replace_field(9, "db/../../ground_truth.txt"), r"expected a name of a file below .*, without '\.\.'"),
    ],
)
def test_damaged_text_models_are_refused(copies: dict[str, Path], file: str, line: int, change: Callable, complaint: str) -> None:
    path = copies["colmap"] / "sparse" / f"{file}.txt"
    edit(path, line, change)
    with pytest.raises(UserError, match=rf"{re.escape(str(path))}:{line}: .*{complaint}"):
        colmap.load(copies["colmap"])


@pytest.mark.parametrize(
    ("line", "change", "complaint"),
    [
        (1, lambda row: "NVM_V2", "begins with NVM_V3"),
        (3, lambda row: "three", "expected the number of cameras, not 'three'"),
        (4, lambda row: row.rpartition(" ")[0], "a camera has 11 fields, but there are 10"),
        (5, replace_field(3, "nan"), "not all of these are finite"),
        (5, replace_field(2, "1.5"), "the quaternion .* has norm"),
        (6, replace_field(0, "db/0.png"), r"db/0\.png occurs a second time; the first is line 4"),
        (6, replace_field(0, "db/9.png"), r"db/9\.png has no intrinsics in"),
    ],
)
def test_damaged_nvm_models_are_refused(copies: dict[str, Path], line: int, change: Callable, complaint: str) -> None:
    path = copies["aachen"] / "3D-models" / "aachen_cvpr2018_db.nvm"
    edit(path, line, change)
    with pytest.raises(UserError, match=rf"{re.escape(str(path))}:{line}: .*{complaint}"):
        aachen.load(copies["aachen"])


def test_nvm_with_too_few_cameras_is_refused(copies: dict[str, Path]) -> None:
    path = copies["aachen"] / "3D-models" / "aachen_cvpr2018_db.nvm"
    edit(path, 3, lambda row: "4")
    with pytest.raises(UserError, match=r"nvm:8: a camera has 11 fields, but there are 1; the header announces 4 cameras"):
        aachen.load(copies["aachen"])


def test_nvm_holds_rotation_and_centre(tmp_path: Path) -> None:
    # By hand: a quarter turn about z takes world x to camera y; the centre (1, 2, 3) is seen at the camera's origin.
    half = np.sqrt(0.5)
    (tmp_path / "a.nvm").write_text(f"NVM_V3 \n\n1\ndb/1.jpg 500 {half} 0 0 {half} 1 2 3 -0.1 0\n\n0\n")
    ((line, pose),) = nvm.read(tmp_path / "a.nvm").values()
    assert line == 4
    np.testing.assert_allclose(pose * np.array([1.0, 2.0, 3.0]), 0, atol=1e-12)
    np.testing.assert_allclose(pose * np.array([2.0, 2.0, 3.0]), [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("layout", LOADERS)
def test_missing_and_binary_files_are_named(copies: dict[str, Path], layout: str) -> None:
    root = copies[layout]
    with pytest.raises(UserError, match=r"absent: no such folder"):
        LOADERS[layout](root / "absent")
    path = query_list(root, "night")
    path.write_text("# nobody\n")
    with pytest.raises(UserError, match=rf"{path.name}: the file is empty"):
        LOADERS[layout](root)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match=rf"{path.name}: not a text file"):
        LOADERS[layout](root)


def test_missing_parts_of_a_colmap_folder(copies: dict[str, Path]) -> None:
    root = copies["colmap"]
    (root / "queries" / "night_queries_with_intrinsics.txt").unlink()
    (root / "ground_truth.txt").unlink()
    assert len(colmap.load(root).queries) == 2  # one list is enough
    (root / "queries" / "day_queries_with_intrinsics.txt").unlink()
    with pytest.raises(UserError, match=r"no list of queries; expected day_queries_with_intrinsics\.txt or night_"):
        colmap.load(root)
    (root / "sparse" / "images.txt").unlink()
    with pytest.raises(UserError, match="no COLMAP model"):
        colmap.load(root)


def test_aachen_needs_both_conditions(copies: dict[str, Path], original: Scene, tmp_path: Path) -> None:
    (copies["aachen"] / "queries" / "night_time_queries_with_intrinsics.txt").unlink()
    with pytest.raises(UserError, match=r"night_time_queries_with_intrinsics\*\.txt: no such file"):
        aachen.load(copies["aachen"])
    by_day = Scene(name="day", references=original.references, queries=original.queries[:2])
    with pytest.raises(UserError, match="--layout aachen: needs queries by day and by night, but has only day"):
        scene_export.write(by_day, "aachen", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_folders_of_aachen_in_both_versions(copies: dict[str, Path], original: Scene) -> None:
    """Version 1.1 as downloaded: a COLMAP model, images one folder deeper, and a longer list of queries by night."""
    root = copies["aachen"]
    (root / "images").mkdir()
    (root / "images_upright").rename(root / "images" / "images_upright")
    later = root / "3D-models" / "aachen_v_1_1"
    later.mkdir()
    scene_export.build_model(original.references[:2]).write_text(later)
    first = root / "queries" / "night_time_queries_with_intrinsics.txt"
    second = root / "queries" / "night_time_queries_with_intrinsics_v1_1.txt"
    with pytest.raises(UserError, match=r"holds models of both versions; give version=v1 or version=v1\.1"):
        aachen.load(root)
    assert len(aachen.load(root, "v1").references) == 3
    assert len(aachen.load(root, "v1.1").references) == 2  # with the one list that is there
    edit(root / "ground_truth.txt", 3, lambda row: "")
    second.write_text(first.read_text().split("\n")[1])
    assert [len(aachen.load(root, version).queries) for version in ("v1", "v1.1")] == [4, 3]
    shutil.rmtree(later)
    with pytest.raises(UserError, match=r"holds both .*intrinsics\.txt and .*_v1_1\.txt; give version="):
        aachen.load(root)
    first.unlink()
    assert len(aachen.load(root).queries) == 3
    with pytest.raises(UserError, match=r"no model of Aachen v1\.1"):
        aachen.load(root, "v1.1")


def test_folders_of_aachen_within_3d_models(copies: dict[str, Path]) -> None:
    models = copies["aachen"] / "3D-models"
    (models / "aachen_v_1").mkdir()
    for path in list(models.glob("*.*")):
        path.rename(models / "aachen_v_1" / path.name)
    assert len(aachen.load(copies["aachen"]).references) == 3
    (models / "aachen_v_1" / "database_intrinsics.txt").unlink()
    with pytest.raises(UserError, match=r"0 files database_intrinsics\*\.txt beside aachen_cvpr2018_db.nvm"):
        aachen.load(copies["aachen"])
    (copies["aachen"] / "images_upright").rename(copies["aachen"] / "pictures")
    with pytest.raises(UserError, match=r"neither images_upright/ nor images/images_upright/"):
        aachen.load(copies["aachen"])


def test_results_are_written_in_the_format_of_the_server(original: Scene, tmp_path: Path) -> None:
    poses = {query.name: query.cam_from_world for query in original.queries} | {"query/day/lost.png": None}
    path, left_out = aachen.write_evaluation(tmp_path, "ldp_10", poses)
    assert path.name == "Aachen_eval_ldp_10.txt"
    assert left_out == 1
    rows = [row.split() for row in path.read_text().splitlines()]
    assert [row[0] for row in rows] == ["0.png", "1.png", "2.png", "3.png"]
    for row, query in zip(rows, original.queries, strict=True):
        w, x, y, z, *translation = map(float, row[1:])
        assert query.cam_from_world is not None
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        np.testing.assert_allclose(rotation, query.cam_from_world.rotation.matrix(), atol=1e-12)
        np.testing.assert_array_equal(translation, query.cam_from_world.translation)
    assert lists.read_poses(path)["0.png"][0] == 1
    with pytest.raises(UserError, match=r"another query has the same basename 0\.png"):
        aachen.write_evaluation(tmp_path, "a", {"a/0.png": None, "b/0.png": None})
    with pytest.raises(UserError, match="only letters, digits"):
        aachen.write_evaluation(tmp_path, "a/b", {})


def test_nothing_is_overwritten(original: Scene, written: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="exists already; give a new folder"):
        scene_export.write(original, "colmap", written["colmap"])
    with pytest.raises(UserError, match="--layout nerf: unknown layout; available: aachen, colmap"):
        scene_export.write(original, "nerf", tmp_path / "x")


@pytest.mark.parametrize("layout", LOADERS)
@pytest.mark.parametrize("name", ["../x.png", "a/../../../x.png", "/srv/x.png"])
def test_no_image_is_written_outside_the_folder(original: Scene, tmp_path: Path, layout: str, name: str) -> None:
    queries = (*original.queries[:-1], dataclasses.replace(original.queries[-1], name=name))
    with pytest.raises(UserError, match="expected a name of a file below"):
        scene_export.write(dataclasses.replace(original, queries=queries), layout, tmp_path / "deep" / "out")
    assert list(tmp_path.iterdir()) == []


def rename(scene: Scene, *names: str) -> Scene:
    """Return the scene with other names of its first references."""
    renamed = (dataclasses.replace(image, name=name) for image, name in zip(scene.references, names, strict=False))
    return dataclasses.replace(scene, references=(*renamed, *scene.references[len(names) :]))


@pytest.mark.parametrize("layout", LOADERS)
def test_images_of_other_formats_are_found_under_the_names_of_their_files(original: Scene, tmp_path: Path, layout: str) -> None:
    """Otherwise a list would name `a.jpg`, which is written as a PNG file, and `a.jpg` would take the file of `a.png`."""
    scene_export.write(rename(original, "db/a.jpg", "db/a.png", "db/b c.JPG"), layout, tmp_path / "out")
    found = LOADERS[layout](tmp_path / "out").references
    assert [image.name for image in found] == ["db/a.jpg.png", "db/a.png", "db/b c.JPG.png"]
    for one, other in zip(original.references, found, strict=True):
        assert np.array_equal(one.pixels.read(), other.pixels.read())


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (("db/" + "x" * 252,), "no name of a file is longer than 255 bytes"),
        (("db/x.jpg", "db/x.jpg.png"), r"db/x\.jpg\.png: two images would need this path"),
        (("db/x", "db/x.png/y.png"), r"db/x\.png: two images would need this path"),
        (("db/x.png", "db//x.png"), r"db//x\.png: two images would need this path"),
    ],
)
def test_images_that_would_need_one_path_are_refused(
    original: Scene, tmp_path: Path, names: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(UserError, match=complaint):
        scene_export.write(rename(original, *names), "colmap", tmp_path / "out")
    assert not (tmp_path / "out").exists()
