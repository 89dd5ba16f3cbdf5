"""The context model: a posterior over the candidates of each keypoint, from co-occurrences of nearby words.

The model is a pairwise Markov field. The state of a keypoint is one of its m candidates, or none of them. The evidence of one
candidate is its prior odds and its frequency at that position. A pair of candidates of two keypoints has the log-ratio

    log P(w, w' | Δ) / P(w) P(w') = q(w) · (g(Δ) ∘ k(w'))

of low rank, with Δ the displacement between the two. SIFT is upright, so direction and distance are both informative. "None" has
ratio 1 with every candidate, since wrong words are uniform. Belief propagation passes messages between neighbours. Loops in the
graph count evidence twice, so each message has a learned weight in [0, 1], its trust.

Further layers combine more than two keypoints. They gather the beliefs of neighbours with learned functions of the displacement.
They update the odds of the candidates, and predict the descriptor for the case that no candidate is the true word.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

FREQUENCIES = (1.0, 2.0, 4.0)  # of a displacement's length on a logarithmic scale
MAX_DISTANCE = 64.0  # pixels; longer displacements are clamped
MAX_LOG_RATIO = 8.0  # limit of a log-ratio in both directions
HIDDEN = 64  # width of the embedding of a displacement


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The network's sizes."""

    length: int = 128  # D, of a descriptor
    width: int = 64
    rank: int = 32  # of the log-ratios
    neighbours: int = 16
    rounds: int = 3  # of belief propagation
    layers: int = 2  # that gather the beliefs of neighbours
    kernels: int = 8  # functions of displacement per layer


@dataclass(frozen=True, eq=False)
class KeypointGraph:
    """The keypoints of one or more releases, P in all, with m candidates each."""

    candidates: Tensor  # (P, m, D) unit norm
    odds: Tensor  # (P,) prior log odds of a candidate over none
    positions: Tensor  # (P, 2) in [-1, 1]
    neighbours: Tensor  # (P, k) int64, the nearest other keypoints
    offsets: Tensor  # (P, k, 2) pixels from a keypoint to those
    present: Tensor  # (P, k) float32, 1 for neighbours that exist, else 0

    def to(self, device: torch.device) -> KeypointGraph:
        return KeypointGraph(*(value.to(device) for value in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Belief:
    """Posterior of the network."""

    odds: Tensor  # (P, m) posterior log odds of each candidate over none
    expected: Tensor  # (P, D) mean descriptor if the true word is none of them, of any norm

    @property
    def logits(self) -> Tensor:
        """Log posterior up to a constant, of each candidate, then of none. -> (P, m + 1)"""
        return torch.cat([self.odds, torch.zeros_like(self.odds[:, :1])], dim=1)

    def mean(self, candidates: Tensor) -> Tensor:
        """Return the posterior mean, scaled to unit norm. (P, m, D) -> (P, D)"""
        chances = self.logits.softmax(dim=1)  # (P, m + 1)
        mixed = torch.einsum("pm,pmd->pd", chances[:, :-1], candidates) + chances[:, -1:] * self.expected
        return nnf.normalize(mixed, dim=1)

    def word(self, candidates: Tensor) -> Tensor:
        """Return the likeliest candidate. (P, m, D) -> (P, D)"""
        return candidates[torch.arange(len(candidates), device=candidates.device), self.odds.argmax(dim=1)]


class ContextModel(nn.Module):
    """KeypointGraph -> Belief. Untrained, it returns the prior."""

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
        for layer in (self.alone, self.query):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, graph: KeypointGraph) -> Belief:
        words = self.embed(graph.candidates * self.scale)  # (P, m, width)
        state = self.here(torch.cat([graph.positions, graph.odds[:, None] / 4], dim=1))  # (P, width)
        shift = self.shift(encode_offsets(graph.offsets))  # (P, k, HIDDEN)
        alone = graph.odds[:, None] + self.alone(nnf.silu(words + state[:, None]))[:, :, 0]  # (P, m)
        trust = torch.sigmoid(self.trust(shift))[:, :, 0] * graph.present  # (P, k)
        odds = propagate(alone, self.log_ratios(words, shift, graph.neighbours), trust, graph.neighbours, self.shape.rounds)
        for layer in self.layers:
            odds, state = layer(words, odds, state, shift, graph)
        return Belief(odds, self.expect(state) / self.scale)

    def log_ratios(self, words: Tensor, shift: Tensor, neighbours: Tensor) -> Tensor:
        """Return the log-ratio of each candidate of a keypoint with each candidate of each neighbour.

        (P, m, width), (P, k, HIDDEN), (P, k) -> (P, k, m, m)
        """
        count, m, _ = words.shape
        keys = self.key(words).flatten(1)[neighbours].view(count, neighbours.shape[1], m, -1)  # (P, k, m, rank)
        queries = self.query(words)[:, None] * self.gate(shift)[:, :, None]  # (P, k, m, rank)
        return MAX_LOG_RATIO * torch.tanh(queries @ keys.transpose(2, 3) / MAX_LOG_RATIO)


class Gather(nn.Module):
    """Updates the odds of candidates and the state of keypoints with the beliefs of their neighbours."""

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

    def forward(self, words: Tensor, odds: Tensor, state: Tensor, shift: Tensor, graph: KeypointGraph) -> tuple[Tensor, Tensor]:
        """(P, m, width), (P, m), (P, width), (P, k, HIDDEN) -> (P, m), (P, width)"""
        believed = torch.einsum("pm,pmw->pw", compute_probabilities(odds), words)
        messages = torch.cat([believed, state], dim=1)  # (P, 2 width)
        kernels = (self.kernels(shift) * graph.present[:, :, None]).transpose(1, 2)  # (P, kernels, k)
        gathered = self.mix((kernels @ messages[graph.neighbours]).flatten(1))  # (P, width)
        state = state + self.update(torch.cat([state, gathered, believed], dim=1))
        fit = torch.einsum("pw,pmw->pm", self.fits(state), words) * words.shape[2] ** -0.5
        return odds + fit, state


def propagate(alone: Tensor, ratios: Tensor, trust: Tensor, neighbours: Tensor, rounds: int) -> Tensor:
    """Return the log odds of each candidate over none after `rounds` of belief propagation.

    With trust 1, one round gives the exact posterior of a keypoint whose neighbours are connected through it alone.

    Parameters
    ----------
    alone : (P, m) log odds of each candidate over none, from its own evidence
    ratios : (P, k, m, m) log-ratio of the p-th keypoint's candidate and of its k-th neighbour's
    trust : (P, k) weight of each neighbour's message
    neighbours : (P, k) the indices of the neighbours

    Returns
    -------
    (P, m)
    """
    excess = torch.expm1(ratios)
    odds = alone
    for _ in range(rounds):
        # Σ_s belief(s) ratio(c, s) over the neighbour's m + 1 states, none of them having ratio 1.
        message = torch.einsum("pkcd,pkd->pkc", excess, compute_probabilities(odds)[neighbours])
        odds = alone + torch.einsum("pkc,pk->pc", torch.log1p(message.clamp_min(-0.9999)), trust)
    return odds


def compute_probabilities(odds: Tensor) -> Tensor:
    """Return the probabilities of the candidates, which sum to 1 with that of none. (P, m) -> (P, m)"""
    return torch.cat([odds, torch.zeros_like(odds[:, :1])], dim=1).softmax(dim=1)[:, :-1]


def encode_offsets(offsets: Tensor) -> Tensor:
    """Encode displacements as smooth features: direction, and length on a log scale. (..., 2) -> (..., 4 + 4 frequencies)"""
    length = offsets.norm(dim=-1, keepdim=True)
    direction = offsets / length.clamp_min(0.5)
    x, y = direction.split(1, dim=-1)
    phase = torch.log1p(length.clamp_max(MAX_DISTANCE)) * (math.pi / math.log1p(MAX_DISTANCE))
    sines = [torch.sin(phase * frequency) for frequency in FREQUENCIES]
    cosines = [torch.cos(phase * frequency) for frequency in FREQUENCIES]
    return torch.cat([direction, x * x - y * y, x * y, *sines, *cosines, *[direction * sine for sine in sines]], dim=-1)
