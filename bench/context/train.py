"""Trains the network that weighs words by their surroundings: which words occur near which in public photographs.

The loss is the cross-entropy of the true word among the candidates and "none of them", plus one minus the cosine between the
posterior mean and the true descriptor.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor

from bench.api import Between, Defense, OneOf
from bench.codebook.public import Public
from bench.context.encoding import prior_odds, scene
from bench.context.network import Belief, Scene, Shape, Surroundings
from bench.core.device import pick_device
from bench.core.progress import Progress
from bench.images.views import PhotographView
from bench.inversion.data import random_crop
from bench.inversion.plan import Training
from bench.types import Features, Indices, WordSets

Served = Mapping[str, Between | OneOf]


@dataclass(frozen=True, eq=False)
class Lesson:
    """A scene and its secret."""

    scene: Scene
    told: Tensor  # (P,) int64, which candidate is the true word; m where none is
    truth: Tensor  # (P, D) the descriptors

    def to(self, device: torch.device) -> Lesson:
        return Lesson(self.scene.to(device), self.told.to(device), self.truth.to(device))


def lesson(
    secrets: Sequence[Features], defenses: Sequence[Defense], public: Public, neighbours: int, rng: np.random.Generator
) -> Lesson:
    """Release each secret by its defense, all of which release equally many words."""
    releases, odds, told = [], [], []
    for secret, defense in zip(secrets, defenses, strict=True):
        release = defense.protect(secret, public, rng)
        if not isinstance(release, WordSets) or release.words is None:
            raise TypeError(f"{defense.name()} releases no words of a dictionary")
        true = release.words == true_words(defense, secret, public)[:, None]  # (N, m)
        told.append(np.where(true.any(axis=1), true.argmax(axis=1), release.subset_size))
        odds.append(prior_odds(defense, public, release.subset_size))
        releases.append(release)
    return Lesson(
        scene(releases, odds, neighbours),
        torch.from_numpy(np.concatenate(told)),
        torch.from_numpy(np.concatenate([secret.descriptors for secret in secrets])),
    )


def true_words(defense: Defense, secret: Features, public: Public) -> Indices:
    """The words that a defense quantises descriptors to. -> (N,)"""
    if defense.dictionary_field is None:
        raise TypeError(f"{defense.name()} does not quantise")
    words = 0 if defense.word_count_field is None else getattr(defense, defense.word_count_field)
    return public.nearest_words(getattr(defense, defense.dictionary_field), secret, words)


def lessons(
    views: Sequence[PhotographView],
    defense: Defense,
    served: Served,
    size: str,
    public: Public,
    neighbours: int,
    batch: int,
) -> Callable[[np.random.Generator], Lesson]:
    """Draws random crops of random views, each under random settings but for the field `size`, which a lesson has one of."""

    def draw(rng: np.random.Generator) -> Lesson:
        secrets = [random_crop(views[number], rng)[1] for number in rng.integers(len(views), size=batch)]
        common = {size: served[size].sample(rng)}
        settings = [{field: setting.sample(rng) for field, setting in served.items()} | common for _ in secrets]
        defenses = [dataclasses.replace(defense, **drawn) for drawn in settings]  # type: ignore[type-var]  # plugins are dataclasses
        return lesson(secrets, defenses, public, neighbours, rng)

    return draw


def loss(module: Surroundings, taught: Lesson) -> Tensor:
    """As at the top of this file."""
    belief = module(taught.scene)
    cosine = (belief.mean(taught.scene.candidates) * taught.truth).sum(dim=1).mean()
    return nnf.cross_entropy(belief.logits, taught.told) + 1 - cosine


def fit(shape: Shape, draw: Callable[[np.random.Generator], Lesson], training: Training) -> Surroundings:
    """Train from random weights on the lessons of generators seeded by (seed, step), and return the moving average."""
    torch.manual_seed(training.seed)
    device = pick_device()
    module = Surroundings(shape).to(device)
    average = {name: value.clone() for name, value in module.state_dict().items()}
    optimizer = torch.optim.AdamW(module.parameters(), training.rate, weight_decay=training.decay)
    started, smooth = time.monotonic(), math.nan
    with Progress("training", training.steps) as progress:
        for step in range(training.steps):
            factor = min((step + 1) / training.warmup, 0.5 * (1 + math.cos(math.pi * step / training.steps)))
            for group in optimizer.param_groups:
                group["lr"] = training.rate * factor
            value = loss(module, draw(np.random.default_rng([training.seed, step])).to(device))
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
            optimizer.step()
            keep = min(training.average, (step + 1) / (step + 10))  # short memory while weights still run away
            for name, weight in module.state_dict().items():
                average[name].lerp_(weight, 1 - keep)
            smooth = float(value.detach()) if math.isnan(smooth) else 0.98 * smooth + 0.02 * float(value.detach())
            speed = (step + 1) * training.batch / (time.monotonic() - started)
            progress.advance(1, f"loss {smooth:.4f}, {speed:.1f} images/s")
    module.load_state_dict(average)
    return module.eval()


@torch.no_grad()
def validate(
    module: Surroundings, secrets: Sequence[Features], defense: Defense, public: Public, seed: int = 0
) -> dict[str, float]:
    """Means over photographs.

    `posterior` and `prior` are cross-entropies in nats; `picked` is the share of keypoints whose true word has the greatest
    chance of the candidates, `chance` that of a random candidate being it; `angle` is that between the posterior mean and the
    descriptor, in degrees.
    """
    scores = []
    for number, secret in enumerate(secrets):
        taught = lesson([secret], [defense], public, module.shape.neighbours, np.random.default_rng([seed, number]))
        taught = taught.to(pick_device())
        belief = module(taught.scene)
        prior = Belief(taught.scene.odds[:, None].expand_as(belief.odds), belief.expected)
        cosine = (belief.mean(taught.scene.candidates) * taught.truth).sum(dim=1).clamp(-1, 1)
        size = belief.odds.shape[1]
        scores.append(
            {
                "posterior": nnf.cross_entropy(belief.logits, taught.told),
                "prior": nnf.cross_entropy(prior.logits, taught.told),
                "picked": (belief.odds.argmax(dim=1) == taught.told).float().mean(),
                "chance": (taught.told < size).float().mean() / size,
                "angle": torch.rad2deg(torch.arccos(cosine)).mean(),
            }
        )
    return {name: float(np.mean([float(score[name]) for score in scores])) for name in scores[0]}
