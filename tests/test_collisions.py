"""Collisions: the measure against brute force, and releases that must, and must not, come near a descriptor."""

from pathlib import Path

import numpy as np
import pytest
from fakes import trial

from bench.errors import UserError
from bench.features.sift import Sift
from bench.kernels.search import unit_rows
from bench.plugin import Asset
from bench.public import Public
from bench.tasks.collisions import Collisions, nearest_meeting, no_collision
from bench.testing import example_features, small_dictionary
from bench.types import Features, Subspaces
from defenses.affine import Affine
from defenses.ldp import LDP

OWN = example_features(10, seed=0)


@pytest.fixture
def database(tmp_path: Path) -> Asset:
    return small_dictionary(tmp_path, 24)


def lifting(database: Asset, dim: int = 4) -> Affine:
    return Affine(dim=dim, sub_databases=1, database=database)


def releases(defense: Affine, secrets: list[Features]) -> list[Subspaces]:
    public = Public()
    return [defense.protect(secret, public, np.random.default_rng(seed)) for seed, secret in enumerate(secrets, start=100)]


def residual(point: np.ndarray, directions: np.ndarray) -> float:
    """The distance from a point to the span of rows."""
    return float(np.linalg.norm(point - directions.T @ np.linalg.lstsq(directions.T, point)[0]))


def test_nearest_meeting_is_that_of_brute_force(database: Asset) -> None:
    defense, public = lifting(database), Public()
    lifted = defense.lifted(OWN, public, np.random.default_rng(0))
    words = unit_rows(public.dictionary(database).words)
    points = np.concatenate([OWN.descriptors[:, None], words[lifted.words]], axis=1).astype(np.float64)  # (10, 3, D)
    (other,) = releases(defense, [example_features(8, seed=11)])
    expected = np.full((10, 3), np.inf)
    for i in range(10):
        for j in range(8):
            o1, b1, o2, b2 = (
                a.astype(np.float64)
                for a in (lifted.release.origins[i], lifted.release.bases[i], other.origins[j], other.bases[j])
            )
            if residual(o2 - o1, np.concatenate([b1, b2])) < 1e-5:
                expected[i] = np.minimum(expected[i], [residual(point - o2, b2) for point in points[i]])
    np.testing.assert_allclose(nearest_meeting(lifted.release, points, other), expected, atol=1e-5)
    assert 0 < np.isfinite(expected[:, 0]).sum() < 10
    assert (expected[:, 1:] < 1e-5).any()


def test_no_collision_by_hand() -> None:
    inf = np.inf
    nearest = np.array([[0.9, 0.0, 0.0], [0.9, 0.0, 0.85], [0.9, 0.0, inf], [inf, inf, inf], [0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    assert no_collision(nearest, 0.0).tolist() == [True, True, False, False, False, True]
    assert no_collision(nearest, 0.1).tolist() == [True, False, False, False, False, False]


def metrics(database: Asset, secrets: list[Features], dim: int = 4, **more: float) -> dict[str, float]:
    defense = lifting(database, dim)
    others = releases(defense, secrets)
    found = Collisions(others=len(others), **more).judge(trial(defense, OWN, others=others)).metrics
    return {name: value for name, value in found.items() if value is not None}


def test_enough_other_releases_meet_every_word_and_none_comes_near(database: Asset) -> None:
    found = metrics(database, [example_features(40, seed=seed) for seed in range(11, 15)])
    assert found == {
        "no_collision": 1,
        "no_collision_covered": 1,
        "coverage": 1,
        "covered": 1,
        "same_sub_database": 4,
    }


def test_a_release_of_the_same_descriptors_collides_with_all(database: Asset) -> None:
    found = metrics(database, [example_features(40, seed=11), OWN])
    assert found["no_collision"] == 0
    assert found["no_collision_covered"] == 0


def test_a_tolerance_above_every_distance_leaves_nothing(database: Asset) -> None:
    assert metrics(database, [example_features(40, seed=11)], tolerance=2.0)["no_collision"] == 0


def test_releases_of_another_database_meet_nothing(database: Asset, tmp_path: Path) -> None:
    others = releases(lifting(small_dictionary(tmp_path, 24, seed=9)), [example_features(40, seed=11)])
    found = Collisions(others=1).judge(trial(lifting(database), OWN, others=others)).metrics
    assert (found["coverage"], found["no_collision"], found["same_sub_database"]) == (0, 0, 0)
    assert found["no_collision_covered"] is None


def test_only_as_many_others_as_asked_for(database: Asset) -> None:
    defense = lifting(database)
    others = releases(defense, [example_features(40, seed=seed) for seed in (11, 12, 13)])
    assert Collisions(others=2).judge(trial(defense, OWN, others=others)).metrics["same_sub_database"] == 2


def test_what_does_not_fit_is_refused(database: Asset) -> None:
    assert Collisions().inapplicable(lifting(database), None, Sift(), Public()) is None
    assert "ldp does not lift" in str(Collisions().inapplicable(LDP(dictionary=database), None, Sift(), Public()))
    assert "no word" in str(Collisions().inapplicable(Affine(lifting="random", database=database), None, Sift(), Public()))
    for wrong in ({"others": 0}, {"tolerance": -0.1}, {"tolerance": float("nan")}):
        with pytest.raises(UserError, match="must be"):
            Collisions(**wrong)  # type: ignore[arg-type]
