"""Features in hloc's layout."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fakes import draw_texture
from PIL import Image

from attacks.dia import DIA
from attacks.keypoints import Keypoints
from attacks.lattice import Lattice
from attacks.sparsity import Sparsity
from bench.api import Attack
from bench.cache import feature_cache, store
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.extractors.hloc import Hloc
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.scene import File
from bench.images.views import extract_views
from bench.tasks.matching import Matching
from bench.testing import check_extractor
from defenses.affine import Affine
from defenses.none import Undefended

WIDTH, HEIGHT = 400, 200
KEYPOINTS = np.array([[100.0, 0.0], [299.0, 199.0], [199.5, 99.5], [10.0, 10.0], [390.0, 10.0]])


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    path = tmp_path / "db" / "street" / "a.png"
    path.parent.mkdir(parents=True)
    draw_texture(0, (WIDTH, HEIGHT)).save(path)
    return path


def features(tmp_path: Path, name: str = "street/a.png", **datasets: Any) -> Path:
    """Write features as hloc does. A dataset given as None is left out."""
    rng = np.random.default_rng(0)
    whole = {
        "keypoints": KEYPOINTS.astype(np.float16),
        "descriptors": rng.random((128, len(KEYPOINTS))).astype(np.float16),
        "scores": np.ones(len(KEYPOINTS)),
        "image_size": np.array([WIDTH, HEIGHT]),
    } | datasets
    path = tmp_path / "features.h5"
    with h5py.File(path, "w") as opened:
        group = opened.create_group(name)
        for key, value in whole.items():
            if value is not None:
                group.create_dataset(key, data=value)
    return path


def source(photograph: Path) -> Source:
    """The photograph with its name below the folder that the features were extracted from."""
    return Source("street/a.png" if photograph.parent.name == "street" else photograph.name, photograph)


def extract(path: Path, photograph: Path, **more: Any) -> Any:
    return Hloc(path=path, **more).extract(photographs.read(photograph).pixels, source(photograph))


def test_mirrored_views_have_no_stored_features(tmp_path: Path, photograph: Path) -> None:
    """Training would otherwise pair mirrored pixels with the features of the unmirrored photograph."""
    views = extract_views(source(photograph), Hloc(path=features(tmp_path)))
    assert len(next(views).features) > 0
    with pytest.raises(UserError, match="Training and dictionaries use mirrored views"):
        next(views)


def test_declared_properties_of_descriptors_decide_which_attacks_apply(tmp_path: Path) -> None:
    path = features(tmp_path)
    for attack, declared in ((Sparsity(), {"exact_zeros": True}), (Lattice(), {"eight_bit": True})):
        assert "hloc does not declare" in (attack.explain_not_applicable(Affine(), Hloc(path=path), Public()) or "")
        assert attack.explain_not_applicable(Affine(), Hloc(path=path, **declared), Public()) is None


@pytest.mark.parametrize("attack", [DIA(), Keypoints()], ids=lambda attack: attack.name())
def test_a_network_for_other_features_names_both_extractors(attack: Attack, tmp_path: Path) -> None:
    reason = attack.explain_not_applicable(Undefended(), Hloc(path=features(tmp_path)), Public())
    assert reason is not None
    assert "trained for features of sift, not hloc" in reason
    assert "None" not in reason


def test_keypoints_follow_crop_and_scale(tmp_path: Path, photograph: Path) -> None:
    found = extract(features(tmp_path), photograph)
    scale = 256 / HEIGHT  # the square is cut from x = 100 to x = 300
    expected = [[0.5 * scale, 0.5 * scale], [128, 128], [256 - 0.5 * scale, 256 - 0.5 * scale]]  # from top to bottom
    np.testing.assert_allclose(found.keypoints, expected, atol=0.1)  # hloc keeps 16-bit floats
    assert found.descriptors.shape == (3, 128)
    assert found.codes is None
    assert found.size == (256, 256)


def test_keypoints_agree_with_those_of_the_square(tmp_path: Path) -> None:
    image = draw_texture(1, (256, 256))
    image.save(tmp_path / "a.png")
    ours = Sift().extract(np.asarray(image))
    assert ours.codes is not None
    stored = {"keypoints": ours.keypoints - 0.5, "descriptors": ours.codes.T, "image_size": np.array([256, 256])}
    found = extract(features(tmp_path, "a.png", **stored), tmp_path / "a.png")
    np.testing.assert_allclose(found.keypoints, ours.keypoints, atol=1e-4)
    assert np.array_equal(found.codes, ours.codes)
    assert np.array_equal(found.descriptors, ours.descriptors)


def test_contract(tmp_path: Path, photograph: Path) -> None:
    check_extractor(Hloc(path=features(tmp_path)), photographs.read(photograph).pixels, source(photograph))


def test_names_are_compared_whole(tmp_path: Path, photograph: Path) -> None:
    """A file that knows `a.png` has no features of `street/a.png`, which is another photograph."""
    path = features(tmp_path, "a.png")
    with pytest.raises(SampleError, match=r"street/a\.png: .*features\.h5 has no features of that name; names are paths below"):
        extract(path, photograph)
    same = Hloc(path=path).extract(photographs.read(photograph).pixels, Source("a.png", photograph))
    assert len(same) == 3  # the negative control: the features are found by that name alone
    with pytest.raises(SampleError, match="has no features of that name"):
        Hloc(path=path).extract(photographs.read(photograph).pixels, Source("street", photograph))


@pytest.mark.parametrize("link_folder", [False, True])
def test_links_are_not_resolved(tmp_path: Path, link_folder: bool) -> None:
    """Each of two names of one photograph has the features of that name."""
    root = tmp_path / "photos"
    (root / "real").mkdir(parents=True)
    draw_texture(0, (WIDTH, HEIGHT)).save(root / "real" / "b.png")
    linked = "link/b.png" if link_folder else "a.png"
    (root / linked.partition("/")[0]).symlink_to("real" if link_folder else "real/b.png", target_is_directory=link_folder)
    path = features(tmp_path, "real/b.png")
    with h5py.File(path, "a") as opened:
        opened.copy("real/b.png", linked)
        opened[linked]["keypoints"][0] = [120.0, 50.0]
    ours = {each.name: each for each in photographs.list_photographs(root)}
    assert ours.keys() == {linked, "real/b.png"}
    pixels = photographs.read(root / "real" / "b.png").pixels
    tops = {name: Hloc(path=path).extract(pixels, each).keypoints[0].tolist() for name, each in ours.items()}
    np.testing.assert_allclose(tops["real/b.png"], [0.5 * 1.28, 0.5 * 1.28], atol=0.1)
    np.testing.assert_allclose(tops[linked], [20.5 * 1.28, 50.5 * 1.28], atol=0.1)


def test_features_of_a_scene_are_found_by_the_names_of_its_model(tmp_path: Path) -> None:
    """The folders of the image folder itself are no part of a name, and equal photographs have features of their own."""
    image = draw_texture(1, (256, 256))
    names = ("db/1.png", "night/db/1.png")
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        image.save(tmp_path / name)
    path = features(tmp_path, names[0], image_size=np.array([256, 256]))
    with h5py.File(path, "a") as opened:
        opened.copy(names[0], names[1])
        opened[names[1]]["keypoints"][...] += 1
    with store.use_folder(tmp_path / "cache"):
        files = [File(path=tmp_path / name, size=(256, 256), name=name) for name in names]
        first, second = (feature_cache.extract(Hloc(path=path), file) for file in files)
        np.testing.assert_allclose(second.keypoints[0], first.keypoints[0] + 1)
        with pytest.raises(UserError, match="this image has none"):
            feature_cache.extract(Hloc(path=path), File(path=tmp_path / names[0], size=(256, 256)))


def test_features_of_hpatches_are_found_by_sequence(tmp_path: Path) -> None:
    root = tmp_path / "hpatches"
    (root / "v_wall").mkdir(parents=True)
    for number in range(1, 7):
        draw_texture(number, (256, 256)).save(root / "v_wall" / f"{number}.ppm")
        (root / "v_wall" / f"H_1_{number}").write_text("1 0 0\n0 1 0\n0 0 1\n")
    first = Matching().collect(root, None).samples[0].images[1]
    assert isinstance(first, File)
    assert first.file() == Source("v_wall/2.ppm", root / "v_wall" / "2.ppm")


@pytest.mark.parametrize(
    ("datasets", "complaint"),
    [
        ({"keypoints": None}, "no dataset 'keypoints'"),
        ({"descriptors": None}, "no dataset 'descriptors'"),
        ({"image_size": None}, "no dataset 'image_size'"),
        ({"descriptors": np.full((128, 5), np.nan)}, "not finite"),
        ({"descriptors": np.eye(128, 5) * [1, 1, 1, 1, 0]}, "a descriptor is zero"),
        ({"descriptors": np.ones((256, 5))}, r"shape \(256, 5\), expected \(128, 5\)"),
        ({"descriptors": np.ones((5, 128))}, r"shape \(5, 128\), expected \(128, 5\)"),
        ({"keypoints": np.ones(5)}, r"keypoints has shape \(5,\)"),
        ({"keypoints": np.ones((5, 3))}, r"shape \(5, 3\), expected \(N, 2\)"),
        ({"keypoints": np.full((5, 2), np.nan)}, "keypoints hold values that are not finite"),
        ({"keypoints": np.full((5, 2), 1e308)}, "no keypoint of .* lies in the photograph's central square"),
        ({"keypoints": np.full((5, 2), b"1")}, r"keypoints is of type \|S1, expected numbers"),
        ({"descriptors": np.ones((128, 5), bool)}, "descriptors is of type bool, expected numbers"),
        ({"descriptors": np.full((128, 5), 1e300)}, "descriptors hold values that are not finite"),  # as float32
        ({"descriptors": np.full((128, 5), 1e-300)}, "a descriptor is zero"),
        ({"descriptors": h5py.Empty("f4")}, "descriptors is of type float32, expected numbers"),
        ({"image_size": np.array([WIDTH, HEIGHT, 1])}, r"image_size is \[400, 200, 1\], expected a width and a height"),
        ({"image_size": np.array([WIDTH, np.nan])}, "expected a width and a height"),
        ({"image_size": np.array([WIDTH, 0])}, "expected a width and a height"),
        ({"image_size": np.array(5)}, r"image_size has shape \(\)"),
        ({"keypoints": np.ones((0, 2)), "descriptors": np.ones((128, 0))}, "no keypoint"),
        ({"keypoints": np.ones((5, 2))}, "no keypoint of .* lies in the photograph's central square"),
        ({"image_size": np.array([200, 400])}, "the features are of an image of"),
        ({"name": "other.png"}, "has no features of that name"),
    ],
)
def test_invalid_features_are_explained(tmp_path: Path, photograph: Path, datasets: dict[str, Any], complaint: str) -> None:
    path = features(tmp_path, **datasets)
    with pytest.raises(SampleError, match=complaint):
        extract(path, photograph)


@pytest.mark.parametrize("part", ["keypoints", "descriptors", "image_size"])
def test_groups_instead_of_arrays_are_explained(tmp_path: Path, photograph: Path, part: str) -> None:
    path = features(tmp_path, **{part: None})
    with h5py.File(path, "a") as opened:
        opened.create_group(f"street/a.png/{part}")
    with pytest.raises(SampleError, match=f"no dataset '{part}'"):
        extract(path, photograph)


def test_array_instead_of_a_group_is_explained(tmp_path: Path, photograph: Path) -> None:
    with h5py.File(tmp_path / "features.h5", "w") as opened:
        opened["street/a.png"] = np.ones(3)
    with pytest.raises(SampleError, match="has no features of that name"):
        extract(tmp_path / "features.h5", photograph)


def test_vast_arrays_are_not_allocated(tmp_path: Path, photograph: Path) -> None:
    """A file of kilobytes can state any shape: chunks that were never written are filled when they are read."""
    path = features(tmp_path, descriptors=None)
    with h5py.File(path, "a") as opened:
        opened["street/a.png"].create_dataset("descriptors", (128, 10**10), np.float32, chunks=(128, 100))
    assert path.stat().st_size < 100_000
    with pytest.raises(SampleError, match=r"descriptors has shape \(128, 10000000000\)"):
        extract(path, photograph)


def test_truncated_file_is_explained(tmp_path: Path, photograph: Path) -> None:
    path = features(tmp_path)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(SampleError, match=r"features\.h5 is damaged, or not in hloc's layout: .*truncated"):
        extract(path, photograph)


def test_other_descriptor_lengths_can_be_declared(tmp_path: Path, photograph: Path) -> None:
    path = features(tmp_path, descriptors=np.ones((256, 5)))
    assert extract(path, photograph, dimension=256).descriptors.shape == (3, 256)


def test_rotated_photograph_is_refused(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    draw_texture(0, (WIDTH, HEIGHT)).save(tmp_path / "a.png", exif=exif)
    with pytest.raises(SampleError, match="EXIF rotation"):
        extract(features(tmp_path, "a.png"), tmp_path / "a.png")


def test_invalid_files_are_refused(tmp_path: Path, photograph: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        Hloc(path=tmp_path / "absent.h5")
    with pytest.raises(UserError, match="not an HDF5 file"):
        Hloc(path=photograph)
    with pytest.raises(UserError, match="this image has none"):
        Hloc(path=features(tmp_path)).extract(np.zeros((256, 256, 3), np.uint8))
