"""Thumbnails against OpenCV and scikit-image, similarity against NumPy's correlation, ranks against SciPy's."""

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.stats import rankdata
from skimage.color import rgb2gray
from skimage.filters import gaussian

from bench.identification import thumbnails
from bench.identification.thumbnails import compare_thumbnails, compute_thumbnail, normalize_thumbnails, rank_first
from bench.images import photographs


@pytest.fixture(scope="module")
def image() -> Any:
    return (photographs.read(photographs.list_builtin()[0].path).pixels / 255).astype(np.float32)


def compute_reference(image: np.ndarray, sigma: float) -> np.ndarray:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    return cv2.resize(gaussian(grey, sigma, mode="reflect", truncate=4.0), (16, 16), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("side", [256, 128, 200])
def test_thumbnails_equal_those_of_libraries(image: np.ndarray, side: int) -> None:
    """At 200 pixels, the edges of the grid cut through pixels."""
    resized = np.clip(cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA), 0, 1)
    np.testing.assert_allclose(compute_thumbnail(resized), compute_reference(resized, 3 * side / 256), atol=2e-6)


def test_control_another_blur_or_luminance_differs(image: np.ndarray) -> None:
    ours = compute_thumbnail(image)
    assert np.abs(ours - compute_reference(image, 2.0)).max() > 1e-3
    rec_709 = np.repeat(rgb2gray(image)[..., None], 3, axis=2)
    assert np.abs(ours - compute_reference(rec_709.astype(np.float32), 3.0)).max() > 1e-3


def test_the_size_of_an_image_hardly_matters(image: np.ndarray) -> None:
    """A stretched copy has the same thumbnail: blur and grid follow both sides."""
    for width, height in ((128, 128), (320, 240)):
        resized = np.clip(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), 0, 1)
        assert compare_thumbnails(compute_thumbnail(image), compute_thumbnail(resized)) > 0.999


def test_small_images_have_thumbnails(rng: np.random.Generator) -> None:
    small = rng.random((8, 16, 3)).astype(np.float32)
    grey = small.astype(np.float64) @ [0.299, 0.587, 0.114]
    thumbnail = compute_thumbnail(small)
    assert thumbnail.shape == (16, 16)
    np.testing.assert_allclose(thumbnail, np.repeat(grey, 2, axis=0), atol=0.01)  # the blur is a fifth of a pixel at most


def test_similarity_is_the_correlation(rng: np.random.Generator) -> None:
    one, others = rng.random((16, 16)), rng.random((5, 16, 16))
    expected = [np.corrcoef(one.ravel(), other.ravel())[0, 1] for other in others]
    np.testing.assert_allclose(compare_thumbnails(one, others), expected, atol=1e-12)
    np.testing.assert_allclose(compare_thumbnails(0.3 * one + 0.2, others), expected, atol=1e-12)


def test_a_constant_image_is_similar_to_none(rng: np.random.Generator) -> None:
    """Rounding errors of a constant are no structure; one level of 8 bits at a single pixel is."""
    others = rng.random((9, 16, 16))
    for colour in ((0.1, 0.7, 0.3), (1 / 3, 1 / 3, 1 / 3)):
        blank = compute_thumbnail(np.tile(np.float32(colour), (256, 256, 1)))
        assert (compare_thumbnails(blank, others) == 0).all()
    nearly = np.full((256, 256, 3), 0.5)
    nearly[100:116, 100:116] += 1 / 255
    assert (compare_thumbnails(compute_thumbnail(nearly), others) != 0).all()


def test_normalized_thumbnails_have_unit_norm(rng: np.random.Generator) -> None:
    rows = normalize_thumbnails(rng.random((4, 16, 16)))
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1)
    np.testing.assert_allclose(rows.sum(axis=1), 0, atol=1e-12)


def test_ranks_equal_those_of_scipy(rng: np.random.Generator) -> None:
    for _ in range(50):
        values = rng.integers(0, 6, 12) / 5  # with ties
        assert rank_first(values) == rankdata(-values, method="average")[0]


def test_a_pixel_counts_in_each_grid_cell_by_its_area() -> None:
    """Against an enumeration of the 16 x 40 parts of pixels."""
    length, parts = 40, np.zeros((16, 40))
    for part in range(16 * length):  # a part is 1/16 of a pixel, and 1/40 of a grid cell
        parts[part // length, part // 16] += 1 / length
    np.testing.assert_allclose(thumbnails._average_weights(length), parts, atol=1e-12)
