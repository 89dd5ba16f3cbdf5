"""PrivUnit: releases a unit vector that is likelier, by e^ε, within a cap around the descriptor.

Source: Bhowmick et al., arXiv:1812.00984; not in the paper.

Method: let u be a unit vector of S^(n − 1), and q the fraction of the sphere that the cap {v: v·u ≥ γ} covers. With probability

    p = q e^ε / (q e^ε + 1 − q)

v is uniform on the cap, otherwise on the rest of the sphere. Its density, relative to the uniform density, is

    p / q             = e^ε / (q e^ε + 1 − q)    within the cap,
    (1 − p) / (1 − q) = 1   / (q e^ε + 1 − q)    outside.

*It is ε-LDP:* all caps of one γ cover the same fraction, so the two densities are the same for all u. They are the only
values and differ by the factor e^ε. ∎

Choice of γ: this file spends all of ε on that quotient, and chooses the γ with the greatest mean of v·u. This is optimal
among all unbiased mechanisms (Asi, Feldman and Talwar, ICML 2022). The original splits ε in two. `plateau` is the analogue
for words.

Centring: descriptors cluster around their mean, most of all non-negative ones, as those of SIFT. With `centred`, u is the
component of the descriptor orthogonal to the mean direction of a public dictionary, and n is one less. u is a function of the
descriptor, so the proof holds.

Limits: the coin is exact, with q a multiple of 2^-64 (`bench.mechanisms.subset`). The vector is not, since a sphere has no exact
draw. γ and the projection are doubles, with a relative error of the densities of about 1e-12. Each component is rounded to a
multiple of 2^-12 before the vector is scaled to unit norm. This removes the bits in which sums of doubles reveal their summands
(Mironov, CCS 2012). So ε holds as far as doubles represent real numbers, whereas mechanisms over words are exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from bench.api import Defense, Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import draw_inclusion
from bench.settings import Asset, Between, OneOf
from bench.types import Descriptors, Features, Points

Doubles = NDArray[np.float64]

BINARY_DIGITS = 64  # binary digits of q
GRID = 2.0**-12  # released components are multiples of it, before they are scaled


@dataclass(frozen=True, kw_only=True)
class PrivUnit(Defense):
    """Releases a random unit vector that is likelier within a cap around the descriptor."""

    releases = Descriptors
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {"epsilon": Between(4.0, 32.0)}
    noisy: ClassVar[bool] = True

    epsilon: float = 10.0  # nats, per descriptor
    centred: bool = True  # whether the mean direction of the dictionary's words is removed first
    dictionary: Asset = Asset("shipped")

    def __post_init__(self) -> None:
        if not (self.epsilon > 0 and math.isfinite(self.epsilon)):  # NaN is refused too
            raise UserError(f"privunit: epsilon must be above 0 and finite, got {self.epsilon}")

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        mean = self._load_mean(secret, public)
        vectors = draw_near(remove_mean(secret.descriptors.astype(np.float64), mean), mean, self.epsilon, rng)
        released = unit_rows((np.rint(vectors / GRID) * GRID).astype(np.float32))
        return Descriptors(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, descriptors=released)

    def privacy(self, public: Public) -> Privacy:
        return Privacy("epsilon-ldp", self.epsilon)

    def _load_mean(self, secret: Features, public: Public) -> Doubles | None:
        """Return the mean direction to remove, (1, D); None if it is not removed."""
        if not self.centred:
            return None
        dictionary = public.dictionary(self.dictionary)
        dictionary.check_suits(secret.exact, self.dictionary)
        return dictionary.mean[None]


def remove_mean(rows: Doubles, mean: Doubles | None) -> Doubles:
    """Return the component of each row orthogonal to the mean, scaled to unit norm. (N, D), (1, D) -> (N, D)"""
    if mean is not None:
        rows = rows - (rows @ mean.T) * mean
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def draw_near(u: Doubles, mean: Doubles | None, epsilon: float, rng: np.random.Generator) -> Doubles:
    """Draw a vector of the mechanism for each u, on the sphere orthogonal to the mean. (N, D), (1, D) -> (N, D)"""
    rows, length = u.shape
    free = length - (mean is not None)  # n
    covered = choose_cap(epsilon, free)
    q = covered / 2**BINARY_DIGITS
    inside = draw_inclusion(rows, epsilon, 2**BINARY_DIGITS, covered, rng)
    fraction = np.where(inside, q * rng.random(rows), q + (1 - q) * rng.random(rows))  # of the sphere nearer to u than v
    along = latitude(fraction, free)
    around = rng.normal(size=u.shape)
    around = remove_mean(around - np.einsum("nd,nd->n", around, u)[:, None] * u, mean)  # orthogonal to the mean, as u is
    return along[:, None] * u + np.sqrt(1 - along**2)[:, None] * around


def latitude(fraction: Doubles, length: int) -> Doubles:
    """Return the cosine that a fraction of S^(n − 1) exceeds. (N,) -> (N,)

    For uniform v, (1 + v·u) / 2 has the distribution Beta((n − 1)/2, (n − 1)/2).
    """
    from scipy.special import betaincinv

    half = (length - 1) / 2
    return 1 - 2 * betaincinv(half, half, fraction)


@lru_cache(maxsize=64)
def choose_cap(epsilon: float, length: int) -> int:
    """Return 2^64 q for the cap with the greatest mean of v·u.

    Under the uniform density, the cap contributes c = (1 − γ²)^((n − 1)/2) / ((n − 1) B(1/2, (n − 1)/2)) to the mean of v·u, and
    the rest of the sphere contributes −c. So the mean of the mechanism is c (e^ε − 1) / (q e^ε + 1 − q).
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import betainc

    half = (length - 1) / 2

    def logarithm(gamma: float) -> float:
        q = betainc(half, half, (1 - gamma) / 2)
        with np.errstate(divide="ignore"):
            return float(half * math.log1p(-(gamma**2)) - np.logaddexp(np.log(q) + epsilon, np.log1p(-q)))

    best = minimize_scalar(lambda gamma: -logarithm(gamma), bounds=(0.0, 1 - 1e-6), method="bounded", options={"xatol": 1e-9}).x
    return min(2**BINARY_DIGITS - 1, max(1, round(float(betainc(half, half, (1 - best) / 2)) * 2**BINARY_DIGITS)))


def expected_cosine(epsilon: float, length: int) -> float:
    """Return the mean of v·u for the cap of `choose_cap`."""
    from scipy.special import betaln

    q, half = choose_cap(epsilon, length) / 2**BINARY_DIGITS, (length - 1) / 2
    gamma = float(latitude(np.array([q]), length)[0])
    beyond = half * math.log1p(-(gamma**2)) - math.log(2 * half) - betaln(0.5, half)
    return math.exp(beyond + math.log(math.expm1(epsilon)) - np.logaddexp(math.log(q) + epsilon, math.log1p(-q)))


PLUGIN = PrivUnit
