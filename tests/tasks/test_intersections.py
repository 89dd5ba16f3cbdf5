"""Words near a subspace: the measure against brute force, with data for which it must succeed and data for which it must fail."""

from pathlib import Path

import numpy as np
import pytest
from fakes import build_trial

from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.tasks.intersections import COUNTS, Intersections, draw_rounds, drop_left_out, pass_ratio_test
from defenses.affine import Affine
from defenses.ldp import LDP


def measure_by_brute_force(defense: Affine, count: int, ratio: float, seed: int) -> dict[str, float]:
    """Measure by the definition: every word's distance to every subspace, one at a time, in float64."""
    public, secret, rng = Public(), draw_features(12), np.random.default_rng(seed)
    words = unit_rows(public.dictionary(defense.database).words).astype(np.float64)
    found: dict[str, list[bool]] = {f"{name}_top{top}": [] for name in ("success", "with_adversarial") for top in COUNTS}
    for part in draw_rounds(secret, count, rng):
        lifted = defense.lift(part, public, rng)
        for row in range(len(part)):
            basis, origin = lifted.release.bases[row].astype(np.float64), lifted.release.origins[row].astype(np.float64)
            distances = [np.linalg.norm((word - origin) - basis.T @ np.linalg.lstsq(basis.T, word - origin)[0]) for word in words]
            points = [part.descriptors[row].astype(np.float64), *words[lifted.words[row]]]

            def succeeds(word: int, points: list[np.ndarray] = points) -> bool:
                nearest, second = sorted(float(np.linalg.norm(words[word] - point)) for point in points)[:2]
                return nearest < ratio * second

            order = np.argsort(distances, kind="stable")
            other_words = [word for word in order if word not in lifted.words[row]]
            for top in COUNTS:
                found[f"success_top{top}"] += [succeeds(word) for word in other_words[:top]]
                found[f"with_adversarial_top{top}"] += [succeeds(word) for word in order[:top]]
    return {name: float(np.mean(values)) for name, values in found.items()}


@pytest.mark.parametrize(("dim", "count"), [(2, 12), (4, 30), (10, 5)])
def test_measure_is_that_of_brute_force(tmp_path: Path, dim: int, count: int) -> None:
    defense = Affine(dim=dim, database=write_dictionary(tmp_path, 160))
    task = Intersections(subspaces=count, ratio=0.95)
    metrics = task.evaluate(build_trial(defense, draw_features(12), rng=np.random.default_rng(5))).metrics
    expected = measure_by_brute_force(defense, count, 0.95, 5)
    assert {name: metrics[name] for name in expected} == pytest.approx(expected)
    assert metrics["subspaces"] == count
    assert 0 < expected["success_top50"] < 1


def test_adversarial_words_succeed_by_construction(tmp_path: Path) -> None:
    """So the measure excludes them: at dimension 10 and N = 5 only they would count, for any data."""
    task, defense = Intersections(), Affine(dim=10, database=write_dictionary(tmp_path, 160))
    metrics = task.evaluate(build_trial(defense, draw_features(12))).metrics
    assert metrics["with_adversarial_top5"] == 1
    assert metrics["success_top5"] is not None
    assert metrics["success_top5"] < 1


def test_words_around_the_points_succeed_and_words_between_them_fail(rng: np.random.Generator) -> None:
    points = unit_rows(rng.normal(size=(1, 3, 128)).astype(np.float32))
    around = unit_rows(points[:, [0, 0, 1, 2]] + 0.02 * rng.normal(size=(1, 4, 128)).astype(np.float32))
    between = unit_rows(points[:, [0, 0, 1]] + points[:, [1, 2, 2]])
    assert pass_ratio_test(around, points, 0.8).all()
    assert not pass_ratio_test(between, points, 0.8).any()


def test_words_left_out_are_replaced_by_the_next() -> None:
    match = np.array([[True, False, False, True], [False, True, True, True]])
    left_out = np.array([[True, False, False, False], [False, False, True, False]])
    assert drop_left_out(match, left_out, 2).tolist() == [[False, False], [False, True]]
    assert drop_left_out(match, left_out, 3).tolist() == [[False, False, True], [False, True, True]]


@pytest.mark.parametrize(("count", "times"), [(5, {0, 1}), (12, {1}), (30, {2, 3})])
def test_all_descriptors_are_lifted_equally_often(rng: np.random.Generator, count: int, times: set[int]) -> None:
    secret = draw_features(12)
    lifted = np.concatenate([part.keypoints[:, 0] for part in draw_rounds(secret, count, rng)])
    assert len(lifted) == count
    assert {int((lifted == x).sum()) for x in secret.keypoints[:, 0]} == times


def test_defenses_without_words_are_refused(tmp_path: Path) -> None:
    small = write_dictionary(tmp_path)
    task = Intersections()
    assert task.explain_not_applicable(Affine(database=small), None, Sift(), Public()) is None
    assert "ldp does not say" in str(task.explain_not_applicable(LDP(dictionary=small), None, Sift(), Public()))
    assert "no database words" in str(
        task.explain_not_applicable(Affine(lifting="random", database=small), None, Sift(), Public())
    )
    for wrong in ({"ratio": 0.0}, {"ratio": float("nan")}, {"subspaces": -1}):
        with pytest.raises(UserError, match="must be"):
            Intersections(**wrong)
