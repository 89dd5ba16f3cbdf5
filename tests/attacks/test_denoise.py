"""The denoise attack: its estimates, and the concentration that it fits."""

from typing import Literal

import numpy as np
import pytest
from scipy.stats import vonmises_fisher

from attacks.denoise import CONCENTRATIONS, Denoise, average_words, compute_log_normaliser, fit_concentration
from bench.api import View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.threat_model import PublicDatabase
from bench.types import Features, Floats
from defenses.noise import Noise
from defenses.none import Undefended
from defenses.privunit import PrivUnit

Estimate = Literal["released", "word", "mean"]


@pytest.fixture(scope="module")
def words() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 200, (500, 128), dtype=np.uint8)


@pytest.fixture(scope="module")
def secret(words: np.ndarray) -> Features:
    """Descriptors near the words."""
    rng = np.random.default_rng(1)
    codes = np.clip(words[rng.integers(len(words), size=100)] + rng.normal(0, 8, (100, 128)), 0, 255).astype(np.uint8)
    return Features(keypoints=np.zeros((100, 2), np.float32), descriptors=unit_rows(codes), codes=codes, size=(256, 256))


def measure_cosine(estimate: Estimate, sigma: float, secret: Features, words: np.ndarray) -> float:
    release = Noise(sigma=sigma).protect(secret, Public(), np.random.default_rng(2))
    view = View(
        release=release,
        defense=Noise(sigma=sigma),
        extractor=Sift(),
        knowledge={PublicDatabase: lambda: PublicDatabase(words=words)},
    )
    found: Floats = Denoise(estimate=estimate).recover(view, np.random.default_rng(3))
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    return float(np.einsum("nd,nd->n", found, secret.descriptors).mean())


def test_words_reduce_strong_noise_and_weak_noise_needs_none(secret: Features, words: np.ndarray) -> None:
    strong = {name: measure_cosine(name, 2.0, secret, words) for name in ("released", "word", "mean")}
    assert strong["mean"] >= strong["word"] > strong["released"]
    weak = {name: measure_cosine(name, 0.01, secret, words) for name in ("released", "mean")}
    assert weak["released"] > weak["mean"]  # words are not the descriptors


def test_the_word_is_that_of_the_greatest_cosine(secret: Features, words: np.ndarray) -> None:
    view = View(
        release=Undefended().protect(secret, Public(), np.random.default_rng(0)),
        defense=Noise(sigma=0.0),
        extractor=Sift(),
        knowledge={PublicDatabase: lambda: PublicDatabase(words=words)},
    )
    nearest = (secret.descriptors.astype(np.float64) @ unit_rows(words).astype(np.float64).T).argmax(axis=1)
    np.testing.assert_array_equal(Denoise(estimate="word").recover(view, np.random.default_rng(0)), unit_rows(words)[nearest])


def test_the_density_is_that_of_scipy(words: np.ndarray) -> None:
    centre, point = unit_rows(words[:2]).astype(np.float64)
    for kappa in (2.0, 64.0, 2048.0):
        expected = vonmises_fisher(centre / np.linalg.norm(centre), kappa).logpdf(point / np.linalg.norm(point))
        assert compute_log_normaliser(kappa, 128) + kappa * float(centre @ point) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("kappa", [32.0, 256.0])
def test_the_concentration_of_a_mixture_is_found(kappa: float, words: np.ndarray) -> None:
    rng = np.random.default_rng(4)
    centres = unit_rows(words[rng.integers(len(words), size=64)]).astype(np.float64)
    u = np.stack([vonmises_fisher(one / np.linalg.norm(one), kappa, seed=rng).rvs(1)[0] for one in centres])
    fitted = fit_concentration(u.astype(np.float32), unit_rows(words))
    assert abs(np.log2(fitted / kappa)) <= 0.5  # a step of CONCENTRATIONS
    assert fitted in CONCENTRATIONS


def test_the_mean_of_one_word_is_that_word(words: np.ndarray) -> None:
    one = unit_rows(words[:1])
    np.testing.assert_allclose(average_words(unit_rows(words[1:5]), one, 10.0), np.repeat(one, 4, axis=0), atol=1e-6)


def test_it_applies_to_noisy_descriptors_alone() -> None:
    assert Denoise().explain_not_applicable(Noise(), Sift(), Public()) is None
    assert Denoise().explain_not_applicable(PrivUnit(), Sift(), Public()) is None
    assert Denoise().explain_not_applicable(Undefended(), Sift(), Public()) == "none adds no noise to descriptors"
    with pytest.raises(UserError, match="estimate must be released, word or mean"):
        Denoise(estimate="median")  # type: ignore[arg-type]
