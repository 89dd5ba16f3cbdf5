"""SIFT: COLMAP's convention for keypoints, 8-bit codes, and upright orientation."""

import cv2
import numpy as np
import pytest

from bench.core.errors import SampleError, UserError
from bench.extractors.sift import Sift
from bench.images import photographs


@pytest.fixture(scope="module")
def images():
    return [photographs.read(source.path).pixels for source in photographs.list_builtin()]


def compute_match_fraction(one: np.ndarray, other: np.ndarray) -> float:
    """Compute the fraction of descriptors with a very similar one in the other image."""
    return float(((one @ other.T).max(axis=1) > 0.98).mean())


def test_the_first_pixels_centre_is_at_one_half():
    for x, y in [(100, 80), (31, 200)]:
        blob = np.zeros((256, 256), np.float32)
        blob[y, x] = 1
        blob = cv2.GaussianBlur(blob, (0, 0), 3)
        grey = (blob / blob.max() * 255).astype(np.uint8)
        features = Sift().extract(np.repeat(grey[:, :, None], 3, axis=2))
        nearest = np.abs(features.keypoints - (x + 0.5, y + 0.5)).max(axis=1).min()
        assert nearest < 0.05
        assert nearest < np.abs(features.keypoints - (x, y)).max(axis=1).min()  # OpenCV's own convention would be this


def test_codes_are_opencvs_and_descriptors_their_directions(images):
    features = Sift(upright=False).extract(images[0])
    grey = cv2.cvtColor(images[0], cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT_create(contrastThreshold=0.002, edgeThreshold=15, enable_precise_upscale=True)
    theirs = {tuple(row) for row in sift.detectAndCompute(grey, None)[1].astype(np.uint8)}
    assert {tuple(row) for row in features.codes} <= theirs
    norms = np.linalg.norm(features.codes.astype(float), axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(features.descriptors * norms, features.codes, atol=1e-3)


def test_upright_means_gravitys_orientation(images):
    """Turning the photograph by a right angle changes upright descriptors and leaves oriented ones as they are."""
    turned = np.ascontiguousarray(np.rot90(images[1]))
    oriented, upright = Sift(upright=False, max_keypoints=3000), Sift(max_keypoints=3000)
    assert compute_match_fraction(oriented.extract(images[1]).descriptors, oriented.extract(turned).descriptors) > 0.7
    assert compute_match_fraction(upright.extract(images[1]).descriptors, upright.extract(turned).descriptors) < 0.3


def test_a_point_of_two_orientations_is_one_upright_point(images):
    many = Sift(upright=False, max_keypoints=3000).extract(images[0])
    once = Sift(max_keypoints=3000).extract(images[0])
    assert len(once) < len(many)
    assert len(np.unique(many.keypoints, axis=0)) == len(np.unique(once.keypoints, axis=0))


def test_about_600_to_1000_keypoints(images):
    counts = [len(Sift().extract(image)) for image in images]
    assert 450 <= np.median(counts) <= 1000
    assert max(counts) <= 1000


@pytest.mark.slow
def test_600_to_1000_keypoints_on_test_photographs(shared_data):
    """Results are reported on these photographs, and the threshold was not chosen on them."""
    names = (shared_data / "test.txt").read_text().split()[::4]
    counts = [len(Sift().extract(photographs.read(shared_data / "train" / name).pixels)) for name in names]
    assert 600 <= np.median(counts) <= 1000


def test_the_limit_selects_the_strongest(images):
    few, all_of_them = Sift(max_keypoints=100).extract(images[0]), Sift(max_keypoints=3000).extract(images[0])
    assert len(few) == 100
    assert {tuple(point) for point in few.keypoints} <= {tuple(point) for point in all_of_them.keypoints}


def test_a_flat_image_has_none():
    with pytest.raises(SampleError, match="no keypoint"):
        Sift().extract(np.full((256, 256, 3), 90, np.uint8))


@pytest.mark.parametrize("wrong", [{"contrast_threshold": -1.0}, {"edge_threshold": 0.0}, {"max_keypoints": 0}])
def test_invalid_settings_are_refused(wrong):
    with pytest.raises(UserError, match="sift"):
        Sift(**wrong)
