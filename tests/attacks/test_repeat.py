"""The repeat attack: exact at intersections of subspaces; its success on word sets against enumeration of all releases."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from attacks.repeat import Repeat
from bench.api import Defense, View
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.multi_release import bound_success, compute_success_chances, find_common_points, select_likeliest
from bench.mechanisms.subset import draw_word_subsets, log10_chance
from bench.registry.composed import compose
from bench.threat_model import RepeatedReleases
from bench.types import Features, Points, Release, Subspaces
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.naive_ldp import NaiveLDP
from leaderboard import multi_release

SECRET = draw_features(60)
OTHER = draw_features(60, seed=9)


def release_repeatedly(defense: Defense, count: int, secret: Features = SECRET, seed: int = 8) -> list[Release]:
    public = Public()
    return [defense.protect(secret, public, np.random.default_rng([seed, number])) for number in range(count)]


def recover(defense: Defense, releases: list[Release], seed: int = 0) -> np.ndarray:
    first, *further = releases
    knowledge = {RepeatedReleases: lambda: RepeatedReleases(releases=tuple(further))}
    view = View(release=first, defense=defense, extractor=Sift(), knowledge=knowledge)
    return Repeat(releases=len(releases)).recover(view, np.random.default_rng(seed))


def measure_errors(found: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found - SECRET.descriptors, axis=1)


# ---- subspaces


@pytest.fixture(scope="module")
def affine(tmp_path_factory):
    database = write_dictionary(tmp_path_factory.mktemp("database"), words=16_000)
    return lambda dim: Affine(dim=dim, database=database)


@pytest.mark.parametrize("dim", [2, 8, 16])
@pytest.mark.parametrize("count", [2, 3])
def test_liftings_intersect_in_the_descriptor(affine, dim, count):
    assert measure_errors(recover(affine(dim), release_repeatedly(affine(dim), count))).max() < 1e-5


def test_liftings_of_another_descriptor_do_not_intersect(affine):
    """Negative control."""
    mixed = [*release_repeatedly(affine(4), 1), *release_repeatedly(affine(4), 1, OTHER, seed=1)]
    assert measure_errors(recover(affine(4), mixed)).min() > 0.1


def test_one_lifting_alone_gives_its_point_nearest_to_zero(affine):
    (release,) = release_repeatedly(affine(4), 1)
    found = recover(affine(4), [release])
    for row, origin, basis in zip(found, release.origins.astype(float), release.bases.astype(float), strict=True):
        inside = np.linalg.lstsq(basis.T, -origin, rcond=None)[0]
        foot = origin + basis.T @ inside
        np.testing.assert_allclose(row, foot / np.linalg.norm(foot), atol=1e-5)
    assert measure_errors(found).min() > 0.1


def test_agrees_with_least_squares_over_all_coordinates(affine):
    releases = release_repeatedly(affine(6), 3)
    found = find_common_points(releases)
    for number in range(len(SECRET)):
        system, target = np.zeros((128, 128)), np.zeros(128)
        for release in releases:
            basis = release.bases[number].astype(float)
            outside = np.eye(128) - basis.T @ basis
            system, target = system + outside, target + outside @ release.origins[number]
        np.testing.assert_allclose(found[number], np.linalg.solve(system, target), atol=1e-5)


def test_neither_basis_nor_order_matters(affine, rng):
    releases = release_repeatedly(affine(4), 2)
    expected = recover(affine(4), releases)
    turned = []
    for release in releases:
        turn = np.linalg.qr(rng.normal(size=(len(release), 4, 4)))[0]
        bases = (turn @ release.bases).astype(np.float32)
        moved = release.origins + np.einsum("nid,ni->nd", release.bases, rng.normal(size=(len(release), 4)))
        turned.append(dataclasses.replace(release, origins=moved.astype(np.float32), bases=bases))
    np.testing.assert_allclose(recover(affine(4), turned), expected, atol=1e-5)
    np.testing.assert_allclose(recover(affine(4), releases[::-1]), expected, atol=1e-5)
    order = rng.permutation(len(SECRET))
    moved = [dataclasses.replace(one, origins=one.origins[order], bases=one.bases[order]) for one in releases]
    np.testing.assert_allclose(recover(affine(4), moved), expected[order], atol=1e-6)


def test_liftings_that_share_a_word_intersect_in_a_line(rng):
    """The line contains the descriptor and the word. Its point nearest to zero is halfway between the two."""
    d, shared, *others = unit_rows(draw_features(4).codes).astype(float)
    origin = d[None].astype(np.float32)

    def through(*words: np.ndarray) -> Subspaces:
        basis = np.linalg.qr(np.stack([word - d for word in words], axis=1))[0].T.astype(np.float32)
        return Subspaces(positions=Points(keypoints=np.zeros((1, 2), np.float32)), size=(9, 9), origins=origin, bases=basis[None])

    met = find_common_points([through(shared, others[0]), through(shared, others[1])])[0]
    np.testing.assert_allclose(met, (d + shared) / 2, atol=1e-5)
    third = find_common_points([through(shared, others[0]), through(shared, others[1]), through(*others)])[0]
    np.testing.assert_allclose(third, d, atol=1e-5)


# ---- word sets


def enumerate_success(epsilon: float, domain: int, size: int, releases: int) -> float:
    """Return the success of maximum likelihood over all T-tuples of sets, from the theorem's probabilities; v = 0 is true."""
    sets = list(itertools.combinations(range(domain), size))
    weight = domain / (size * math.exp(epsilon) + domain - size) / math.comb(domain, size)
    likelihood = np.array([[weight * math.exp(epsilon * (v in chosen)) for chosen in sets] for v in range(domain)])
    np.testing.assert_allclose(likelihood.sum(axis=1), 1)
    success = 0.0
    for drawn in itertools.product(range(len(sets)), repeat=releases):
        joint = likelihood[:, drawn].prod(axis=1)  # (K,)
        best = np.isclose(joint, joint.max(), rtol=1e-9)
        success += joint[0] * best[0] / best.sum()
    return success


@pytest.mark.parametrize(
    ("epsilon", "domain", "size", "releases"), [(1.0, 5, 2, 3), (2.5, 4, 1, 4), (0.5, 6, 3, 2), (3.0, 7, 2, 3)]
)
def test_success_agrees_with_enumeration(epsilon, domain, size, releases):
    chances = compute_success_chances(epsilon, domain, size, releases)
    expected = [enumerate_success(epsilon, domain, size, number) for number in range(1, releases + 1)]
    np.testing.assert_allclose(chances, expected, rtol=1e-9)


def measure_success(true: np.ndarray, others: np.ndarray, domain: int, releases: int, rng: np.random.Generator) -> float:
    """Return the fraction of true words that are found if the first set is theirs and the further sets are of `others`."""
    sets = [draw_word_subsets(true if number == 0 else others, domain, 2.0, 2, rng) for number in range(releases)]
    words = np.concatenate(sets, axis=1)
    return float((words[np.arange(len(words)), select_likeliest(words, rng)] == true).mean())


def test_success_agrees_with_trials_and_sets_of_other_words_do_not_help(rng):
    domain, trials = 12, 20_000
    true = rng.integers(domain, size=trials)
    others = (true + 1 + rng.integers(domain - 1, size=trials)) % domain
    once, *_, four = compute_success_chances(2.0, domain, 2, 4)
    spread = 4.5 * math.sqrt(0.25 / trials)
    assert abs(measure_success(true, true, domain, 1, rng) - once) < spread
    assert abs(measure_success(true, true, domain, 4, rng) - four) < spread
    assert four > once + 2 * spread
    assert measure_success(true, others, domain, 4, rng) < once - spread  # control: sets of another word


def test_success_is_within_the_bound_and_one_release_of_one_word_reaches_it():
    for epsilon, domain, size in ((0.5, 8, 2), (2.0, 30, 3), (10.0, 256_000, 2), (16.0, 256_000, 1)):
        for number, chance in enumerate(compute_success_chances(epsilon, domain, size, 5), start=1):
            assert chance <= bound_success(number * epsilon, domain) * (1 + 1e-9)
    once = compute_success_chances(10.0, 256_000, 1, 1)[0]
    assert once == pytest.approx(bound_success(10.0, 256_000), rel=1e-9)
    assert once > bound_success(9.9, 256_000)  # control: the bound can fail
    assert compute_success_chances(10.0, 256_000, 2, 1)[0] == pytest.approx(10 ** log10_chance(10.0, 256_000, 2) / 2)


def test_a_word_in_every_set_is_found(tmp_path):
    defense = LDP(epsilon=math.inf, subset_size=4, dictionary=write_dictionary(tmp_path))
    public = Public()
    nearest = unit_rows(public.dictionary(defense.dictionary).words[public.nearest_words(defense.dictionary, SECRET)])
    releases = release_repeatedly(defense, 5)
    found = recover(defense, releases)
    assert (found == nearest).all(axis=1).all()
    assert np.array_equal(recover(defense, releases[::-1], seed=1), found), "neither order nor ties decide"
    mixed = [releases[0], *release_repeatedly(defense, 4, OTHER)]
    assert not (recover(defense, mixed) == nearest).all(axis=1).any()  # control: the other word wins


def test_one_set_gives_one_of_its_words_reproducibly(tmp_path):
    defense = LDP(dictionary=write_dictionary(tmp_path))
    (release,) = release_repeatedly(defense, 1)
    found = recover(defense, [release])
    hits = (found[:, None] == release.candidates).all(axis=2)  # (N, m)
    assert hits.any(axis=1).all()
    assert 0 < hits[:, 0].mean() < 1
    assert np.array_equal(recover(defense, [release]), found)
    assert not np.array_equal(recover(defense, [release], seed=1), found)


def test_patterns_without_words_are_distinguished():
    defense = NaiveLDP(epsilon=math.inf)
    assert (recover(defense, release_repeatedly(defense, 3)) == SECRET.descriptors).all()
    random = NaiveLDP(epsilon=10)
    assert measure_errors(recover(random, release_repeatedly(random, 3))).min() > 0.1  # control: no pattern occurs twice


# ---- the plugin and the curve


def test_it_requests_the_declared_number_of_releases():
    assert Repeat(releases=3).repeats() == 2
    with pytest.raises(UserError, match="releases must be at least 1"):
        Repeat(releases=0)


@pytest.mark.slow
def test_curve():
    curve = multi_release.build_rows(10.0, 256_000, 2, 10)
    assert [row["releases"] for row in curve] == list(range(1, 11))
    assert [row["success"] for row in curve] == compute_success_chances(10.0, 256_000, 2, 10)
    assert all(row["success"] <= row["bound"] for row in curve)
    axes = multi_release.draw(curve).axes[0]
    assert [list(line.get_ydata()) for line in axes.lines] == [
        [row["bound"] for row in curve],
        [row["success"] for row in curve],
    ]


def test_it_needs_one_order_of_keypoints():
    """Defenses that hide positions shuffle the keypoints of each release."""
    composed = compose([RandomLines(), LDP()])
    assert "random order" in Repeat().explain_not_applicable(composed, Sift(), Public())
    assert Repeat().explain_not_applicable(LDP(), Sift(), Public()) is None  # control
