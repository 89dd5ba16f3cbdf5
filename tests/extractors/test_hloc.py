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
from bench.codebook.public import Public
from bench.core.errors import SampleError, UserError
from bench.extractors.hloc import Hloc
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.images.views import extract_views
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


def extract(path: Path, photograph: Path, **more: Any) -> Any:
    return Hloc(path=path, **more).extract(photographs.read(photograph).pixels, photograph)


def test_mirrored_views_have_no_stored_features(tmp_path: Path, photograph: Path) -> None:
    """Training would otherwise pair mirrored pixels with the features of the unmirrored photograph."""
    views = extract_views(photographs.Source(name="a", path=photograph), Hloc(path=features(tmp_path)))
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
    check_extractor(Hloc(path=features(tmp_path)), photographs.read(photograph).pixels, photograph)


def test_longest_end_of_the_path_names_the_group(tmp_path: Path, photograph: Path) -> None:
    path = features(tmp_path)
    with h5py.File(path, "a") as opened:
        opened.create_group("a.png")  # another photograph's, at the top
    assert len(extract(path, photograph)) == 3


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
        ({"keypoints": np.ones(5)}, r"shape \(5,\), expected \(N, 2\)"),
        ({"keypoints": np.ones((0, 2)), "descriptors": np.ones((128, 0))}, "no keypoint"),
        ({"keypoints": np.ones((5, 2))}, "no keypoint of .* lies in the photograph's central square"),
        ({"image_size": np.array([200, 400])}, "the features are of an image of"),
        ({"name": "other.png"}, "has no features of it"),
    ],
)
def test_invalid_features_are_explained(tmp_path: Path, photograph: Path, datasets: dict[str, Any], complaint: str) -> None:
    path = features(tmp_path, **datasets)
    with pytest.raises(SampleError, match=complaint):
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
