"""Exchange with hloc, COLMAP, kornia and TensorBoard; the folders of MegaDepth and HPatches."""

import builtins
import os
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap
import pytest
import torch
from fakes import draw_texture, write_album, write_scene
from PIL import Image
from PIL import features as image_features

from bench import cli, load_records
from bench.codebook.examples import write_dictionary
from bench.core.errors import SampleError, UserError
from bench.extractors.colmap_database import ColmapDatabase
from bench.extractors.hardnet import WEIGHTS, HardNet
from bench.extractors.hloc import Hloc
from bench.extractors.sift import Sift
from bench.formats import colmap_model, scene_export
from bench.formats import pairs as hloc_pairs
from bench.formats.stored_features import map_into_square, map_out_of_square
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.scene import File
from bench.testing import check_extractor

kornia = pytest.importorskip("kornia")


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Photographs that are not square, in folders."""
    root = tmp_path / "photos"
    for number, name in enumerate(("street/a.png", "b.png")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        draw_texture(number, (300 + number, 200)).save(root / name)
    return root


def export(*arguments: object) -> int:
    return cli.main(["export", *map(str, arguments)])


# ---- coordinates


def test_map_into_the_square_and_back(rng: np.random.Generator) -> None:
    points = rng.uniform(0, 300, (20, 2))
    for size in ((300, 200), (201, 300), (64, 64)):
        np.testing.assert_allclose(map_out_of_square(map_into_square(points, size, 256), size, 256), points)


# ---- hloc


def test_features_exported_to_hloc_are_read_again(images: Path, tmp_path: Path) -> None:
    out, pairs = tmp_path / "features.h5", tmp_path / "pairs.txt"
    assert export("--images", images, "--layout", "hloc", "--out", out, "--pairs", pairs) == 0
    path = images / "street" / "a.png"
    pixels = photographs.read(path).pixels
    ours, back = Sift().extract(pixels), Hloc(path=out).extract(pixels, Source("street/a.png", path))
    np.testing.assert_allclose(back.keypoints, ours.keypoints, atol=1e-3)
    np.testing.assert_allclose(back.descriptors, ours.descriptors, atol=1e-6)
    with h5py.File(out) as opened:
        group = opened["street/a.png"]
        assert group["descriptors"].shape == (128, len(ours))
        assert group["image_size"][()].tolist() == [300, 200]
        xy = group["keypoints"][()]  # of the photograph, the centre of the first pixel at (0, 0)
    np.testing.assert_allclose(xy, ours.keypoints * (200 / 256) + [50, 0] - 0.5, atol=1e-3)
    assert hloc_pairs.read(pairs) == {"b.png": ["street/a.png"]}


@pytest.mark.slow
def test_word_sets_export_all_candidates_and_subspaces_export_recovered_descriptors(
    images: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ldp = f"ldp:epsilon=inf,subset_size=3,dictionary={write_dictionary(tmp_path)}"
    out = tmp_path / "sets.h5"
    assert export("--images", images, "--defense", ldp, "--layout", "hloc", "--out", out) == 0
    count = len(Sift().extract(photographs.read(images / "b.png").pixels))
    with h5py.File(out) as opened:
        xy = opened["b.png"]["keypoints"][()]
    assert len(xy) == 3 * count
    assert np.array_equal(xy[0::3], xy[1::3])
    affine = f"affine:dim=2,sub_databases=1,database={write_dictionary(tmp_path)}"
    assert export("--images", images, "--defense", affine, "--layout", "hloc", "--out", tmp_path / "x.h5") == 2
    assert "a release of Subspaces has no descriptors; give --attack to export recovered ones" in capfd.readouterr().err
    nearest = f"nearest:database={write_dictionary(tmp_path, seed=2)}"
    recovered = tmp_path / "recovered.h5"
    assert export("--images", images, "--defense", affine, "--attack", nearest, "--layout", "hloc", "--out", recovered) == 0
    with h5py.File(recovered) as opened:
        rows = opened["b.png"]["descriptors"][()].T
    assert rows.shape == (count, 128)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)


def test_invalid_arguments_of_export(images: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for arguments, complaint in (
        (("--layout", "hlco", "--out", tmp_path / "x"), "--layout hlco: unknown layout; available: hloc, colmap"),
        (("--layout", "hloc", "--out", images / "b.png"), "exists already"),
        (("--layout", "hloc", "--out", tmp_path / "x", "--attack", "nearest"), "nearest attacks Subspaces"),
        (("--layout", "hloc", "--out", tmp_path / "x", "--dataset", "gallery"), "give --images with a folder"),
        (("--layout", "hloc", "--out", tmp_path / "x", "--model", tmp_path / "m"), "photographs have no poses; give --dataset"),
        (("--layout", "hloc", "--out", tmp_path / "x", "--camera-mode", "auto"), "--layout hloc has no cameras"),
        (("--layout", "colmap", "--out", tmp_path / "x", "--camera-mode", "same"), "available: auto, single, per_folder, per_im"),
        (("--layout", "colmap", "--out", tmp_path / "x", "--camera-mode", "single"), "or its size is not that of its camera"),
    ):
        assert export("--images", images, *arguments) == 2
        assert complaint in capfd.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["hloc", "colmap"])
def test_pairs_are_refused_before_anything_is_written(
    images: Path, tmp_path: Path, layout: str, capfd: pytest.CaptureFixture[str]
) -> None:
    out, pairs = tmp_path / "out", tmp_path / "pairs.txt"
    (images / "b.png").rename(images / "b c.png")
    assert export("--images", images, "--layout", layout, "--out", out, "--pairs", pairs) == 2
    assert "'b c.png': a list of pairs cannot hold a name with a space in it" in capfd.readouterr().err
    assert export("--images", images, "--layout", layout, "--out", out, "--pairs", out) == 2
    assert "the same file as --out" in capfd.readouterr().err
    assert not out.exists()
    assert not pairs.exists()
    assert export("--images", images, "--layout", layout, "--out", out) == 0  # without a list the name is allowed
    path = images / "b c.png"
    back = (Hloc if layout == "hloc" else ColmapDatabase)(path=out).extract(
        photographs.read(path).pixels, Source("b c.png", path)
    )
    assert len(back) == len(Sift().extract(photographs.read(path).pixels))


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["hloc", "colmap"])
def test_names_that_are_not_utf8_fail_alone(images: Path, tmp_path: Path, layout: str, capfd: pytest.CaptureFixture[str]) -> None:
    (images / "b.png").rename(Path(os.fsdecode(os.fsencode(images) + b"/caf\xe9.png")))
    out, pairs = tmp_path / "out", tmp_path / "pairs.txt"
    assert export("--images", images, "--layout", layout, "--out", out, "--pairs", pairs) == 1
    assert r"'caf\udce9.png': this name is not UTF-8; rename the file" in capfd.readouterr().err
    path = images / "street" / "a.png"
    back = (Hloc if layout == "hloc" else ColmapDatabase)(path=out).extract(
        photographs.read(path).pixels, Source("street/a.png", path)
    )
    assert len(back) == len(Sift().extract(photographs.read(path).pixels))
    with pytest.raises(SampleError, match="this name is not UTF-8"):
        (Hloc if layout == "hloc" else ColmapDatabase)(path=out).extract(
            photographs.read(path).pixels, Source("caf\udce9.png", path)
        )


@pytest.mark.slow
@pytest.mark.skipif(not image_features.check("avif"), reason="this Pillow cannot write AVIF")
def test_images_that_colmap_cannot_read_leave_no_database(
    images: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    draw_texture(0, (300, 200)).save(images / "c.avif")
    assert export("--images", images, "--layout", "colmap", "--out", tmp_path / "out.db") == 2
    assert "c.avif: COLMAP cannot read this image; convert it to PNG or JPEG" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == [images]


@pytest.mark.parametrize("half", [True, False])
def test_the_precision_that_hloc_lost_is_noted(images: Path, tmp_path: Path, half: bool) -> None:
    out = tmp_path / "features.h5"
    assert export("--images", images, "--layout", "hloc", "--out", out) == 0
    source = Source("b.png", images / "b.png")
    assert Hloc(path=out).list_notes(source) == ()
    assert Hloc(path=out).list_notes(None) == ()
    with h5py.File(out, "a") as opened:
        exact = {name: opened["b.png"][name][()] for name in ("keypoints", "descriptors")}
        for name, array in exact.items():
            del opened["b.png"][name]
            opened["b.png"][name] = array.astype(np.float16) if half or name == "descriptors" else array
    (note,) = Hloc(path=out).list_notes(source)
    assert note.startswith("b.png: hloc stored 16-bit floats, which changed ")
    lost = {name: np.abs(array.astype(np.float16).astype(np.float64) - array) for name, array in exact.items()}
    stated = [float(number) for number in re.findall(r"by up to (\S+)", note)]
    if half:
        assert lost["keypoints"].max() <= stated[0] <= 2 * lost["keypoints"].max()
    assert len(stated) == 1 + half
    change = np.linalg.norm(lost["descriptors"], axis=0).max()  # descriptors have norm 1
    assert change <= stated[-1] <= 3 * change


@pytest.mark.slow
def test_records_hold_the_note_on_precision(images: Path, tmp_path: Path) -> None:
    out, run = tmp_path / "features.h5", tmp_path / "run"
    assert export("--images", images, "--layout", "hloc", "--out", out) == 0
    with h5py.File(out, "a") as opened:
        rows = opened["b.png"]["descriptors"][()]
        del opened["b.png"]["descriptors"]
        opened["b.png"]["descriptors"] = rows.astype(np.float16)
    arguments = ["run", "--defense", "none", "--attack", "blank", "--extractor", f"hloc:path={out}", "--images", str(images)]
    assert cli.main([*arguments, "--out", str(run)]) == 0
    notes = {record["sample"]: record["notes"] for record in load_records(run).to_dict("records")}
    assert any("16-bit floats" in note for note in notes["b.png"])
    assert not any("16-bit floats" in note for note in notes["street/a.png"])


# ---- whole images


def test_keypoints_of_full_images_are_those_of_the_stored_pixels(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "features.h5"
    assert export("--images", images, "--full-images", "--layout", "hloc", "--out", out) == 0
    path = images / "street" / "a.png"
    pixels = np.asarray(Image.open(path))
    ours = Sift().extract(pixels)
    with h5py.File(out) as opened:
        group = opened["street/a.png"]
        np.testing.assert_allclose(group["keypoints"][()], ours.keypoints - 0.5, atol=1e-5)
        np.testing.assert_allclose(group["descriptors"][()].T, ours.descriptors, atol=1e-6)
        assert group["image_size"][()].tolist() == [300, 200]
    assert ours.keypoints[:, 0].min() < 50  # left of the central square
    assert ours.keypoints[:, 0].max() > 250
    stored = [Hloc(path=out)]
    assert export("--images", images, "--full-images", "--layout", "colmap", "--out", tmp_path / "x.db") == 0
    stored.append(ColmapDatabase(path=tmp_path / "x.db"))
    for extractor in stored:  # an image of a scene is read whole, too
        back = extractor.extract(File(path=path, size=(300, 200)).read(), Source("street/a.png", path))
        assert back.size == (300, 200)
        np.testing.assert_allclose(back.keypoints, ours.keypoints, atol=1e-4)


def measure_offset(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the median difference of keypoints that are nearest to each other, within a pixel. (N, 2), (M, 2) -> (2,)"""
    distances = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    nearest = distances.argmin(axis=1)
    close = distances.min(axis=1) < 1
    assert close.sum() > 50
    return np.asarray(np.median(ours[close] - theirs[nearest[close]], axis=0))


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--full-images",)], ids=["square", "full"])
def test_keypoints_agree_with_those_of_colmap(tmp_path: Path, more: tuple[str, ...]) -> None:
    """COLMAP's own SIFT finds the same points of the stored image, without an offset of half a pixel."""
    root = tmp_path / "photos"
    root.mkdir()
    draw_texture(3, (400, 256)).save(root / "a.png")
    assert export("--images", root, *more, "--layout", "colmap", "--out", tmp_path / "ours.db") == 0
    pycolmap.extract_features(tmp_path / "theirs.db", root, device=pycolmap.Device.cpu)
    found = []
    for path in (tmp_path / "ours.db", tmp_path / "theirs.db"):
        with pycolmap.Database.open(path) as database:
            found.append(database.read_keypoints(database.read_image_with_name("a.png").image_id)[:, :2])
    ours, theirs = found
    assert (ours[:, 0].max() - ours[:, 0].min() > 300) == bool(more)
    assert np.abs(measure_offset(ours, theirs)).max() < 0.1
    assert np.abs(measure_offset(ours - 0.5, theirs)).max() > 0.3  # the negative control: hloc's convention


# ---- datasets and models


def test_a_dataset_is_exported_with_its_model(tmp_path: Path) -> None:
    """The references as a server holds them, the queries as the defense releases them, and the poses as pycolmap reads them."""
    scene = write_scene(tmp_path / "noise", references=5, queries=4)
    scene_export.write(scene, "colmap", tmp_path / "scene")
    dataset, ldp = f"colmap:path={tmp_path / 'scene'}", f"ldp:epsilon=inf,subset_size=3,dictionary={write_dictionary(tmp_path)}"
    out, model = tmp_path / "features.h5", tmp_path / "model"
    assert export("--dataset", dataset, "--defense", ldp, "--layout", "hloc", "--out", out, "--model", model) == 0
    with h5py.File(out) as opened:
        for image in (*scene.references, *scene.queries):
            raw = Sift().extract(image.pixels.read())
            xy = opened[image.name]["keypoints"][()]
            copies = 1 if image in scene.references else 3
            np.testing.assert_allclose(xy[::copies], raw.keypoints - 0.5, atol=1e-5)
            assert len(xy) == copies * len(raw)
    found = pycolmap.Reconstruction(model)  # COLMAP's reader
    assert (found.num_points3D(), found.num_reg_images()) == (0, 5)
    posed = {image.name: image for image in found.images.values()}
    ours = colmap_model.read(model)
    assert posed.keys() == ours.keys() == {reference.name for reference in scene.references}
    for reference in scene.references:
        image = posed[reference.name]
        assert image.camera.model == reference.camera.model
        assert np.array_equal(image.camera.params, reference.camera.params)
        assert np.array_equal(image.cam_from_world().matrix(), reference.cam_from_world.matrix())
        assert np.array_equal(ours[reference.name][2].matrix(), reference.cam_from_world.matrix())
    assert export("--dataset", dataset, "--layout", "hloc", "--out", tmp_path / "again.h5", "--model", model) == 2


@pytest.mark.slow
def test_rendered_images_are_no_files_for_colmap(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    small = "gallery:views=1,queries=1,rooms=1,width=64,height=48,detail=0.1"
    assert export("--dataset", small, "--layout", "colmap", "--out", tmp_path / "x.db") == 2
    assert "write a rendered dataset by `bench dataset` first" in capfd.readouterr().err


# ---- COLMAP


def test_exported_database_is_read_by_colmap_and_by_us(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "database.db"
    assert export("--images", images, "--layout", "colmap", "--out", out) == 0
    path = images / "street" / "a.png"
    pixels = photographs.read(path).pixels
    ours = Sift().extract(pixels)
    with pycolmap.Database.open(out) as database:
        image = database.read_image_with_name("street/a.png")
        camera = database.read_camera(image.camera_id)
        xy = database.read_keypoints(image.image_id)
        assert database.num_frames() == database.num_images() == 2  # as its incremental mapper wants them
    assert (camera.width, camera.height) == (300, 200)
    np.testing.assert_allclose(xy[:, :2], ours.keypoints * (200 / 256) + [50, 0], atol=1e-3)
    back = ColmapDatabase(path=out).extract(pixels, Source("street/a.png", path))
    np.testing.assert_allclose(back.keypoints, ours.keypoints, atol=1e-3)
    assert back.codes is not None
    assert ours.codes is not None
    np.testing.assert_allclose(back.codes.astype(int), ours.codes.astype(int), atol=2)  # SIFT's norm is 512 but for rounding
    check_extractor(ColmapDatabase(path=out), pixels, Source("street/a.png", path))


def list_cameras(path: Path) -> set[frozenset[str]]:
    """Return the names of the images that share a camera, for each camera of a database."""
    with pycolmap.Database.open(path) as database:
        images = database.read_all_images()
    return {frozenset(image.name for image in images if image.camera_id == camera) for camera in {i.camera_id for i in images}}


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "count"), [("auto", 3), ("single", 1), ("per_folder", 2), ("per_image", 3), (None, 3)])
def test_cameras_are_shared_as_by_colmap(tmp_path: Path, mode: str | None, count: int) -> None:
    """COLMAP's feature extractor, which reads its cameras by itself, gives the reference."""
    root = tmp_path / "photos"
    for number, name in enumerate(("a/1.png", "a/2.png", "b/3.png")):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        draw_texture(number, (300, 200)).save(root / name)
    more = () if mode is None else ("--camera-mode", mode)
    assert export("--images", root, "--layout", "colmap", "--out", tmp_path / "ours.db", *more) == 0
    reference = pycolmap.CameraMode.__members__[(mode or "per_image").upper()]
    pycolmap.extract_features(tmp_path / "theirs.db", root, camera_mode=reference, device=pycolmap.Device.cpu)
    ours = list_cameras(tmp_path / "ours.db")
    assert ours == list_cameras(tmp_path / "theirs.db")
    assert len(ours) == count


@pytest.mark.parametrize("sign", [1, -1])
def test_signed_descriptors_are_not_exported_to_colmap(
    images: Path, tmp_path: Path, rng: np.random.Generator, capfd: pytest.CaptureFixture[str], sign: int
) -> None:
    """A database would hold zeros in place of their negative components."""
    rows = unit_rows(rng.random((1, 128), np.float32))
    rows[0, 0] *= sign
    with h5py.File(tmp_path / "features.h5", "w") as opened:
        for name in ("street/a.png", "b.png"):
            group = opened.create_group(name)
            group["keypoints"], group["descriptors"] = np.array([[150.0, 100.0]]), rows.T
            group["image_size"] = np.array([300 + (name == "b.png"), 200])
    out = tmp_path / "database.db"
    code = export("--images", images, "--extractor", f"hloc:path={tmp_path / 'features.h5'}", "--layout", "colmap", "--out", out)
    error = capfd.readouterr().err
    assert (code, out.exists()) == ((0, True) if sign == 1 else (2, False))
    assert ("descriptors have negative components" in error) == (sign == -1)


def test_features_of_colmap_are_read(tmp_path: Path) -> None:
    """The file is written by COLMAP's own SIFT."""
    root = write_album(tmp_path / "photos", 1)
    draw_texture(5, (256, 256)).save(root / "0.png")
    out = tmp_path / "database.db"
    pycolmap.extract_features(out, root, device=pycolmap.Device.cpu)
    path = root / "0.png"
    found = ColmapDatabase(path=out).extract(photographs.read(path).pixels, Source("0.png", path))
    with pycolmap.Database.open(out) as database:
        image = database.read_image_with_name("0.png")
        assert len(found) == database.num_keypoints_for_image(image.image_id)
        xy = database.read_keypoints(image.image_id)[:, :2]
    np.testing.assert_allclose(found.keypoints, xy[np.lexsort((xy[:, 0], xy[:, 1]))], atol=1e-4)


def test_unusable_databases(images: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        ColmapDatabase(path=tmp_path / "absent.db")
    with pytest.raises(UserError, match="not a COLMAP database"):
        ColmapDatabase(path=images / "b.png")
    out = tmp_path / "database.db"
    assert export("--images", images, "--layout", "colmap", "--out", out) == 0
    unrelated = tmp_path / "unrelated.png"
    draw_texture(9, (300, 200)).save(unrelated)
    with pytest.raises(SampleError, match="no image of that name"):
        ColmapDatabase(path=out).extract(photographs.read(unrelated).pixels, Source("unrelated.png", unrelated))
    draw_texture(9, (100, 200)).save(images / "b.png")
    with pytest.raises(SampleError, match="the photograph has"):
        ColmapDatabase(path=out).extract(photographs.read(images / "b.png").pixels, Source("b.png", images / "b.png"))
    with pytest.raises(UserError, match="this image has none"):
        ColmapDatabase(path=out).extract(np.zeros((256, 256, 3), np.uint8))


# ---- layouts of photographs


def test_photographs_of_megadepth(tmp_path: Path) -> None:
    scene = tmp_path / "phoenix" / "S6" / "zl548" / "MegaDepth_v1" / "0000"
    for name in ("dense0/imgs/a.jpg", "dense1/imgs/b.jpg", "dense0/depths/a.png"):
        (scene / name).parent.mkdir(parents=True, exist_ok=True)
        draw_texture(0).save(scene / name)
    found = photographs.list_photographs(tmp_path / "phoenix")
    assert [source.path.name for source in found] == ["a.jpg", "b.jpg"]
    assert found[0].name == "S6/zl548/MegaDepth_v1/0000/dense0/imgs/a.jpg"


def test_photographs_of_hpatches(tmp_path: Path) -> None:
    for sequence in ("i_dome", "v_wall"):
        (tmp_path / sequence).mkdir()
        for number in range(1, 7):
            draw_texture(number).save(tmp_path / sequence / f"{number}.ppm")
        (tmp_path / sequence / "H_1_2").write_text("1 0 0\n0 1 0\n0 0 1\n")
    found = photographs.list_photographs(tmp_path)
    assert len(found) == 12
    assert photographs.read(found[0].path).pixels.shape == (256, 256, 3)


# ---- HardNet


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Random weights in a file of kornia's format."""
    torch.manual_seed(0)
    path = tmp_path / "hub" / "checkpoints" / f"hardnet--{WEIGHTS}"
    path.parent.mkdir(parents=True)
    torch.save({"state_dict": kornia.feature.HardNet(pretrained=False).state_dict()}, path)
    return path


def test_hardnet_satisfies_the_contract_and_agrees_with_kornia(weights: Path) -> None:
    image = np.asarray(draw_texture(0, (256, 256)))
    extractor = HardNet(weights=weights, max_keypoints=20)
    check_extractor(extractor, image)
    found = extractor.extract(image)
    assert found.descriptors.shape == (len(found), 128)
    assert found.codes is None
    # By kornia's own chain of patches and network, for frames of six standard deviations; a diameter is two.
    network = kornia.feature.HardNet(pretrained=False)
    network.load_state_dict(torch.load(weights, weights_only=True)["state_dict"])
    sift = Sift(max_keypoints=20).extract(image)
    assert sift.frames is not None
    grey = torch.from_numpy(image.transpose(2, 0, 1).copy())[None].float() / 255
    frames = kornia.feature.laf_from_center_scale_ori(
        torch.from_numpy(sift.keypoints - 0.5)[None], torch.from_numpy(3 * sift.frames[:, :1])[None, :, :, None]
    )
    describe = kornia.feature.LAFDescriptor(network.eval(), 32)
    with torch.inference_mode():
        reference = describe(kornia.color.rgb_to_grayscale(grey), frames)[0].numpy()
    np.testing.assert_allclose(found.descriptors, reference, atol=1e-4)


def test_hardnet_finds_the_weights_of_torch_hub(weights: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    assert HardNet(weights=Path("hub")).weights == weights
    weights.unlink()
    with pytest.raises(UserError, match=r"call kornia.feature.HardNet\(pretrained=True\) once, or give weights=FILE"):
        HardNet(weights=Path("hub"))


def test_hardnet_without_weights_or_kornia(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="no such file"):
        HardNet(weights=tmp_path / "absent.pth")
    (tmp_path / "other.pth").write_bytes(b"something else")
    with pytest.raises(UserError, match="not kornia's"):
        HardNet(weights=tmp_path / "other.pth").extract(np.asarray(draw_texture(0, (256, 256))))
    hide_package(monkeypatch, "kornia")
    draw_texture(0).save(tmp_path / "a.png")
    moved = weights.rename(tmp_path / "moved.pth")
    with pytest.raises(UserError, match="hardnet needs kornia: pip install"):
        HardNet(weights=moved).extract(np.asarray(Image.open(tmp_path / "a.png")))


def hide_package(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    """Make the import of a package fail."""
    imported = builtins.__import__

    def refuse(name: str, *more: Any) -> Any:
        if name.partition(".")[0] == package:
            raise ImportError(name)
        return imported(name, *more)

    monkeypatch.setattr(builtins, "__import__", refuse)


# ---- TensorBoard


def test_training_writes_to_tensorboard(tmp_path: Path) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    from bench.inversion.log import Log

    log = Log(tmp_path / "log")
    for step in range(1, 4):
        log.add_scalars({"loss": 1 / step, "rate": 0.5}, step)
    log.close()
    read = events.EventAccumulator(str(tmp_path / "log"))
    read.Reload()
    assert [(event.step, event.value) for event in read.Scalars("loss")] == [(1, 1.0), (2, 0.5), (3, pytest.approx(1 / 3))]
    Log(None).add_scalars({"loss": 1.0}, 1)


def test_missing_tensorboard_gives_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)  # an import of it fails
    images = write_album(tmp_path / "photos", 3)
    arguments = ["--defense", "none", "--images", str(images), "--out", str(tmp_path / "w"), "--log", str(tmp_path / "log")]
    assert cli.main(["train", *arguments, "--steps", "1"]) == 2
    assert "--log needs tensorboard: pip install" in capfd.readouterr().err
    assert not (tmp_path / "log").exists()
