"""The attack dia on word sets: the network reads each candidate with its posterior."""

import dataclasses

import numpy as np
import pytest
import torch

from attacks.dia import DIA
from bench.api import View
from bench.codebook.public import ASSETS, Public
from bench.context import weights as context_weights
from bench.context.encoding import prior_odds
from bench.context.reconstruct import compute_log_posteriors, encode_posteriors, reconstruct_from_posteriors
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.identification.distractors import load_distractors, rank_photograph
from bench.images import photographs
from bench.inversion import weights
from bench.inversion.symmetry import IDENTITY, find_symmetries
from bench.threat_model import PublicAssets
from bench.types import WordSets
from defenses.ldp import LDP
from metrics.ssim import SSIM

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pixels():
    return photographs.read(next(item.path for item in photographs.list_builtin() if "astronaut" in item.name)).pixels


@pytest.fixture(scope="module")
def network():
    return weights.load(ASSETS / "inversion-ldp.safetensors")


@pytest.fixture(scope="module")
def context():
    return context_weights.load(ASSETS / "context.safetensors")


def release_photograph(pixels: np.ndarray, defense: LDP) -> WordSets:
    return defense.protect(Sift().extract(pixels), Public(), np.random.default_rng(0))


def test_posteriors_improve_the_reconstruction_and_those_of_other_keypoints_do_not(pixels, network, context):
    """Controls: the prior, which is equal for all candidates, and the right posteriors at wrong keypoints."""
    defense = LDP(epsilon=12.0)
    release = release_photograph(pixels, defense)
    odds = prior_odds(defense, Public(), release.subset_size)
    logs = compute_log_posteriors(context.module, release, odds)
    prior = torch.log_softmax(torch.tensor([[odds, odds, 0.0]]), dim=1).expand(len(logs), -1)
    moved = logs[np.random.default_rng(1).permutation(len(logs))]

    def score(posteriors: torch.Tensor) -> float:
        with torch.inference_mode():
            image = network.module(encode_posteriors(release, posteriors, odds))[0].clamp(0, 1)
        return SSIM()(pixels / np.float32(255), image.permute(1, 2, 0).numpy())

    scores = score(logs), score(prior), score(moved)
    assert scores[0] > max(scores[1:]) + 0.05, scores


def test_order_of_the_candidates_has_no_effect(pixels, network, context, monkeypatch):
    """In float32. In bf16 the sums of the candidates round differently: by up to 0.04 in a few pixels."""
    monkeypatch.setattr("bench.inversion.reconstruct.pick_dtype", lambda device: torch.float32)
    defense = LDP(epsilon=12.0, subset_size=3)
    release = release_photograph(pixels, defense)
    turned = dataclasses.replace(
        release, candidates=release.candidates[:, ::-1].copy(), words=np.ascontiguousarray(release.words[:, ::-1])
    )
    odds = prior_odds(defense, Public(), 3)
    images = [reconstruct_from_posteriors(network.module, context.module, one, odds, [IDENTITY]) for one in (release, turned)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-4)
    assert images[0].std() > 0.1


def test_the_reconstruction_of_the_mirrored_release_is_mirrored(pixels, network, context, monkeypatch):
    """In float32. Control: the posteriors of the two views differ, so that of one alone would not do."""
    monkeypatch.setattr("bench.inversion.reconstruct.pick_dtype", lambda device: torch.float32)
    defense = LDP(epsilon=10.0)
    release = release_photograph(pixels, defense)
    mirror = find_symmetries(Sift())[1]
    odds = prior_odds(defense, Public(), release.subset_size)

    def reconstruct(one: WordSets) -> np.ndarray:
        return reconstruct_from_posteriors(network.module, context.module, one, odds, [IDENTITY, mirror])

    mirrored = reconstruct(mirror.transform_release(release))[:, ::-1]
    assert mirror.mirrored
    assert not mirror.turns
    np.testing.assert_allclose(reconstruct(release), mirrored, atol=1e-3)
    logs = [compute_log_posteriors(context.module, one, odds) for one in (release, mirror.transform_release(release))]
    assert (logs[0] - logs[1]).abs().max() > 0.1


def test_a_candidate_of_posterior_zero_has_no_effect(pixels, network):
    """Control: the same candidate with a posterior of one half has an effect."""
    release = release_photograph(pixels, LDP(epsilon=12.0))
    other = dataclasses.replace(release, candidates=np.stack([release.candidates[:, 0], release.candidates[::-1, 1]], axis=1))

    def reconstruct(one: WordSets, logs: list[float]) -> np.ndarray:
        with torch.inference_mode():
            return network.module(encode_posteriors(one, torch.tensor(logs).expand(len(one), -1), 0.0)).numpy()

    assert np.array_equal(reconstruct(release, [0.0, -np.inf, -12.0]), reconstruct(other, [0.0, -np.inf, -12.0]))
    half = [float(np.log(0.5)), float(np.log(0.5)), -12.0]
    assert np.abs(reconstruct(release, half) - reconstruct(other, half)).max() > 0.05


@pytest.mark.parametrize("meta", [{"context": "sha256:00"}, {}], ids=["another", "none"])
def test_another_context_model_is_refused_before_anything_is_written(network, monkeypatch, meta):
    named = {key: value for key, value in network.meta.items() if key != "context"}
    changed = dataclasses.replace(network, meta=named | meta)
    monkeypatch.setattr(weights, "load", lambda path: changed)
    with pytest.raises(UserError, match="another context model"):
        DIA().assets(LDP(), Sift(), Public())


def test_posteriors_are_those_of_the_attacked_release(pixels):
    """The attack knows no true word: a release of random words gives no photograph."""
    defense, public = LDP(epsilon=12.0), Public()
    release = release_photograph(pixels, defense)
    random = np.sort(np.random.default_rng(0).integers(256_000, size=release.words.shape), axis=1)
    words = public.dictionary("shipped").words[random].astype(np.float32)
    blind = dataclasses.replace(release, candidates=words / np.linalg.norm(words, axis=2, keepdims=True), words=random)
    view = View(release=release, defense=defense, extractor=Sift(), knowledge={PublicAssets: lambda: PublicAssets(assets=public)})
    images = [DIA().reconstruct(one, np.random.default_rng(0)) for one in (view, dataclasses.replace(view, release=blind))]
    ranks = [rank_photograph(pixels / 255, image, load_distractors()) for image in images]
    assert ranks[0] == 1
    assert ranks[1] > 1
