"""A posterior over the candidates of each keypoint, from which words occur near which.

The model is a pairwise Markov field. A keypoint's state is one of its m candidates, or none of them. A candidate's own evidence
is its prior odds and how common it is there; a pair of candidates of two keypoints has the log-ratio

    log P(w, w' | Δ) / P(w) P(w') = q(w) · (g(Δ) ∘ k(w'))

of low rank, with Δ the displacement between the two: SIFT is upright, so direction tells as well as distance. "None" has ratio 1
with everything, since wrong words are uniform. Beliefs are passed from each keypoint to those that it is near to. That counts
evidence twice where the graph has loops, so each message is weighted by a trust in [0, 1] that training sets.

More than two keypoints at a time are weighed by layers that gather, with learned functions of the displacement, what is believed
around. They add to the odds of what fits, and tell the descriptor that is to be expected where it is none of the candidates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

FREQUENCIES = (1.0, 2.0, 4.0)  # of a displacement's length on a logarithmic scale
FARTHEST = 64.0  # pixels; what lies farther counts as being there
GREATEST = 8.0  # of a log-ratio, either way
HIDDEN = 64  # width of what is made of a displacement


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The network's sizes."""

    length: int = 128  # D, of a descriptor
    width: int = 64
    rank: int = 32  # of the log-ratios
    neighbours: int = 16
    rounds: int = 3  # in which beliefs are passed along pairs
    layers: int = 2  # that gather what is believed around
    kernels: int = 8  # functions of displacement that each gathers with


@dataclass(frozen=True, eq=False)
class Scene:
    """The keypoints of one or more releases, P in all, with m candidates each."""

    candidates: Tensor  # (P, m, D) unit norm
    odds: Tensor  # (P,) log of the prior chance of a candidate over that of none
    places: Tensor  # (P, 2) in [-1, 1]
    around: Tensor  # (P, k) int64, the nearest other keypoints
    offsets: Tensor  # (P, k, 2) pixels from a keypoint to those
    present: Tensor  # (P, k) float32, 0 where there are fewer than k others, else 1

    def to(self, device: torch.device) -> Scene:
        return Scene(*(value.to(device) for value in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Belief:
    """What the network makes of a scene."""

    odds: Tensor  # (P, m) log of the posterior chance of each candidate over that of none
    expected: Tensor  # (P, D) mean descriptor where it is none of them, of any norm

    @property
    def logits(self) -> Tensor:
        """Log posterior but for a constant: of each candidate, then of none. -> (P, m + 1)"""
        return torch.cat([self.odds, torch.zeros_like(self.odds[:, :1])], dim=1)

    def mean(self, candidates: Tensor) -> Tensor:
        """The posterior mean, scaled to unit norm. (P, m, D) -> (P, D)"""
        share = self.logits.softmax(dim=1)  # (P, m + 1)
        mixed = torch.einsum("pm,pmd->pd", share[:, :-1], candidates) + share[:, -1:] * self.expected
        return nnf.normalize(mixed, dim=1)

    def word(self, candidates: Tensor) -> Tensor:
        """The likeliest candidate. (P, m, D) -> (P, D)"""
        return candidates[torch.arange(len(candidates), device=candidates.device), self.odds.argmax(dim=1)]


class Surroundings(nn.Module):
    """Scene -> Belief. Untrained, it believes the prior."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        width = shape.width
        self.shape = shape
        self.scale = shape.length**0.5  # so that an element of a candidate is about 1
        self.embed = nn.Sequential(nn.Linear(shape.length, 2 * width), nn.SiLU(), nn.Linear(2 * width, width))
        self.here = nn.Sequential(nn.Linear(3, 32), nn.SiLU(), nn.Linear(32, width))
        self.shift = nn.Sequential(nn.Linear(4 + 4 * len(FREQUENCIES), HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU())
        self.alone = nn.Linear(width, 1)
        self.query, self.key = nn.Linear(width, shape.rank), nn.Linear(width, shape.rank)
        self.gate, self.trust = nn.Linear(HIDDEN, shape.rank), nn.Linear(HIDDEN, 1)
        self.layers = nn.ModuleList(Gather(width, shape.kernels) for _ in range(shape.layers))
        self.expect = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, shape.length))
        for silent in (self.alone, self.query):
            nn.init.zeros_(silent.weight)
            nn.init.zeros_(silent.bias)

    def forward(self, scene: Scene) -> Belief:
        words = self.embed(scene.candidates * self.scale)  # (P, m, width)
        state = self.here(torch.cat([scene.places, scene.odds[:, None] / 4], dim=1))  # (P, width)
        shift = self.shift(describe(scene.offsets))  # (P, k, HIDDEN)
        alone = scene.odds[:, None] + self.alone(nnf.silu(words + state[:, None]))[:, :, 0]  # (P, m)
        trust = torch.sigmoid(self.trust(shift))[:, :, 0] * scene.present  # (P, k)
        odds = propagate(alone, self.log_ratios(words, shift, scene.around), trust, scene.around, self.shape.rounds)
        for layer in self.layers:
            odds, state = layer(words, odds, state, shift, scene)
        return Belief(odds, self.expect(state) / self.scale)

    def log_ratios(self, words: Tensor, shift: Tensor, around: Tensor) -> Tensor:
        """Of each candidate with each of a keypoint nearby. (P, m, width), (P, k, HIDDEN), (P, k) -> (P, k, m, m)"""
        count, m, _ = words.shape
        theirs = self.key(words).flatten(1)[around].view(count, around.shape[1], m, -1)  # (P, k, m, rank)
        mine = self.query(words)[:, None] * self.gate(shift)[:, :, None]  # (P, k, m, rank)
        return GREATEST * torch.tanh(mine @ theirs.transpose(2, 3) / GREATEST)


class Gather(nn.Module):
    """Adds to the odds of candidates, and to the state of keypoints, what is believed of the keypoints around."""

    def __init__(self, width: int, kernels: int) -> None:
        super().__init__()
        self.kernels = nn.Linear(HIDDEN, kernels)
        self.mix = nn.Linear(kernels * 2 * width, width)
        self.update = nn.Sequential(
            nn.LayerNorm(3 * width), nn.Linear(3 * width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width)
        )
        self.fits = nn.Linear(width, width)
        nn.init.zeros_(self.fits.weight)
        nn.init.zeros_(self.fits.bias)

    def forward(self, words: Tensor, odds: Tensor, state: Tensor, shift: Tensor, scene: Scene) -> tuple[Tensor, Tensor]:
        """(P, m, width), (P, m), (P, width), (P, k, HIDDEN) -> (P, m), (P, width)"""
        believed = torch.einsum("pm,pmw->pw", shares(odds), words)
        told = torch.cat([believed, state], dim=1)  # (P, 2 width)
        kernels = (self.kernels(shift) * scene.present[:, :, None]).transpose(1, 2)  # (P, kernels, k)
        around = self.mix((kernels @ told[scene.around]).flatten(1))  # (P, width)
        state = state + self.update(torch.cat([state, around, believed], dim=1))
        fit = torch.einsum("pw,pmw->pm", self.fits(state), words) * words.shape[2] ** -0.5
        return odds + fit, state


def propagate(alone: Tensor, ratios: Tensor, trust: Tensor, around: Tensor, rounds: int) -> Tensor:
    """Log odds of each candidate over none once beliefs have been passed `rounds` times.

    With trust 1, one round gives a keypoint's exact posterior if those near it hang together through it alone.

    Parameters
    ----------
    alone : (P, m) log odds over none of each candidate by itself
    ratios : (P, k, m, m) log-ratio of the p-th keypoint's candidate and of its k-th neighbour's
    trust : (P, k) weight of each neighbour's message
    around : (P, k) which keypoints those are

    Returns
    -------
    (P, m)
    """
    excess = torch.expm1(ratios)
    odds = alone
    for _ in range(rounds):
        # Σ_s belief(s) ratio(c, s) over the neighbour's m + 1 states, none of them having ratio 1.
        told = torch.einsum("pkcd,pkd->pkc", excess, shares(odds)[around])
        odds = alone + torch.einsum("pkc,pk->pc", torch.log1p(told.clamp_min(-0.9999)), trust)
    return odds


def shares(odds: Tensor) -> Tensor:
    """Chances of the candidates, which with that of none sum to 1. (P, m) -> (P, m)"""
    return torch.cat([odds, torch.zeros_like(odds[:, :1])], dim=1).softmax(dim=1)[:, :-1]


def describe(offsets: Tensor) -> Tensor:
    """Smooth features of displacements: direction, and length on a logarithmic scale. (..., 2) -> (..., 4 + 4 frequencies)"""
    length = offsets.norm(dim=-1, keepdim=True)
    direction = offsets / length.clamp_min(0.5)
    x, y = direction.split(1, dim=-1)
    phase = torch.log1p(length.clamp_max(FARTHEST)) * (math.pi / math.log1p(FARTHEST))
    sines = [torch.sin(phase * frequency) for frequency in FREQUENCIES]
    cosines = [torch.cos(phase * frequency) for frequency in FREQUENCIES]
    return torch.cat([direction, x * x - y * y, x * y, *sines, *cosines, *[direction * sine for sine in sines]], dim=-1)
