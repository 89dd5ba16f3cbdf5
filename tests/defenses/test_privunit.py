"""PrivUnit against the law of its docstring: the coordinate along the descriptor, the orthogonal part, and the best cap."""

import dataclasses
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import trapezoid

from bench.audit.auditor import audit
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.localization import map_matching
from bench.mechanisms.subset import chance_digits
from bench.types import Descriptors, Features
from defenses.privunit import BINARY_DIGITS, GRID, PrivUnit, choose_cap, draw_near, expected_cosine, latitude, remove_mean

ALPHA, CERTAINLY_WRONG = 1e-4, 1e-9


def directions(count: int, length: int) -> np.ndarray:
    return remove_mean(np.random.default_rng(0).normal(size=(1, length)), None).repeat(count, axis=0)


def test_quotient_of_densities_is_e_to_the_epsilon() -> None:
    """p / q over (1 − p) / (1 − q), as exact fractions."""
    for epsilon in (0.5, 2.0, 10.0, 100.0):
        covered = choose_cap(epsilon, 127)
        p, q = Fraction(chance_digits(epsilon, 2**BINARY_DIGITS, covered, 512), 2**512), Fraction(covered, 2**BINARY_DIGITS)
        quotient = (p / q) / ((1 - p) / (1 - q))
        assert float(quotient) == pytest.approx(math.exp(epsilon), rel=1e-12)


@pytest.mark.parametrize(("epsilon", "length"), [(2.0, 127), (8.0, 128), (6.0, 5)])
def test_the_cap_is_the_best(epsilon: float, length: int) -> None:
    """No other cap on a grid has a greater mean, by numerical integration of the density of v·u."""
    half = (length - 1) / 2
    along = np.linspace(-1, 1, 400_001)
    density = stats.beta.pdf((1 + along) / 2, half, half) / 2

    def mean(gamma: float) -> float:
        inside = along >= gamma
        q = float(trapezoid(np.where(inside, density, 0), along))
        return float(trapezoid(along * density * np.where(inside, math.exp(epsilon), 1.0), along)) / (
            q * math.exp(epsilon) + 1 - q
        )

    best = float(latitude(np.array([choose_cap(epsilon, length) / 2**BINARY_DIGITS]), length)[0])
    assert mean(best) == pytest.approx(expected_cosine(epsilon, length), rel=1e-4)
    assert all(mean(best) >= mean(other) - 1e-6 for other in np.linspace(0, 0.9, 50))


def test_the_coordinate_along_the_descriptor() -> None:
    rows, length, epsilon = 20_000, 24, 5.0
    vectors = draw_near(directions(rows, length), None, epsilon, np.random.default_rng(1))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1)
    along = vectors @ directions(1, length)[0]

    def cumulative(x: np.ndarray, epsilon: float = epsilon) -> np.ndarray:
        q, half = choose_cap(epsilon, length) / 2**BINARY_DIGITS, (length - 1) / 2
        below = stats.beta.cdf((1 + x) / 2, half, half)  # of the uniform law
        inside = np.maximum(below - (1 - q), 0)
        return (below - inside + inside * math.exp(epsilon)) / (q * math.exp(epsilon) + 1 - q)

    assert stats.kstest(along, cumulative).pvalue > ALPHA
    assert stats.kstest(along, lambda x: cumulative(x, 5.5)).pvalue < CERTAINLY_WRONG
    assert along.mean() == pytest.approx(expected_cosine(epsilon, length), abs=4 * along.std() / rows**0.5)


def test_the_orthogonal_part_is_uniform() -> None:
    rows, length = 20_000, 8
    u = directions(rows, length)
    vectors = draw_near(u, None, 3.0, np.random.default_rng(2))
    around = remove_mean(vectors - np.einsum("nd,nd->n", vectors, u)[:, None] * u, None)
    frame = np.linalg.svd(u[:1])[2][1:]  # of the space orthogonal to u
    uniform = stats.beta((length - 2) / 2, (length - 2) / 2)
    for axis in frame:
        assert stats.kstest((1 + around @ axis) / 2, uniform.cdf).pvalue > ALPHA


def test_a_release_is_centred_and_on_the_grid(tmp_path: Path) -> None:
    public, asset, secret = Public(), write_dictionary(tmp_path), draw_features(500)
    mean = public.dictionary(asset).mean
    assert np.linalg.norm(mean) == pytest.approx(1)
    centred = PrivUnit(epsilon=12.0, dictionary=asset).protect(secret, public, np.random.default_rng(0)).descriptors
    assert np.abs(centred @ mean).max() < 40 * GRID
    whole = PrivUnit(epsilon=12.0, centred=False, dictionary=asset).protect(secret, public, np.random.default_rng(0)).descriptors
    assert (whole @ mean).std() > 0.05
    secret_directions = remove_mean(secret.descriptors.astype(np.float64), mean[None])
    cosines = np.einsum("nd,nd->n", centred, secret_directions)
    assert cosines.mean() == pytest.approx(expected_cosine(12.0, 127), abs=0.02)
    steps = np.abs(centred[0]) / np.diff(np.unique(np.abs(centred[0]))).min()  # differences are of whole steps
    assert len(np.unique(np.abs(centred[0]))) < 128
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.02)


# ---- the audit


@pytest.mark.slow
def test_the_guarantee_holds(tmp_path: Path) -> None:
    found = audit(PrivUnit(epsilon=2.0), 64, 8000, 0, tmp_path)
    assert found.verdict != "violated"
    assert found.strongest.family == "projection"
    assert 1.2 < found.strongest.epsilon < 2.0
    assert any("not enumerated" in note for note in audit(PrivUnit(epsilon=2.0), 4, 400, 0, tmp_path).notes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlwaysWithin(PrivUnit):
    """Always draws from the cap."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        vectors = PrivUnit(epsilon=40.0, centred=self.centred, dictionary=self.dictionary).protect(secret, public, rng)
        return dataclasses.replace(vectors)


@pytest.mark.slow
def test_a_broken_variant_is_detected(tmp_path: Path) -> None:
    found = audit(AlwaysWithin(epsilon=2.0), 64, 8000, 0, tmp_path)
    assert found.verdict == "violated"
    assert {finding.family for finding in found.findings if finding.certain_epsilon > 2.0} == {"projection"}


# ---- configuration


@pytest.mark.parametrize("epsilon", [0.0, -1.0, math.inf, math.nan])
def test_invalid_settings_are_refused(epsilon: float) -> None:
    with pytest.raises(UserError, match="epsilon must be above 0 and finite"):
        PrivUnit(epsilon=epsilon)


def test_matching_uses_no_ratio_test() -> None:
    assert map_matching.select_matcher(PrivUnit()) == "noisy-nn"
    assert map_matching.MATCHERS["noisy-nn"]().ratio == 1.0  # type: ignore[attr-defined]
