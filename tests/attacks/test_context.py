"""The context attack: arithmetic and training against enumeration, for synthetic words of known co-occurrence."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as nnf
from sklearn.neighbors import NearestNeighbors
from train_word_attackers import Stage, fit

from attacks.context import Context
from attacks.dia import DIA
from bench.api import View
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import ASSETS, Public
from bench.context import weights
from bench.context.encoding import MAX_LOG_ODDS, build_graph, find_nearest_keypoints, find_reverse_edges, log_odds
from bench.context.network import ContextModel, Shape, compute_probabilities, propagate
from bench.context.train import Example, build_example, compute_loss, compute_pair_loss, validate
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs
from bench.inversion.train import check_quantisation
from bench.mechanisms.subset import draw_word_subsets, log10_chance
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Points, WordSets
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP

pytestmark = pytest.mark.slow

# ---- belief propagation


def test_one_round_is_exact_for_a_star(rng):
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
        torch.full((1 + leaves, leaves), (1 + leaves) * leaves),
        rounds=1,
    )
    np.testing.assert_allclose(found[0], np.log(expected[:m] / expected[m]), atol=1e-12)
    np.testing.assert_allclose(found[1:], alone[1:])  # the leaves get no messages
    np.testing.assert_allclose(compute_probabilities(found)[0], expected[:m] / expected.sum(), atol=1e-12)


def test_rounds_converge_to_the_exact_posterior_of_a_chain(rng):
    """Against the sum over all (m + 1)^4 states. Control: if messages return to their sender, the posterior is another."""
    m, count = 2, 4
    alone = rng.normal(size=(count, m))
    links = rng.normal(scale=1.5, size=(count - 1, m, m))  # of each keypoint and the next
    joint = np.zeros((m + 1,) * count)
    padded = np.pad(links, ((0, 0), (0, 1), (0, 1)))
    for state in itertools.product(range(m + 1), repeat=count):
        energy = sum(alone[node, choice] for node, choice in enumerate(state) if choice < m)
        joint[state] = math.exp(energy + sum(padded[link, state[link], state[link + 1]] for link in range(count - 1)))
    expected = np.stack([joint.sum(axis=tuple(set(range(count)) - {node})) for node in range(count)])  # (count, m + 1)
    neighbours = np.array([[0, 1], [0, 2], [1, 3], [2, 0]])  # the previous one and the next one
    present = np.array([[0, 1], [1, 1], [1, 1], [1, 0]], dtype=np.float32)
    ratios = np.zeros((count, 2, m, m))
    ratios[1:, 0], ratios[:-1, 1] = links.transpose(0, 2, 1), links
    reverse = find_reverse_edges(neighbours, present)
    assert reverse.tolist() == [[8, 2], [1, 4], [3, 6], [5, 8]]

    def estimate(reverse: np.ndarray) -> np.ndarray:
        inputs = map(torch.from_numpy, (alone, ratios, present.astype(float), neighbours, reverse))
        return compute_probabilities(propagate(*inputs, rounds=60)).numpy()

    exact = (expected / expected.sum(axis=1, keepdims=True))[:, :m]
    np.testing.assert_allclose(estimate(reverse), exact, atol=1e-9)
    assert np.abs(estimate(np.full_like(reverse, 8)) - exact).max() > 0.01


# ---- training, in a world of chains

WORDS, LINKS, SIZE, EPSILON, STEP = 8, 4, 2, 2.0, 8.0
FOLLOWS = 0.85 * np.roll(np.eye(WORDS), 1, axis=1) + 0.15 / WORDS  # P(next | word): mostly the word's successor


def draw_chains(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw true words of chains of keypoints and the released sets. -> (count, LINKS), (count, LINKS, m)"""
    true = np.empty((count, LINKS), dtype=np.int64)
    true[:, 0] = rng.integers(WORDS, size=count)
    for link in range(1, LINKS):
        cumulated = FOLLOWS[true[:, link - 1]].cumsum(axis=1)
        true[:, link] = (rng.random((count, 1)) > cumulated[:, :-1]).sum(axis=1)
    sets = draw_word_subsets(true.ravel(), WORDS, EPSILON, SIZE, rng)
    return true, sets.reshape(count, LINKS, SIZE)


def build_world(true: np.ndarray, sets: np.ndarray) -> Example:
    """Build one graph of all chains: a chain runs to the right, the next one is far below."""
    rows, columns = np.divmod(np.arange(true.size), LINKS)
    keypoints = np.stack([columns * STEP, rows * 20 * STEP], axis=1).astype(np.float32)
    words = sets.reshape(-1, SIZE)
    candidates = np.eye(WORDS, dtype=np.float32)[words]
    size = (int(LINKS * STEP), int(len(true) * 20 * STEP))
    release = WordSets(positions=Points(keypoints=keypoints), size=size, candidates=candidates, words=words)
    hit = words == true.reshape(-1, 1)
    labels = np.where(hit.any(axis=1), hit.argmax(axis=1), SIZE)
    odds = log_odds(log10_chance(EPSILON, WORDS, SIZE), SIZE)
    truth = np.eye(WORDS, dtype=np.float32)[true.ravel()]
    return Example(build_graph([release], [odds], LINKS - 1), torch.from_numpy(labels), torch.from_numpy(truth))


def enumerate_posterior(sets: np.ndarray) -> np.ndarray:
    """Return the posterior of each candidate and of none, summed over all chains. (count, LINKS, m) -> (count LINKS, m + 1)"""
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
def trained(tmp_path_factory) -> ContextModel:
    shape = Shape(length=WORDS, width=24, rank=12, neighbours=LINKS - 1, layers=1, kernels=4)
    return train(shape, 64, (100, 200), tmp_path_factory.mktemp("checkpoints"))


def train(shape: Shape, chains: int, steps: tuple[int, int], folder: Path, seed: int = 0) -> ContextModel:
    """Train in this world, in two stages. In the first, every set holds the true word and a random one."""

    def draw_pairs(rng: np.random.Generator) -> Example:
        true, _ = draw_chains(chains, rng)
        false = (true + rng.integers(1, WORDS, true.shape)) % WORDS
        return build_world(true, np.sort(np.stack([true, false], axis=2), axis=2))

    def draw(rng: np.random.Generator) -> Example:
        return build_world(*draw_chains(chains, rng))

    torch.manual_seed(seed)
    module = ContextModel(shape)
    stages = ("pairs", draw_pairs, compute_pair_loss), ("releases", draw, compute_loss)
    for number, (name, examples, loss) in enumerate(stages):
        stage = Stage(
            name=name,
            number=number,
            steps=steps[number],
            rate=1e-2,
            average=0.95,
            loss=lambda module, rng, loss=loss, examples=examples: loss(module, examples(rng)),
            warmup=10,
            seed=seed,
        )
        fit(module, stage, folder / f"{name}-{seed}", "")
    return module


@torch.no_grad()
def evaluate(module: ContextModel, example: Example) -> tuple[np.ndarray, float, float]:
    """Return the posterior, its cross-entropy, and the fraction of keypoints whose true word it picks."""
    belief = module(example.graph)
    picked = (belief.odds.argmax(dim=1) == example.labels).float().mean()
    return belief.logits.softmax(dim=1).numpy(), float(nnf.cross_entropy(belief.logits, example.labels)), float(picked)


@pytest.mark.slow
def test_training_learns_the_enumerated_posterior(trained):
    true, sets = draw_chains(400, np.random.default_rng(1))
    example = build_world(true, sets)
    exact = enumerate_posterior(sets)
    rows = np.arange(len(exact))
    lower_bound = -np.log(exact[rows, example.labels]).mean()
    upper_bound = evaluate(ContextModel(trained.shape).eval(), example)[1]  # untrained: the prior
    prior = 10 ** log10_chance(EPSILON, WORDS, SIZE)
    covered = (example.labels < SIZE).float().mean().item()
    assert upper_bound == pytest.approx(-covered * math.log(prior / SIZE) - (1 - covered) * math.log(1 - prior), abs=1e-5)
    posterior, loss, picked = evaluate(trained, example)
    best = (exact[:, :SIZE].argmax(axis=1) == example.labels.numpy()).mean()
    assert lower_bound < loss < lower_bound + 0.2 * (upper_bound - lower_bound)
    assert np.abs(posterior - exact).mean() < 0.06
    assert picked > best - 0.02
    assert best > covered / SIZE + 0.1, "context must be informative in this world"


@pytest.mark.slow
def test_without_context_it_is_at_chance(trained):
    """Negative control: the same sets at other keypoints."""
    true, sets = draw_chains(400, np.random.default_rng(1))
    order = np.random.default_rng(2).permutation(true.size)
    example = build_world(true.ravel()[order].reshape(true.shape), sets.reshape(-1, SIZE)[order].reshape(sets.shape))
    _, loss, picked = evaluate(trained, example)
    chance = (example.labels < SIZE).float().mean().item() / SIZE
    assert picked < chance + 4 * math.sqrt(0.25 / true.size)
    assert loss > evaluate(ContextModel(trained.shape).eval(), example)[1]


def test_training_is_reproducible(tmp_path):
    shape = Shape(length=WORDS, width=8, rank=4, neighbours=3, layers=1, kernels=2)
    runs = ("once", 0), ("again", 0), ("other", 1)
    for name, _ in runs:
        (tmp_path / name).mkdir()
    once, again, other = (train(shape, 4, (2, 3), tmp_path / name, seed).state_dict() for name, seed in runs)
    assert all(torch.equal(once[name], again[name]) for name in once)
    assert not all(torch.equal(once[name], other[name]) for name in once)


# ---- graphs


def test_log_odds():
    assert log_odds(math.log10(0.2), 4) == pytest.approx(math.log(0.05 / 0.8))
    assert log_odds(0.0, 2) == MAX_LOG_ODDS
    assert log_odds(-300.0, 2) == -MAX_LOG_ODDS


def test_nearest_keypoints(rng):
    keypoints = rng.uniform(0, 256, (50, 2)).astype(np.float32)
    near, present = find_nearest_keypoints(keypoints, 5)
    distances = np.linalg.norm(keypoints[:, None] - keypoints, axis=2) + np.diag(np.full(50, np.inf))
    assert np.array_equal(near, distances.argsort(axis=1)[:, :5])
    assert present.all()
    near, present = find_nearest_keypoints(keypoints[:3], 5)
    assert np.array_equal(np.sort(near[:, :2], axis=1), [[1, 2], [0, 2], [0, 1]])
    assert np.array_equal(present, [[1, 1, 0, 0, 0]] * 3)
    assert not find_nearest_keypoints(keypoints[:1], 5)[1].any()


def test_keypoints_must_be_finite():
    with pytest.raises(ValueError, match="keypoints must be finite"):
        find_nearest_keypoints(np.float32([[1, 1], [np.nan, 2]]), 1)


def test_no_keypoint_is_its_own_neighbour_among_coincident_ones():
    keypoints = np.repeat(np.float32([[1, 1], [9, 9]]), 8, axis=0)
    near, _ = find_nearest_keypoints(keypoints, 3)
    assert (near != np.arange(16)[:, None]).all()
    assert np.array_equal(keypoints[near], np.repeat(keypoints[:, None], 3, axis=1))


def test_nearest_keypoints_are_those_of_scikit_learn(rng):
    keypoints = rng.uniform(0, 256, (700, 2)).astype(np.float32)
    reference = NearestNeighbors(n_neighbors=20).fit(keypoints).kneighbors(return_distance=False)
    assert np.array_equal(find_nearest_keypoints(keypoints, 20)[0], reference)


def test_releases_in_one_graph_are_independent(trained):
    one, other = (build_world(*draw_chains(2, np.random.default_rng(seed))).graph for seed in (1, 2))
    releases = [
        WordSets(
            positions=Points(keypoints=part.positions.numpy() * 99), size=(9, 9), candidates=part.candidates.numpy(), words=None
        )
        for part in (one, other)
    ]
    with torch.no_grad():
        both = trained(build_graph(releases, [0.0, 0.0], 3)).odds
        separate = torch.cat([trained(build_graph([release], [0.0], 3)).odds for release in releases])
    torch.testing.assert_close(both, separate)


# ---- the shipped network


@pytest.fixture(scope="module")
def public():
    return Public()


@pytest.fixture(scope="module")
def secret():
    return Sift().extract(photographs.read(photographs.list_builtin()[0].path).pixels)


def recover(release: WordSets, defense: LDP, public: Public, estimate: str = "mean") -> np.ndarray:
    view = View(release=release, defense=defense, extractor=Sift(), knowledge={PublicAssets: lambda: PublicAssets(assets=public)})
    return Context(estimate=estimate).recover(view, np.random.default_rng(0))


def reorder(release: WordSets, rows: np.ndarray) -> WordSets:
    return dataclasses.replace(
        release, positions=release.positions.take(rows), candidates=release.candidates[rows], words=release.words[rows]
    )


def measure_angle(found: np.ndarray, truth: np.ndarray) -> float:
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((found * truth).sum(axis=1), -1, 1))).mean())


@pytest.mark.slow
@pytest.mark.parametrize(("epsilon", "size"), [(10.0, 2), (12.0, 4)])
def test_beats_chance_on_a_photograph_and_needs_the_nearby_keypoints(public, secret, epsilon, size):
    defense = LDP(epsilon=epsilon, subset_size=size)
    release = defense.protect(secret, public, np.random.default_rng(3))
    true = public.dictionary("shipped").words[public.nearest_words("shipped", secret)].astype(float)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    words = recover(release, defense, public, "word")
    assert (words[:, None] == release.candidates).all(axis=2).any(axis=1).all()

    def count_picked(found: np.ndarray) -> float:
        return float((np.abs(found - true).max(axis=1) < 1e-6).mean())

    chance = float((release.words == public.nearest_words("shipped", secret)[:, None]).mean())
    assert count_picked(words) > 1.15 * chance
    mean = recover(release, defense, public, "mean")
    assert measure_angle(mean, secret.descriptors) < measure_angle(release.candidates.mean(axis=1), secret.descriptors) - 5
    # Control: each keypoint keeps its set at another position.
    order = np.random.default_rng(4).permutation(len(release))
    moved = dataclasses.replace(release, positions=release.positions.take(order))
    assert count_picked(recover(moved, defense, public, "word")) < count_picked(words)
    assert (
        measure_angle(recover(moved, defense, public, "mean"), secret.descriptors) > measure_angle(mean, secret.descriptors) + 1
    )


def test_the_estimate_is_reproducible_and_independent_of_order(public, secret):
    defense = LDP(epsilon=12, subset_size=3)
    release = defense.protect(secret, public, np.random.default_rng(3))
    found = recover(release, defense, public)
    assert found.dtype == np.float32
    assert np.array_equal(found, recover(release, defense, public))
    order = np.random.default_rng(4).permutation(len(release))
    # Ties in the distance of the last neighbour are rare and may be resolved differently.
    moved = np.abs(recover(reorder(release, order), defense, public) - found[order]).max(axis=1)
    assert (moved < 1e-3).mean() > 0.98
    turned = dataclasses.replace(release, candidates=release.candidates[:, ::-1].copy(), words=release.words[:, ::-1].copy())
    np.testing.assert_allclose(recover(turned, defense, public), found, atol=1e-3)


def test_applies_to_the_releases_it_was_trained_for(public, tmp_path):
    clustered = Asset("shipped-clustered")
    for defense in (LDP(), LDP(dictionary=clustered, words=8000, epsilon=6.534)):
        assert Context().explain_not_applicable(defense, Sift(), public) is None
        assert DIA().explain_not_applicable(defense, Sift(), public) is None
    for defense, reason in (
        (LDP(dictionary=clustered, words=4000), "words 8000, not 4000"),
        (LDP(dictionary=clustered, words=8000, epsilon=13), "epsilon 4.6 to 12.5, not 13"),
        (LDP(epsilon=20), "epsilon"),
        (LDP(subset_size=5), "subset_size"),
        (LDP(words=1000), "words"),
        (LDP(dictionary=write_dictionary(tmp_path)), "dictionary"),
        (NaiveLDP(), "trained for ldp"),
    ):
        explanation = Context().explain_not_applicable(defense, Sift(), public)
        assert "no adapted attacker" in (explanation or "")
        assert reason in (explanation or "")
    assert "upright" in (Context().explain_not_applicable(LDP(), Sift(upright=False), public) or "")


def test_the_shipped_network_follows_the_rules(public, shared_data):
    path = ASSETS / "context.safetensors"
    meta = weights.load(path).meta
    assert path.stat().st_size <= 2.2e6
    training_photographs = set(meta["photographs"])
    assert len(training_photographs) == 800  # those of the dictionary were quantised by cross-fit dictionaries
    assert public.dictionary("shipped").photographs < training_photographs
    names = [name for split in ("tune.txt", "test.txt") for name in (shared_data / split).read_text().split()]
    held_out = {photographs.Source(name, shared_data / "train" / name).content_hash() for name in names}
    assert not training_photographs & (held_out | {source.content_hash() for source in photographs.list_builtin()})
    check_quantisation(**meta["quantisation_error"])


def test_saved_weights_give_the_same_network(trained, tmp_path):
    path = tmp_path / "small.safetensors"
    digest = weights.save(path, trained, {"extractor": {}})
    network = weights.load(path)
    assert network.digest == digest
    for name, value in trained.state_dict().items():
        torch.testing.assert_close(network.module.state_dict()[name], value, atol=2e-3, rtol=1e-3)
    other = ContextModel(dataclasses.replace(trained.shape, width=8))
    other.shape = trained.shape
    weights.save(path, other, {"extractor": {}})
    with pytest.raises(UserError, match="tensors do not match"):
        Context(weights=Asset(path)).assets(LDP(), Sift(), Public())  # when a plan is built, before anything is written
    with pytest.raises(UserError, match="no such file"):
        weights.load(tmp_path / "none.safetensors")


# ---- examples


def test_an_example_labels_the_true_candidate(tmp_path):
    defense = LDP(dictionary=write_dictionary(tmp_path))
    public = Public()
    secrets = [draw_features(30, seed) for seed in (1, 2)]
    nearest = np.concatenate([public.nearest_words(defense.dictionary, secret) for secret in secrets])
    words = public.dictionary(defense.dictionary).words
    defenses = [dataclasses.replace(defense, epsilon=epsilon) for epsilon in (math.inf, 6.0)]
    example = build_example(secrets, defenses, public, 4, np.random.default_rng(5))
    labels = example.labels.numpy()
    hit = labels < 2
    assert hit[:30].all()
    assert 0 < hit[30:].mean() < 1
    candidates = example.graph.candidates.numpy()
    true = unit_rows(words[nearest])
    assert (candidates[hit, labels[hit]] == true[hit]).all()
    assert not (candidates[~hit] == true[~hit, None]).all(axis=2).any()
    expected = [MAX_LOG_ODDS, log_odds(log10_chance(6.0, len(words), 2), 2)]
    np.testing.assert_allclose(example.graph.odds.numpy(), np.repeat(expected, 30), rtol=1e-6)
    assert np.array_equal(example.descriptors.numpy(), np.concatenate([secret.descriptors for secret in secrets]))


def test_an_untrained_network_is_validated_as_the_prior(tmp_path):
    defense = LDP(dictionary=write_dictionary(tmp_path), epsilon=5.0, subset_size=3)
    module = ContextModel(Shape(width=8, rank=4)).eval()
    row = validate(module, [draw_features(400)], defense, Public())
    assert row["posterior"] == pytest.approx(row["prior"], abs=1e-5)
    assert row["chance"] == pytest.approx(10 ** log10_chance(5.0, 512, 3) / 3, abs=4 * math.sqrt(0.25 / 400))
    assert row["picked"] == pytest.approx(row["chance"], abs=6 * math.sqrt(0.25 / 400))
