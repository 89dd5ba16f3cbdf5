"""The metric `identified`: its values at both ends, and settings in records."""

import numpy as np
import pytest

from bench.identification import distractors
from bench.identification.distractors import load_distractors, rank_photograph
from bench.images import photographs
from metrics.identified import Identified


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [(photographs.read(source.path).pixels / 255).astype(np.float32) for source in photographs.list_builtin()]


@pytest.mark.slow
def test_the_photograph_scores_1_and_a_constant_image_the_mean_rank(images: list[np.ndarray]) -> None:
    for image in images:
        assert Identified()(image, image.copy()) == 1.0
        for grey in (0.0, 0.45, 1.0):
            assert Identified()(image, np.full_like(image, grey)) == 1 / 128.5


def test_the_value_is_the_reciprocal_of_the_rank(images: list[np.ndarray]) -> None:
    for truth, estimate in zip(images, images[1:] + images[:1], strict=True):
        rank = rank_photograph(truth, estimate, load_distractors())
        assert Identified()(truth, estimate) == 1 / rank
        assert 1 <= rank <= 256


def test_brightness_contrast_and_noise_do_not_hide_the_photograph(images: list[np.ndarray], rng: np.random.Generator) -> None:
    """SSIM is low for such an estimate, which a person recognises."""
    for image in images:
        estimate = np.clip(0.3 + 0.2 * image + rng.normal(0, 0.1, image.shape), 0, 1).astype(np.float32)
        assert Identified()(image, estimate) == 1.0


def test_control_the_negative_scores_low(images: list[np.ndarray]) -> None:
    for image in images:
        assert Identified()(image, 1 - image) < 1 / 128.5


def test_records_can_state_the_settings() -> None:
    assert Identified.parameters["distractors"] == distractors.DIGEST
    assert Identified.parameters["sigma"] == 3.0
    assert Identified.range == (1 / 256, 1.0)
