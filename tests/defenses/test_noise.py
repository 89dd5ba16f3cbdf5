"""Gaussian noise: its size, and its release."""

import numpy as np
import pytest

from bench.api import Privacy
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.core.errors import UserError
from defenses.noise import Noise


@pytest.mark.parametrize("length", [64, 128])
@pytest.mark.parametrize("sigma", [0.25, 1.0, 3.0])
def test_the_cosine_is_that_of_noise_of_this_length(sigma: float, length: int) -> None:
    """In many dimensions the noise is orthogonal to the descriptor and has length sigma, so the cosine is 1 / √(1 + sigma²)."""
    secret = draw_features(2000, length=length, signed=True)
    release = Noise(sigma=sigma).protect(secret, Public(), np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(release.descriptors, axis=1), 1, atol=1e-6)
    cosines = np.einsum("nd,nd->n", release.descriptors, secret.descriptors)
    assert cosines.mean() == pytest.approx(1 / np.sqrt(1 + sigma**2), abs=0.01)


def test_without_noise_it_releases_the_descriptors() -> None:
    secret = draw_features(50)
    release = Noise(sigma=0.0).protect(secret, Public(), np.random.default_rng(0))
    np.testing.assert_allclose(release.descriptors, secret.descriptors, atol=1e-6)
    assert not np.shares_memory(release.keypoints, secret.keypoints)


def test_claims_no_guarantee() -> None:
    assert Noise().privacy(Public()) == Privacy("none")


@pytest.mark.parametrize("sigma", [-0.1, float("nan"), float("inf")])
def test_a_wrong_size_is_an_error(sigma: float) -> None:
    with pytest.raises(UserError, match="sigma must be at least 0 and finite"):
        Noise(sigma=sigma)
