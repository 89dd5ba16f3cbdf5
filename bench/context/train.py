"""Losses of the context model, which learns co-occurrences of words in public photographs in two stages.

1. Pairs: the log-ratio of two words at a displacement, by noise contrast. The true words of two neighbours are distinguished from
   a pair with a uniformly random word, and from a pair with the true word of another keypoint. All words are known in this stage.
2. Releases: cross-entropy of the true word among the candidates and "none of them" + 1 − cosine(posterior mean, true descriptor).

The first stage is necessary: from releases of small ε alone the log-ratios are learned very slowly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor

from bench.api import Defense
from bench.codebook.public import Public
from bench.codebook.true_words import find_true_candidates, find_true_words
from bench.context.encoding import build_graph, prior_odds
from bench.context.network import Belief, ContextModel, KeypointGraph, encode_offsets
from bench.core.device import pick_device
from bench.types import Features, WordSets

ANCHORS = 400  # keypoints of an example whose pairs are used in the first stage


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


def compute_pair_loss(module: ContextModel, example: Example, anchors: int = ANCHORS) -> Tensor:
    """Return the loss of the first stage, on the pairs of `anchors` random keypoints. -> ()

    The example has two candidates for each keypoint: the true word and a random one.

    Logits: log-ratio + rating of the neighbour's word, against a random word; log-ratio, against the word of another keypoint;
    rating of a word alone, against a random word.
    """
    graph, count = example.graph, len(example.labels)
    rows = torch.arange(count, device=example.labels.device)
    order = torch.stack([example.labels, 1 - example.labels], dim=1)  # the true word first
    words = module.embed_words(graph.candidates[rows[:, None], order])  # (P, 2, width)
    ratings = module.rate_alone(words, module.embed_positions(dataclasses.replace(graph, odds=torch.zeros_like(graph.odds))))
    chosen = torch.randperm(count, device=rows.device)[:anchors]  # (A,)
    near, present = graph.neighbours[chosen], graph.present[chosen]  # (A, k)
    shift = module.shift(encode_offsets(graph.offsets[chosen]))
    keys = module.project(module.key, words)  # (P, 2, s, rank)
    others = keys[torch.randperm(count, device=rows.device), :1]  # (P, 1, s, rank) true words, of other keypoints
    queries, bias = (
        module.gate_queries(words[chosen, :1], shift),
        module.bias(shift)[:, :, None],
    )  # (A, k, 1, s, rank), (A, k, 1, s)
    ratios = module.combine(queries, torch.cat([keys, others], dim=1)[near], bias)  # (A, k, 3)
    true, random = (ratios[:, :, :2] + ratings[near]).unbind(dim=2)
    losses = nnf.softplus(-true) + nnf.softplus(random) + nnf.softplus(-ratios[:, :, 0]) + nnf.softplus(ratios[:, :, 2])
    alone = nnf.softplus(-ratings[:, 0]) + nnf.softplus(ratings[:, 1])
    return (losses * present).sum() / present.sum().clamp_min(1) + alone.mean()


def compute_loss(module: ContextModel, example: Example, weight: float = 1.0) -> Tensor:
    """Return the loss of the second stage, with a weight of the term of the cosine. -> ()"""
    belief = module(example.graph)
    cosine = (belief.mean(example.graph.candidates) * example.descriptors).sum(dim=1).mean()
    return nnf.cross_entropy(belief.logits, example.labels) + weight * (1 - cosine)


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
