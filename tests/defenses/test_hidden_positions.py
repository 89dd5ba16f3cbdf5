"""Defenses that hide positions, and controls that break their contract."""

from dataclasses import dataclass

import numpy as np
import pytest

import bench
from bench.api import Defense
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.mechanisms.protection import hide_order
from bench.positions.lines import draw_lines
from bench.registry.composed import Composed
from bench.testing import are_equal, check_defense
from bench.types import Descriptors, Features, Floats, Lines, Permuted, Points, Positions
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.none import Undefended
from defenses.permutation import Permutation


def protect(defense: Defense, secret: Features, seed: int = 0) -> Positions:
    return defense.protect(secret, Public(), np.random.default_rng(seed)).positions


def protect_lines(secret: Features, seed: int = 0) -> Floats:
    positions = protect(RandomLines(), secret, seed)
    assert isinstance(positions, Lines)
    return positions.lines


def test_directions_of_lines_are_uniform() -> None:
    lines = np.concatenate([protect_lines(draw_features(100), seed) for seed in range(50)])
    angles = np.arctan2(lines[:, 1], lines[:, 0]) % np.pi
    counts = np.histogram(angles, bins=10, range=(0, np.pi))[0]
    assert (np.abs(counts - 500) < 5 * np.sqrt(500 * 0.9)).all()


def test_a_line_depends_on_the_distance_alone() -> None:
    secret = draw_features(20)
    lines = protect_lines(secret)
    along = np.stack([-lines[:, 1], lines[:, 0]], axis=1)
    moved = Features(keypoints=secret.keypoints + 30 * along, descriptors=secret.descriptors, codes=None, size=secret.size)
    np.testing.assert_allclose(protect_lines(moved), lines, atol=1e-4)


@pytest.mark.parametrize("count", [2, 3, 8, 9])
def test_pairs_exchange_one_coordinate(count: int) -> None:
    secret = draw_features(count)
    released = protect(Permutation(), secret)
    assert isinstance(released, Permuted)
    unchanged = released.points == secret.keypoints
    assert (unchanged.sum(axis=1) == 1).all()
    for axis in (0, 1):  # the other coordinate is that of another keypoint
        assert set(released.points[~unchanged[:, axis], axis]) <= set(secret.keypoints[:, axis])
    normals = np.abs(released.lines[:, :2]).round(6)
    np.testing.assert_array_equal(normals, unchanged)  # the normal points along the coordinate that is true
    if count % 2 == 0:
        partners = [
            np.flatnonzero(secret.keypoints[:, axis] == value)
            for axis, value in zip(unchanged.argmin(1), released.points[~unchanged], strict=True)
        ]
        assert all(partners[partner.item()].item() == row for row, partner in enumerate(partners))


def test_a_single_keypoint_is_hidden_too() -> None:
    secret = draw_features(1)
    released = protect(Permutation(), secret)
    assert isinstance(released, Permuted)
    assert (released.points == secret.keypoints).sum() == 1


def test_order_is_hidden_with_the_positions() -> None:
    secret = draw_features(40).by_position()
    for defense in (RandomLines(), Permutation(), Composed(geometry=RandomLines(), descriptors=LDP())):
        hidden = hide_order(secret, defense, np.random.default_rng(0))
        assert not are_equal(hidden, secret)
        assert are_equal(hidden.by_position(), secret)
    assert hide_order(secret, Undefended(), np.random.default_rng(0)) is secret
    release = bench.protect(secret, RandomLines())
    assert isinstance(release, Descriptors)
    assert not np.array_equal(release.descriptors, secret.descriptors)


@dataclass(frozen=True, kw_only=True)
class Missing(RandomLines):
    """Its lines miss the keypoints by a tenth of a pixel."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        lines = draw_lines(secret.keypoints + np.float32(0.1), rng.uniform(0.3, 1.2, len(secret)))
        return Descriptors(positions=lines, size=secret.size, descriptors=secret.descriptors.copy())


@dataclass(frozen=True, kw_only=True)
class Identity(Permutation):
    """Exchanges nothing."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        lines = draw_lines(secret.keypoints, rng.choice([0.0, np.pi / 2], len(secret)))
        positions = Permuted(lines=lines.lines, points=secret.keypoints.copy())
        return Descriptors(positions=positions, size=secret.size, descriptors=secret.descriptors.copy())


@dataclass(frozen=True, kw_only=True)
class InTheClear(RandomLines):
    """Declares lines and releases points."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        positions = Points(keypoints=secret.keypoints.copy())
        return Descriptors(positions=positions, size=secret.size, descriptors=secret.descriptors.copy())


@dataclass(frozen=True, kw_only=True)
class Constant(RandomLines):
    """Draws the same directions each time."""

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        return super().protect(secret, public, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("broken", "complaint"),
    [
        (Missing(), "a line misses its keypoint by 0.1"),
        (Identity(), "exchanged no coordinate"),
        (InTheClear(), "released Points as positions"),
        (Constant(), "another rng gave the same release"),
    ],
)
def test_the_contract_finds_a_broken_defense(broken: Defense, complaint: str) -> None:
    with pytest.raises(AssertionError, match=complaint):
        check_defense(broken, Public(), draw_features())
