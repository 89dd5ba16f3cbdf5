"""The context attack: its arithmetic and its learning against enumeration in worlds whose co-occurrence is known."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as nnf

from attacks.context import Context
from bench.api import View
from bench.codebook.examples import example_features, small_dictionary
from bench.codebook.public import ASSETS, Public
from bench.context import weights
from bench.context.encoding import CERTAIN, log_odds, nearest_keypoints, scene
from bench.context.network import Shape, Surroundings, propagate, shares
from bench.context.train import Lesson, fit, lesson, lessons, validate
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs
from bench.images.views import PhotographView
from bench.inversion.plan import Training
from bench.inversion.train import check_quantisation
from bench.mechanisms.subset import log10_chance, word_subsets
from bench.types import Knowledge, WordSets
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP

# ---- passing beliefs


def test_one_round_is_exact_where_neighbours_hang_together_through_their_keypoint_alone(rng):
    """Against the sum over all (m + 1)^4 states of a star of four."""
    m, leaves = 2, 3
    alone = rng.normal(size=(1 + leaves, m))
    ratios = rng.normal(scale=1.5, size=(leaves, m, m))
    joint = np.zeros((m + 1,) * (1 + leaves))
    padded = np.pad(ratios, ((0, 0), (0, 1), (0, 1)))  # none has ratio 1 with everything
    for state in itertools.product(range(m + 1), repeat=1 + leaves):
        energy = sum(alone[node, choice] for node, choice in enumerate(state) if choice < m)
        energy += sum(padded[leaf, state[0], state[1 + leaf]] for leaf in range(leaves))
        joint[state] = math.exp(energy)
    expected = joint.sum(axis=(1, 2, 3))
    found = propagate(
        torch.from_numpy(alone),
        torch.from_numpy(np.stack([ratios] + [np.zeros_like(ratios)] * leaves)),
        torch.from_numpy(np.stack([np.ones(leaves)] + [np.zeros(leaves)] * leaves)),
        torch.tensor([[1, 2, 3]] * (1 + leaves)),
        rounds=1,
    )
    np.testing.assert_allclose(found[0], np.log(expected[:m] / expected[m]), atol=1e-12)
    np.testing.assert_allclose(found[1:], alone[1:])  # nothing is told to the leaves
    np.testing.assert_allclose(shares(found)[0], expected[:m] / expected.sum(), atol=1e-12)


# ---- learning, in a world of chains

WORDS, LINKS, SIZE, EPSILON, STEP = 8, 4, 2, 2.0, 8.0
FOLLOWS = 0.85 * np.roll(np.eye(WORDS), 1, axis=1) + 0.15 / WORDS  # P(next | word): mostly the word's successor


def chains(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """True words of chains of keypoints, and the sets that are released. -> (count, LINKS), (count, LINKS, m)"""
    true = np.empty((count, LINKS), dtype=np.int64)
    true[:, 0] = rng.integers(WORDS, size=count)
    for link in range(1, LINKS):
        cumulated = FOLLOWS[true[:, link - 1]].cumsum(axis=1)
        true[:, link] = (rng.random((count, 1)) > cumulated[:, :-1]).sum(axis=1)
    sets = word_subsets(true.ravel(), WORDS, EPSILON, SIZE, rng)
    return true, sets.reshape(count, LINKS, SIZE)


def world(true: np.ndarray, sets: np.ndarray) -> Lesson:
    """One scene of them all: a chain runs to the right, the next one is far below."""
    rows, columns = np.divmod(np.arange(true.size), LINKS)
    keypoints = np.stack([columns * STEP, rows * 20 * STEP], axis=1).astype(np.float32)
    words = sets.reshape(-1, SIZE)
    candidates = np.eye(WORDS, dtype=np.float32)[words]
    size = (int(LINKS * STEP), int(len(true) * 20 * STEP))
    release = WordSets(keypoints=keypoints, size=size, candidates=candidates, words=words)
    hit = words == true.reshape(-1, 1)
    told = np.where(hit.any(axis=1), hit.argmax(axis=1), SIZE)
    odds = log_odds(log10_chance(EPSILON, WORDS, SIZE), SIZE)
    truth = np.eye(WORDS, dtype=np.float32)[true.ravel()]
    return Lesson(scene([release], [odds], LINKS - 1), torch.from_numpy(told), torch.from_numpy(truth))


def by_enumeration(sets: np.ndarray) -> np.ndarray:
    """Posterior of each candidate and of none, summed over all WORDS^LINKS chains. (count, LINKS, m) -> (count LINKS, m + 1)"""
    every = np.array(list(itertools.product(range(WORDS), repeat=LINKS)))  # (E, LINKS)
    prior = np.full(len(every), 1 / WORDS)
    for link in range(1, LINKS):
        prior *= FOLLOWS[every[:, link - 1], every[:, link]]
    posterior = np.zeros((*sets.shape[:2], SIZE + 1))
    for row, released in zip(posterior, sets, strict=True):
        hits = (every[:, :, None] == released).any(axis=2)  # (E, LINKS)
        weight = prior * np.exp(EPSILON * hits.sum(axis=1))
        for link in range(LINKS):
            for column in range(SIZE):
                row[link, column] = weight[every[:, link] == released[link, column]].sum()
            row[link, SIZE] = weight[~hits[:, link]].sum()
    return (posterior / posterior.sum(axis=2, keepdims=True)).reshape(-1, SIZE + 1)


@pytest.fixture(scope="module")
def learned() -> Surroundings:
    shape = Shape(length=WORDS, width=24, rank=12, neighbours=LINKS - 1, layers=1, kernels=4)
    return fit(shape, lambda rng: world(*chains(64, rng)), Training(steps=250, batch=1, rate=1e-2, warmup=10, average=0.95))


@torch.no_grad()
def judged(module: Surroundings, taught: Lesson) -> tuple[np.ndarray, float, float]:
    """The posterior, its cross-entropy, and the share of keypoints whose true word it picks."""
    belief = module(taught.scene)
    picked = (belief.odds.argmax(dim=1) == taught.told).float().mean()
    return belief.logits.softmax(dim=1).numpy(), float(nnf.cross_entropy(belief.logits, taught.told)), float(picked)


def test_learns_the_posterior_that_enumeration_gives(learned):
    true, sets = chains(400, np.random.default_rng(1))
    taught = world(true, sets)
    exact = by_enumeration(sets)
    rows = np.arange(len(exact))
    floor = -np.log(exact[rows, taught.told]).mean()
    ceiling = judged(Surroundings(learned.shape).eval(), taught)[1]  # untrained: the prior
    prior = 10 ** log10_chance(EPSILON, WORDS, SIZE)
    told = (taught.told < SIZE).float().mean().item()
    assert ceiling == pytest.approx(-told * math.log(prior / SIZE) - (1 - told) * math.log(1 - prior), abs=1e-5)
    posterior, loss, picked = judged(learned, taught)
    best = (exact[:, :SIZE].argmax(axis=1) == taught.told.numpy()).mean()
    assert floor < loss < floor + 0.2 * (ceiling - floor)
    assert np.abs(posterior - exact).mean() < 0.06
    assert picked > best - 0.02
    assert best > told / SIZE + 0.1, "the world is one where context tells"


def test_without_context_it_does_no_better_than_chance(learned):
    """Control: the same sets, dealt to other keypoints."""
    true, sets = chains(400, np.random.default_rng(1))
    order = np.random.default_rng(2).permutation(true.size)
    taught = world(true.ravel()[order].reshape(true.shape), sets.reshape(-1, SIZE)[order].reshape(sets.shape))
    _, loss, picked = judged(learned, taught)
    chance = (taught.told < SIZE).float().mean().item() / SIZE
    assert picked < chance + 4 * math.sqrt(0.25 / true.size)
    assert loss > judged(Surroundings(learned.shape).eval(), taught)[1]


def test_learning_repeats():
    shape = Shape(length=WORDS, width=8, rank=4, neighbours=3, layers=1, kernels=2)
    once, again, other = (
        fit(shape, lambda rng: world(*chains(4, rng)), Training(steps=3, batch=1, seed=seed)).state_dict() for seed in (0, 0, 1)
    )
    assert all(torch.equal(once[name], again[name]) for name in once)
    assert not all(torch.equal(once[name], other[name]) for name in once)


# ---- scenes


def test_log_odds():
    assert log_odds(math.log10(0.2), 4) == pytest.approx(math.log(0.05 / 0.8))
    assert log_odds(0.0, 2) == CERTAIN
    assert log_odds(-300.0, 2) == -CERTAIN


def test_nearest_keypoints(rng):
    keypoints = rng.uniform(0, 256, (50, 2)).astype(np.float32)
    near, present = nearest_keypoints(keypoints, 5)
    distances = np.linalg.norm(keypoints[:, None] - keypoints, axis=2) + np.diag(np.full(50, np.inf))
    assert np.array_equal(near, distances.argsort(axis=1)[:, :5])
    assert present.all()
    near, present = nearest_keypoints(keypoints[:3], 5)
    assert np.array_equal(np.sort(near[:, :2], axis=1), [[1, 2], [0, 2], [0, 1]])
    assert np.array_equal(present, [[1, 1, 0, 0, 0]] * 3)
    assert not nearest_keypoints(keypoints[:1], 5)[1].any()


def test_releases_side_by_side_do_not_see_each_other(learned):
    one, other = (world(*chains(2, np.random.default_rng(seed))).scene for seed in (1, 2))
    releases = [
        WordSets(keypoints=part.places.numpy() * 99, size=(9, 9), candidates=part.candidates.numpy(), words=None)
        for part in (one, other)
    ]
    with torch.no_grad():
        both = learned(scene(releases, [0.0, 0.0], 3)).odds
        apart = torch.cat([learned(scene([release], [0.0], 3)).odds for release in releases])
    torch.testing.assert_close(both, apart)


# ---- the shipped network


@pytest.fixture(scope="module")
def public():
    return Public()


@pytest.fixture(scope="module")
def secret():
    return Sift().extract(photographs.read(photographs.builtin()[0].path).pixels)


def recovered(release: WordSets, defense: LDP, public: Public, estimate: str = "mean") -> np.ndarray:
    view = View(release=release, defense=defense, extractor=Sift(), knowledge={Knowledge.TRAINING_IMAGES: lambda: public})
    return Context(estimate=estimate).recover(view, np.random.default_rng(0))


def reordered(release: WordSets, rows: np.ndarray) -> WordSets:
    return dataclasses.replace(
        release, keypoints=release.keypoints[rows], candidates=release.candidates[rows], words=release.words[rows]
    )


def angle(found: np.ndarray, truth: np.ndarray) -> float:
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((found * truth).sum(axis=1), -1, 1))).mean())


@pytest.mark.parametrize(("epsilon", "size"), [(10.0, 2), (12.0, 4)])
def test_beats_chance_on_a_photograph_and_needs_its_surroundings(public, secret, epsilon, size):
    defense = LDP(epsilon=epsilon, subset_size=size)
    release = defense.protect(secret, public, np.random.default_rng(3))
    true = public.dictionary("shipped").words[public.nearest_words("shipped", secret)].astype(float)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    words = recovered(release, defense, public, "word")
    assert (words[:, None] == release.candidates).all(axis=2).any(axis=1).all()

    def picked(found: np.ndarray) -> float:
        return float((np.abs(found - true).max(axis=1) < 1e-6).mean())

    chance = float((release.words == public.nearest_words("shipped", secret)[:, None]).mean())
    assert picked(words) > 1.15 * chance
    mean = recovered(release, defense, public, "mean")
    assert angle(mean, secret.descriptors) < angle(release.candidates.mean(axis=1), secret.descriptors) - 5
    # Control: each keypoint keeps its set, but stands elsewhere.
    order = np.random.default_rng(4).permutation(len(release))
    moved = dataclasses.replace(release, keypoints=release.keypoints[order])
    assert picked(recovered(moved, defense, public, "word")) < picked(words)
    assert angle(recovered(moved, defense, public, "mean"), secret.descriptors) > angle(mean, secret.descriptors) + 1


def test_order_carries_nothing_and_it_repeats(public, secret):
    defense = LDP(epsilon=12, subset_size=3)
    release = defense.protect(secret, public, np.random.default_rng(3))
    found = recovered(release, defense, public)
    assert found.dtype == np.float32
    assert np.array_equal(found, recovered(release, defense, public))
    order = np.random.default_rng(4).permutation(len(release))
    # A keypoint whose last neighbour is as far as one left out may see the other of the two, and is rare.
    moved = np.abs(recovered(reordered(release, order), defense, public) - found[order]).max(axis=1)
    assert (moved < 1e-3).mean() > 0.98
    turned = dataclasses.replace(release, candidates=release.candidates[:, ::-1].copy(), words=release.words[:, ::-1].copy())
    np.testing.assert_allclose(recovered(turned, defense, public), found, atol=1e-3)


def test_applies_where_it_was_trained_for(public, tmp_path):
    assert Context().explain_not_applicable(LDP(), Sift(), public) is None
    for defense, reason in (
        (LDP(epsilon=20), "epsilon"),
        (LDP(subset_size=5), "subset_size"),
        (LDP(words=1000), "words"),
        (LDP(dictionary=small_dictionary(tmp_path)), "dictionary"),
        (NaiveLDP(), "trained for ldp"),
    ):
        told = Context().explain_not_applicable(defense, Sift(), public)
        assert "no adapted attacker" in (told or "")
        assert reason in (told or "")
    assert "upright" in (Context().explain_not_applicable(LDP(), Sift(upright=False), public) or "")


def test_the_shipped_network_keeps_the_rules(public, shared_data):
    path = ASSETS / "context.safetensors"
    meta = weights.load(path).meta
    assert path.stat().st_size <= 2e6
    learned_from = set(meta["photographs"])
    assert len(learned_from) == 266
    assert not learned_from & public.dictionary("shipped").photographs
    names = [name for split in ("tune.txt", "test.txt") for name in (shared_data / split).read_text().split()]
    held_out = {photographs.Source(name, shared_data / "train" / name).content_hash() for name in names}
    assert not learned_from & (held_out | {source.content_hash() for source in photographs.builtin()})
    check_quantisation(**meta["quantisation_error"])


def test_weights_keep_the_network(learned, tmp_path):
    path = tmp_path / "small.safetensors"
    digest = weights.save(path, learned, {"extractor": {}})
    network = weights.load(path)
    assert network.digest == digest
    for name, value in learned.state_dict().items():
        torch.testing.assert_close(network.module.state_dict()[name], value, atol=2e-3, rtol=1e-3)
    other = Surroundings(dataclasses.replace(learned.shape, width=8))
    other.shape = learned.shape
    weights.save(path, other, {"extractor": {}})
    with pytest.raises(UserError, match="tensors are not those"):
        weights.load(path)
    with pytest.raises(UserError, match="no such file"):
        weights.load(tmp_path / "none.safetensors")


# ---- lessons


def test_a_lesson_tells_which_candidate_is_true(tmp_path):
    defense = LDP(dictionary=small_dictionary(tmp_path))
    public = Public()
    secrets = [example_features(30, seed) for seed in (1, 2)]
    nearest = np.concatenate([public.nearest_words(defense.dictionary, secret) for secret in secrets])
    words = public.dictionary(defense.dictionary).words
    defenses = [dataclasses.replace(defense, epsilon=epsilon) for epsilon in (math.inf, 6.0)]
    taught = lesson(secrets, defenses, public, 4, np.random.default_rng(5))
    told = taught.told.numpy()
    hit = told < 2
    assert hit[:30].all()
    assert 0 < hit[30:].mean() < 1
    candidates = taught.scene.candidates.numpy()
    true = unit_rows(words[nearest])
    assert (candidates[hit, told[hit]] == true[hit]).all()
    assert not (candidates[~hit] == true[~hit, None]).all(axis=2).any()
    expected = [CERTAIN, log_odds(log10_chance(6.0, len(words), 2), 2)]
    np.testing.assert_allclose(taught.scene.odds.numpy(), np.repeat(expected, 30), rtol=1e-6)
    assert np.array_equal(taught.truth.numpy(), np.concatenate([secret.descriptors for secret in secrets]))


def test_lessons_are_crops_under_settings_that_are_served(tmp_path):
    defense = LDP(dictionary=small_dictionary(tmp_path))
    features = example_features(200)
    large = dataclasses.replace(features, keypoints=features.keypoints * 1.25, size=(320, 320))
    view = PhotographView("made-up", np.zeros((320, 320, 3), np.uint8), large)
    served = {field: LDP.supported_settings[field] for field in ("epsilon", "subset_size")}
    draw = lessons([view], defense, served, "subset_size", Public(), 4, 3)
    drawn = [draw(np.random.default_rng(seed)) for seed in range(8)]
    assert {taught.scene.candidates.shape[1] for taught in drawn} == {1, 2, 3, 4}
    assert all(len(taught.scene.odds.unique()) == 3 for taught in drawn)  # an ε for each
    assert all(3 * 80 < len(taught.told) < 3 * 180 for taught in drawn)  # about 0.64 of 200
    assert all(taught.scene.places.abs().max() <= 1 for taught in drawn)


def test_an_untrained_network_is_validated_as_the_prior(tmp_path):
    defense = LDP(dictionary=small_dictionary(tmp_path), epsilon=5.0, subset_size=3)
    module = Surroundings(Shape(width=8, rank=4)).eval()
    row = validate(module, [example_features(400)], defense, Public())
    assert row["posterior"] == pytest.approx(row["prior"], abs=1e-5)
    assert row["chance"] == pytest.approx(10 ** log10_chance(5.0, 512, 3) / 3, abs=4 * math.sqrt(0.25 / 400))
    assert row["picked"] == pytest.approx(row["chance"], abs=6 * math.sqrt(0.25 / 400))
