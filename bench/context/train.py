"""Training of the context model on co-occurrences of words in public photographs.

loss = cross-entropy of the true word among the candidates and "none of them" + 1 − cosine(posterior mean, true descriptor)
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor

from bench.api import Defense
from bench.codebook.public import Public
from bench.codebook.true_words import find_true_candidates, find_true_words
from bench.context.encoding import build_graph, prior_odds
from bench.context.network import Belief, ContextModel, KeypointGraph, Shape
from bench.core.device import pick_device
from bench.core.progress import Progress
from bench.images.views import PhotographView
from bench.inversion.data import SupportedSettings, draw_crop
from bench.inversion.plan import Training
from bench.types import Features, WordSets


@dataclass(frozen=True, eq=False)
class Example:
    """A graph and its labels."""

    graph: KeypointGraph
    labels: Tensor  # (P,) int64, index of the true word among the candidates; m if it is none
    descriptors: Tensor  # (P, D)

    def to(self, device: torch.device) -> Example:
        return Example(self.graph.to(device), self.labels.to(device), self.descriptors.to(device))


def build_example(
    secrets: Sequence[Features], defenses: Sequence[Defense], public: Public, neighbours: int, rng: np.random.Generator
) -> Example:
    """Return the example of several secrets, each released by its defense. All defenses release equally many words."""
    releases, odds, labels = [], [], []
    for secret, defense in zip(secrets, defenses, strict=True):
        release = defense.protect(secret, public, rng)
        if not isinstance(release, WordSets):
            raise TypeError(f"{defense.name()} releases no words of a dictionary")
        labels.append(find_true_candidates(release, find_true_words(defense, secret, public)))
        odds.append(prior_odds(defense, public, release.subset_size))
        releases.append(release)
    return Example(
        build_graph(releases, odds, neighbours),
        torch.from_numpy(np.concatenate(labels)),
        torch.from_numpy(np.concatenate([secret.descriptors for secret in secrets])),
    )


def build_sampler(
    views: Sequence[PhotographView],
    defense: Defense,
    supported: SupportedSettings,
    size: str,
    public: Public,
    neighbours: int,
    batch: int,
) -> Callable[[np.random.Generator], Example]:
    """Return a function that draws examples: random crops of random views under random settings.

    The field `size` is the same for all crops of an example.
    """

    def draw(rng: np.random.Generator) -> Example:
        secrets = [draw_crop(views[number], rng)[1] for number in rng.integers(len(views), size=batch)]
        common = {size: supported[size].sample(rng)}
        settings = [{field: setting.sample(rng) for field, setting in supported.items()} | common for _ in secrets]
        defenses = [dataclasses.replace(defense, **values) for values in settings]  # type: ignore[type-var]  # plugins are dataclasses
        return build_example(secrets, defenses, public, neighbours, rng)

    return draw


def compute_loss(module: ContextModel, example: Example) -> Tensor:
    """Return the loss defined at the top of this file. -> ()"""
    belief = module(example.graph)
    cosine = (belief.mean(example.graph.candidates) * example.descriptors).sum(dim=1).mean()
    return nnf.cross_entropy(belief.logits, example.labels) + 1 - cosine


def fit(shape: Shape, draw: Callable[[np.random.Generator], Example], training: Training) -> ContextModel:
    """Train from random weights, with examples of the seeds (seed, step), and return the network of averaged weights."""
    torch.manual_seed(training.seed)
    device = pick_device()
    module = ContextModel(shape).to(device)
    average = {name: value.clone() for name, value in module.state_dict().items()}
    optimizer = torch.optim.AdamW(module.parameters(), training.rate, weight_decay=training.decay)
    started, smooth = time.monotonic(), math.nan
    with Progress("training", training.steps) as progress:
        for step in range(training.steps):
            factor = min((step + 1) / training.warmup, 0.5 * (1 + math.cos(math.pi * step / training.steps)))
            for group in optimizer.param_groups:
                group["lr"] = training.rate * factor
            value = compute_loss(module, draw(np.random.default_rng([training.seed, step])).to(device))
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
            optimizer.step()
            decay = min(training.average, (step + 1) / (step + 10))  # small at first, while the weights change fast
            for name, weight in module.state_dict().items():
                average[name].lerp_(weight, 1 - decay)
            smooth = float(value.detach()) if math.isnan(smooth) else 0.98 * smooth + 0.02 * float(value.detach())
            speed = (step + 1) * training.batch / (time.monotonic() - started)
            progress.advance(1, f"loss {smooth:.4f}, {speed:.1f} images/s")
    module.load_state_dict(average)
    return module.eval()


@torch.no_grad()
def validate(
    module: ContextModel, secrets: Sequence[Features], defense: Defense, public: Public, seed: int = 0
) -> dict[str, float]:
    """Return means over photographs.

    `posterior` and `prior` are cross-entropies in nats. `picked` is the fraction of keypoints whose true word is the likeliest
    candidate; `chance` is this fraction for a random candidate. `angle`, in degrees, is between posterior mean and descriptor.
    """
    scores = []
    for number, secret in enumerate(secrets):
        example = build_example([secret], [defense], public, module.shape.neighbours, np.random.default_rng([seed, number]))
        example = example.to(pick_device())
        belief = module(example.graph)
        prior = Belief(example.graph.odds[:, None].expand_as(belief.odds), belief.expected)
        cosine = (belief.mean(example.graph.candidates) * example.descriptors).sum(dim=1).clamp(-1, 1)
        size = belief.odds.shape[1]
        scores.append(
            {
                "posterior": nnf.cross_entropy(belief.logits, example.labels),
                "prior": nnf.cross_entropy(prior.logits, example.labels),
                "picked": (belief.odds.argmax(dim=1) == example.labels).float().mean(),
                "chance": (example.labels < size).float().mean() / size,
                "angle": torch.rad2deg(torch.arccos(cosine)).mean(),
            }
        )
    return {name: float(np.mean([float(score[name]) for score in scores])) for name in scores[0]}
