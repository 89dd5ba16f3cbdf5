"""The database attack: toy cases with known answers, a float64 reference of every step, and a wrong database."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from attacks.database import Database
from bench.api import Defense, Privacy, View
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.threat_model import DefenseDatabase
from bench.types import Features, Points, Subspaces
from defenses.affine import Affine, lift, reparameterise

ALPHA = 1e-4


@dataclasses.dataclass(frozen=True)
class Case:
    """Descriptors d, their adversarial words a, and their release."""

    d: np.ndarray  # (N, D)
    a: np.ndarray  # (N, A, D)
    release: Subspaces
    defense: Affine


def lift_case(d: np.ndarray, words: np.ndarray, dim: int, seed: int = 0) -> Case:
    """Lift descriptors through any of `words` (hybrid lifting)."""
    adversarial = dim // 2
    span, _ = lift(d.astype(float), words, adversarial, dim, np.random.default_rng(seed))
    release = release_subspaces(d, span, seed)
    found, distances = find_nearest_to_subspaces(release, words, adversarial)
    assert distances.max() < 1e-6
    return Case(d, unit_rows(words[found]), release, Affine(dim=dim))


def release_subspaces(d: np.ndarray, span: np.ndarray, seed: int) -> Subspaces:
    origins, bases = reparameterise(d.astype(float), span, np.random.default_rng(seed))
    return Subspaces(positions=Points(keypoints=np.zeros((len(d), 2), np.float32)), size=(64, 64), origins=origins, bases=bases)


def recover(attack: Database, case: Case, words: np.ndarray) -> np.ndarray:
    view = View(
        release=case.release,
        defense=case.defense,
        extractor=Sift(),
        knowledge={DefenseDatabase: lambda: DefenseDatabase(words=words)},
    )
    return attack.recover(view, np.random.default_rng(0))


def draw_sparse(rng: np.random.Generator, count: int) -> np.ndarray:
    """Draw rows similar to SIFT's: few large components, and many near zero."""
    return np.minimum(rng.gamma(0.6, 40.0, (count, 128)) + 1, 255).astype(np.uint8)


def perturb(rng: np.random.Generator, rows: np.ndarray) -> np.ndarray:
    """Add noise to rows: about 20°."""
    return np.clip(rows * rng.uniform(0.5, 1.5, rows.shape), 1, 255).astype(np.uint8)


def draw_related(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw descriptors (count, D), and words of the same distribution of which one is similar to each descriptor."""
    parents = draw_sparse(rng, 1000)
    return unit_rows(perturb(rng, parents[:count])), perturb(rng, parents)


def find_nearest(estimate: np.ndarray, case: Case) -> np.ndarray:
    """Return which of d, a_1, ..., a_A an estimate is nearest to. -> (N,) 0 is d"""
    candidates = np.concatenate([case.d[:, None], case.a], axis=1)  # (N, 1 + A, D)
    return np.linalg.norm(candidates - estimate[:, None], axis=2).argmin(axis=1)


# ---- toy cases


@pytest.mark.parametrize("dim", [2, 4, 8])
def test_a_descriptor_that_is_itself_a_word_can_only_be_guessed(rng, dim):
    words = draw_sparse(rng, 900)
    case = lift_case(unit_rows(words[:300]), words, dim)
    _, distances = find_nearest_to_subspaces(case.release, words, dim // 2 + 2)
    assert distances[:, dim // 2].max() < 1e-6  # one more at distance zero than there are adversarial words
    assert distances[:, dim // 2 + 1].min() > 0.1
    estimate = recover(Database(neighbours=1, estimators=1), case, words)
    hit = np.linalg.norm(estimate - case.d, axis=1) < 1e-5
    # Otherwise the estimate is an adversarial word.
    found, _ = find_nearest_to_subspaces(case.release, words, dim // 2 + 1)
    assert (np.linalg.norm(unit_rows(words[found]) - estimate[:, None], axis=2).min(axis=1) < 1e-5).all()
    assert stats.binomtest(int(hit.sum()), len(hit), 1 / (dim // 2 + 1)).pvalue > ALPHA


@pytest.mark.parametrize("dim", [2, 4, 16])
def test_the_estimate_converges_to_the_descriptor_with_a_word(rng, dim):
    words = draw_sparse(rng, 500)
    case = lift_case(unit_rows(draw_sparse(rng, 20)), words, dim)
    toward = unit_rows(rng.normal(size=case.d.shape).astype(np.float32))
    errors = []
    for off in (0.1, 0.01, 0.001, 1e-5):
        planted = np.concatenate([unit_rows(words), case.d + np.float32(off) * toward])
        estimate = recover(Database(neighbours=1, estimators=1), case, planted)
        errors.append(np.linalg.norm(estimate - case.d, axis=1).max())
        assert errors[-1] <= 1.1 * off + 1e-5
    assert errors == sorted(errors, reverse=True)


def test_a_word_near_d_is_preferred_to_nearer_ones_near_an_adversary(rng):
    words = draw_sparse(rng, 3000)
    case = lift_case(unit_rows(draw_sparse(rng, 5)), words, 4)
    toward = unit_rows(rng.normal(size=case.d.shape).astype(np.float32))
    near_a = case.a[:, 0] + np.float32(0.01) * toward
    near_d = case.d + np.float32(0.05) * toward
    planted = np.concatenate([unit_rows(words), near_a, near_d])
    found, _ = find_nearest_to_subspaces(case.release, planted, 4)
    assert np.array_equal(found[:, 2:], len(words) + np.arange(5)[:, None] + [0, 5])
    assert (find_nearest(recover(Database(neighbours=2, estimators=1), case, planted), case) == 0).all()
    assert (find_nearest(recover(Database(neighbours=1, estimators=1), case, planted), case) != 0).all()


def test_it_depends_on_the_subspace_and_not_on_its_basis(rng):
    d, words = draw_related(rng, 60)
    span, _ = lift(d.astype(float), words, 3, 6, rng)
    one, other = (Case(d, d[:, None], release_subspaces(d, span, seed), Affine(dim=6)) for seed in (1, 2))
    assert np.abs(one.release.origins - other.release.origins).max() > 0.1
    attack = Database(neighbours=30, estimators=4)
    np.testing.assert_allclose(recover(attack, one, words), recover(attack, other, words), atol=1e-5)


# ---- every step, one subspace at a time


def reference(case: Case, words: np.ndarray, neighbours: int, estimators: int) -> np.ndarray:
    rows = unit_rows(words).astype(float)
    estimates = []
    for origin, basis in zip(case.release.origins.astype(float), case.release.bases.astype(float), strict=True):

        def onto(point: np.ndarray, origin: np.ndarray = origin, basis: np.ndarray = basis) -> np.ndarray:
            return origin + basis.T @ np.linalg.lstsq(basis.T, point - origin, rcond=None)[0]

        ranked = sorted((float(np.linalg.norm(row - onto(row))), index) for index, row in enumerate(rows))
        a = [rows[index] for _, index in ranked[: case.defense.adversarial]]
        v = ranked[case.defense.adversarial :][:neighbours]
        u = sorted(v, key=lambda entry: -min(np.linalg.norm(rows[entry[1]] - adversary) for adversary in a))[:estimators]
        alpha = sum(1 / distance for distance, _ in u)
        estimate = onto(sum(rows[index] / distance for distance, index in u) / alpha)
        estimates.append(estimate / np.linalg.norm(estimate))
    return np.array(estimates)


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "neighbours", "estimators"), [(2, 10, 3), (6, 20, 1), (16, 5, 5), (4, 5000, 2)])
def test_agrees_with_the_paper_step_by_step(rng, dim, neighbours, estimators):
    d, words = draw_related(rng, 12)
    case = lift_case(d, words[:300], dim)
    estimate = recover(Database(neighbours=neighbours, estimators=estimators), case, words[:300])
    assert estimate.dtype == np.float32
    np.testing.assert_allclose(estimate, reference(case, words[:300], neighbours, estimators), atol=1e-6)


def test_more_subspaces_than_one_batch(rng):
    d, words = draw_related(rng, 300)
    case = lift_case(d, words, 2)
    attack = Database(neighbours=5, estimators=2)
    last = dataclasses.replace(
        case.release,
        positions=Points(keypoints=case.release.keypoints[-1:]),
        origins=case.release.origins[-1:],
        bases=case.release.bases[-1:],
    )
    alone = recover(attack, dataclasses.replace(case, release=last), words)
    np.testing.assert_allclose(recover(attack, case, words)[-1:], alone, atol=1e-6)


# ---- accuracy, and the control


@pytest.mark.parametrize("dim", [2, 4])
def test_it_distinguishes_d_from_the_adversaries_and_a_wrong_database_does_not(rng, dim):
    d, words = draw_related(rng, 300)
    case = lift_case(d, words, dim)
    attack = Database(neighbours=5, estimators=1)
    right = find_nearest(recover(attack, case, words), case) == 0
    assert right.mean() > 0.9
    wrong = find_nearest(recover(attack, case, draw_sparse(rng, 1000)), case) == 0
    assert stats.binomtest(int(wrong.sum()), len(wrong), 1 / (dim // 2 + 1)).pvalue > ALPHA


# ---- errors


@pytest.mark.parametrize(("neighbours", "estimators"), [(5, 0), (5, 6), (0, 0)])
def test_settings_out_of_range_are_refused(neighbours, estimators):
    with pytest.raises(UserError, match="estimators must be from 1"):
        Database(neighbours=neighbours, estimators=estimators)


def test_a_database_with_too_few_words_is_refused(rng):
    words = draw_sparse(rng, 2)
    case = lift_case(unit_rows(draw_sparse(rng, 3)), words, 4)
    with pytest.raises(UserError, match="2 words are too few"):
        recover(Database(), case, words)
    assert recover(Database(), case, np.concatenate([words, draw_sparse(rng, 1)])).shape == (3, 128)


def test_no_keypoints(rng):
    words = draw_sparse(rng, 50)
    case = lift_case(unit_rows(draw_sparse(rng, 3)), words, 4)
    none = dataclasses.replace(
        case.release,
        positions=Points(keypoints=case.release.keypoints[:0]),
        origins=case.release.origins[:0],
        bases=case.release.bases[:0],
    )
    assert recover(Database(), dataclasses.replace(case, release=none), words).shape == (0, 128)


def test_it_does_not_apply_to_liftings_without_words():
    reason = Database().explain_not_applicable(Affine(lifting="random"), Sift(), Public())
    assert reason is not None
    assert "no database words" in reason
    assert Database().explain_not_applicable(Affine(), Sift(), Public()) is None


def test_it_does_not_apply_to_subspaces_without_a_declared_word_count():
    class Plain(Defense):
        releases = Subspaces

        def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Subspaces:
            raise NotImplementedError

        def privacy(self, public: Public) -> Privacy:
            return Privacy("none")

    assert "does not say" in str(Database().explain_not_applicable(Plain(), Sift(), Public()))
