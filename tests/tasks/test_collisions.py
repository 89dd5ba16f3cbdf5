"""Collisions: the measure against brute force, with releases that must collide with a descriptor and releases that must not."""

from pathlib import Path

import numpy as np
import pytest
from fakes import build_trial

from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.geometry.shared_sub_database import compute_intersection_distances, find_shared_sub_database, stack_subspaces
from bench.settings import Asset
from bench.tasks.collisions import Collisions, is_collision_free
from bench.types import Features, Subspaces
from defenses.affine import Affine
from defenses.ldp import LDP

OWN = draw_features(10, seed=0)


@pytest.fixture
def database(tmp_path: Path) -> Asset:
    return write_dictionary(tmp_path, 24)


def create_defense(database: Asset, dim: int = 4) -> Affine:
    return Affine(dim=dim, sub_databases=1, database=database)


def create_releases(defense: Affine, secrets: list[Features]) -> list[Subspaces]:
    public = Public()
    return [defense.protect(secret, public, np.random.default_rng(seed)) for seed, secret in enumerate(secrets, start=100)]


def compute_residual(point: np.ndarray, directions: np.ndarray) -> float:
    """Compute the distance from a point to the span of rows."""
    return float(np.linalg.norm(point - directions.T @ np.linalg.lstsq(directions.T, point)[0]))


def test_distances_to_intersecting_subspaces_are_those_of_brute_force(database: Asset) -> None:
    defense, public = create_defense(database), Public()
    lifted = defense.lift(OWN, public, np.random.default_rng(0))
    words = unit_rows(public.dictionary(database).words)
    points = np.concatenate([OWN.descriptors[:, None], words[lifted.words]], axis=1).astype(np.float64)  # (10, 3, D)
    (other,) = create_releases(defense, [draw_features(8, seed=11)])
    every = stack_subspaces([lifted.release, other])
    expected = np.full((10, 3), np.inf)
    for i in range(10):
        o1, b1 = lifted.release.origins[i].astype(np.float64), lifted.release.bases[i].astype(np.float64)
        for j in range(18):
            o2, b2 = every.origins[j].astype(np.float64), every.bases[j].astype(np.float64)
            if i != j and compute_residual(o2 - o1, np.concatenate([b1, b2])) < 1e-5:
                expected[i] = np.minimum(expected[i], [compute_residual(point - o2, b2) for point in points[i]])
    shared = find_shared_sub_database(lifted.release, iter([other]), 2, enough=1)
    assert shared.sharing == 1
    np.testing.assert_allclose(compute_intersection_distances(points, shared), expected, atol=1e-5)
    assert 0 < (expected[:, 1:] < 1e-5).sum() < 20


def test_no_collision_by_hand() -> None:
    inf = np.inf
    nearest = np.array([[0.9, 0.0, 0.0], [0.9, 0.0, 0.85], [0.9, 0.0, inf], [inf, inf, inf], [0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    assert is_collision_free(nearest, 0.0).tolist() == [True, True, False, False, False, True]
    assert is_collision_free(nearest, 0.1).tolist() == [True, False, False, False, False, False]


def metrics(database: Asset, secrets: list[Features], dim: int = 4, **more: float) -> dict[str, float]:
    defense = create_defense(database, dim)
    others = create_releases(defense, secrets)
    found = Collisions(others=len(others), coverage=1, **more).evaluate(build_trial(defense, OWN, others=others)).metrics
    return {name: value for name, value in found.items() if value is not None}


def test_enough_other_releases_cover_every_word_without_collision(database: Asset) -> None:
    found = metrics(database, [draw_features(40, seed=seed) for seed in range(11, 15)])
    assert found == {
        "no_collision": 1,
        "no_collision_covered": 1,
        "coverage": 1,
        "covered": 1,
        "releases_asked": 4,
        "releases_kept": 4,
    }


def test_a_release_of_the_same_descriptors_collides_with_all(database: Asset) -> None:
    found = metrics(database, [draw_features(40, seed=11), OWN])
    assert found["no_collision"] == 0
    assert found["no_collision_covered"] == 0


def test_no_descriptor_is_collision_free_at_a_large_tolerance(database: Asset) -> None:
    assert metrics(database, [draw_features(40, seed=11)], tolerance=2.0)["no_collision"] == 0


def test_releases_of_another_database_do_not_intersect(database: Asset, tmp_path: Path) -> None:
    others = create_releases(create_defense(write_dictionary(tmp_path, 24, seed=9)), [draw_features(40, seed=11)])
    found = Collisions(others=1).evaluate(build_trial(create_defense(database), OWN.take(np.arange(1)), others=others)).metrics
    assert found["releases_asked"] == 1
    assert (found["coverage"], found["no_collision"], found["releases_kept"]) == (0, 0, 0)
    assert found["no_collision_covered"] is None


def test_number_of_other_releases_is_limited(database: Asset) -> None:
    defense = create_defense(database)
    others = create_releases(defense, [draw_features(40, seed=seed) for seed in (11, 12, 13)])
    assert Collisions(others=2, coverage=1).evaluate(build_trial(defense, OWN, others=others)).metrics["releases_asked"] == 2


def test_invalid_settings_are_refused(database: Asset) -> None:
    assert Collisions().explain_not_applicable(create_defense(database), None, Sift(), Public()) is None
    assert "ldp does not say" in str(Collisions().explain_not_applicable(LDP(dictionary=database), None, Sift(), Public()))
    assert "no database words" in str(
        Collisions().explain_not_applicable(Affine(lifting="random", database=database), None, Sift(), Public())
    )
    for wrong in (
        {"others": -1},
        {"coverage": 1.1},
        {"coverage": float("nan")},
        {"tolerance": -0.1},
        {"tolerance": float("nan")},
    ):
        with pytest.raises(UserError, match="must be"):
            Collisions(**wrong)  # type: ignore[arg-type]
