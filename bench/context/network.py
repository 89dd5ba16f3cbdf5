"""The context model: a posterior over the candidates of each keypoint, from co-occurrences of nearby words.

The model is a pairwise Markov field. The state of a keypoint is one of its m candidates, or none of them. The evidence of one
candidate is its prior odds and its frequency at that position. A pair of candidates of two keypoints has the log-ratio

    log P(w, w' | Δ) / P(w) P(w') = log mean_s exp(q_s(w) · (g_s(Δ) ∘ k_s(w')) + b_s(Δ)),

with Δ the displacement between the two. Each s is a component of low rank: the scales of the two keypoints are unknown, and a
pair looks different at each combination of scales. SIFT is upright, so direction and distance are both informative. "None" has
ratio 1 with every candidate, since wrong words are uniform. Belief propagation passes messages between neighbours. Loops in
the graph count evidence twice, so each message has a learned weight in [0, 1], its trust.

Further layers combine more than two keypoints. They gather the beliefs of neighbours with learned functions of the displacement.
They update the odds of the candidates, and predict the descriptor for the case that no candidate is the true word.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

FREQUENCIES = (1.0, 2.0, 3.0, 4.0, 6.0)  # of a displacement's length on a logarithmic scale
MAX_DISTANCE = 64.0  # pixels; longer displacements are clamped
MAX_LOG_RATIO = 8.0  # limit of a log-ratio in both directions
HIDDEN = 64  # width of the embedding of a displacement
BLOCK = 128  # keypoints whose arrays fit into the processor's cache
DAMPING = 0.5  # weight of the previous message in belief propagation


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The network's sizes."""

    length: int = 128  # D, of a descriptor
    width: int = 96
    hidden: int = 384  # of the embedding of a word
    rank: int = 32  # of the log-ratios, for each component
    components: int = 4
    neighbours: int = 20
    rounds: int = 6  # of belief propagation
    layers: int = 2  # that gather the beliefs of neighbours
    kernels: int = 6  # functions of displacement per layer


@dataclass(frozen=True, eq=False)
class KeypointGraph:
    """The keypoints of one or more releases, P in all, with m candidates each."""

    candidates: Tensor  # (P, m, D) unit norm
    odds: Tensor  # (P,) prior log odds of a candidate over none
    positions: Tensor  # (P, 2) in [-1, 1]
    spacing: Tensor  # (P,) log of the distance to the farthest neighbour, in pixels
    neighbours: Tensor  # (P, k) int64, the nearest other keypoints
    offsets: Tensor  # (P, k, 2) pixels from a keypoint to those
    present: Tensor  # (P, k) float32, 1 for neighbours that exist, else 0
    reverse: Tensor  # (P, k) int64, flat index in (P, k) of the edge back from a neighbour; P k if there is none

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
        width, projected = shape.width, shape.components * shape.rank
        self.shape = shape
        self.scale = shape.length**0.5  # so that an element of a candidate is about 1
        self.embed = nn.Sequential(nn.Linear(shape.length, shape.hidden), nn.SiLU(), nn.Linear(shape.hidden, width))
        self.here = nn.Sequential(nn.Linear(4, 32), nn.SiLU(), nn.Linear(32, width))
        lengths = 4 + len(FREQUENCIES) * 6
        self.shift = nn.Sequential(nn.Linear(lengths, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU())
        self.query, self.key = nn.Linear(width, projected), nn.Linear(width, projected)
        self.gate, self.bias, self.trust = nn.Linear(HIDDEN, projected), nn.Linear(HIDDEN, shape.components), nn.Linear(HIDDEN, 1)
        self.layers = nn.ModuleList(Gather(width, shape.kernels) for _ in range(shape.layers))
        self.expect = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, shape.length))
        last = nn.Linear(width, 1)
        self.alone = nn.Sequential(nn.Linear(width, width), nn.SiLU(), last)
        for layer in (last, self.query, self.bias):  # untrained, the network returns the prior
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, graph: KeypointGraph) -> Belief:
        words, state = self.embed_words(graph.candidates), self.embed_positions(graph)
        shift = self.shift(encode_offsets(graph.offsets))  # (P, k, HIDDEN)
        alone = graph.odds[:, None] + self.rate_alone(words, state)  # (P, m)
        ratios = self.log_ratios(words, shift, graph.neighbours)
        trust = torch.sigmoid(self.trust(shift))[:, :, 0] * graph.present  # (P, k)
        odds = propagate(alone, ratios, trust, graph.neighbours, graph.reverse, self.shape.rounds)
        for layer in self.layers:
            odds, state = layer(words, odds, state, shift, graph)
        return Belief(odds, self.expect(state) / self.scale)

    def embed_words(self, candidates: Tensor) -> Tensor:
        """(P, m, D) -> (P, m, width)"""
        embedded: Tensor = self.embed(candidates * self.scale)
        return embedded

    def embed_positions(self, graph: KeypointGraph) -> Tensor:
        """Embed position, prior and spacing of each keypoint. -> (P, width)"""
        inputs = torch.cat([graph.positions, graph.odds[:, None] / 4, graph.spacing[:, None] - 2], dim=1)
        embedded: Tensor = self.here(inputs)
        return embedded

    def rate_alone(self, words: Tensor, state: Tensor) -> Tensor:
        """Return log P(w | position) / uniform of each candidate. (P, m, width), (P, width) -> (P, m)"""
        rated: Tensor = self.alone(nnf.silu(words + state[:, None]))
        return rated[:, :, 0]

    def log_ratios(self, words: Tensor, shift: Tensor, neighbours: Tensor) -> Tensor:
        """Return the log-ratio of each candidate of a keypoint with each candidate of each neighbour.

        (P, m, width), (P, k, HIDDEN), (P, k) -> (P, k, m, m)
        """
        keys, queries = self.key(words).flatten(1), self._spread(self.project(self.query, words))
        blocks = zip(neighbours.split(BLOCK), shift.split(BLOCK), queries.split(BLOCK), strict=True)
        return torch.cat([self._log_ratios_of_block(keys, *block) for block in blocks])

    def _log_ratios_of_block(self, keys: Tensor, neighbours: Tensor, shift: Tensor, queries: Tensor) -> Tensor:
        """(P, m s rank), (B, k), (B, k, HIDDEN), (B, s rank, m s) -> (B, k, m, m)"""
        (count, k), components = neighbours.shape, self.shape.components
        m = queries.shape[2] // components
        near = keys.index_select(0, neighbours.flatten()).view(count, k, m, -1) * self.gate(shift)[:, :, None]
        parts = (near.flatten(1, 2) @ queries).view(count, k, m, m, components)
        return self.limit(parts.transpose(2, 3), self.bias(shift)[:, :, None, None])

    def _spread(self, queries: Tensor) -> Tensor:
        """Spread queries, so that a matrix product sums each component by itself. (P, m, s, rank) -> (P, s rank, m s)"""
        spread = torch.diag_embed(queries.permute(0, 3, 1, 2))  # (P, rank, m, s, s)
        return spread.permute(0, 3, 1, 2, 4).flatten(3).flatten(1, 2)

    def project(self, layer: nn.Module, words: Tensor) -> Tensor:
        """(P, m, width) -> (P, m, s, rank)"""
        projected: Tensor = layer(words)
        return projected.unflatten(-1, (self.shape.components, self.shape.rank))

    def gate_queries(self, words: Tensor, shift: Tensor) -> Tensor:
        """Return q_s(w) ∘ g_s(Δ). (P, m, width), (P, k, HIDDEN) -> (P, k, m, s, rank)"""
        gates = self.project(self.gate, shift)  # (P, k, s, rank)
        return self.project(self.query, words)[:, None] * gates[:, :, None]

    def combine(self, queries: Tensor, keys: Tensor, bias: Tensor) -> Tensor:
        """Return the limited log-ratio of pairs. (..., s, rank), (..., s, rank), (..., s) -> (...)"""
        return self.limit((queries * keys).sum(dim=-1), bias)

    def limit(self, products: Tensor, bias: Tensor) -> Tensor:
        """Return the limited log-ratio of pairs from the products of their components. (..., s) twice -> (...)"""
        parts = products * self.shape.rank**-0.5 + bias
        ratios = torch.logsumexp(parts, dim=-1) - math.log(self.shape.components)
        return MAX_LOG_RATIO * torch.tanh(ratios / MAX_LOG_RATIO)


class Gather(nn.Module):
    """Updates the odds of candidates and the state of keypoints with the beliefs of their neighbours."""

    def __init__(self, width: int, kernels: int) -> None:
        super().__init__()
        self.kernels = nn.Linear(HIDDEN, kernels)
        self.mix = nn.Linear(kernels * 2 * width, width)
        self.update = nn.Sequential(
            nn.LayerNorm(3 * width), nn.Linear(3 * width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width)
        )
        self.fits, self.gain = nn.Linear(width, width), nn.Linear(width, 1)
        for layer in (self.fits, self.gain):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, words: Tensor, odds: Tensor, state: Tensor, shift: Tensor, graph: KeypointGraph) -> tuple[Tensor, Tensor]:
        """(P, m, width), (P, m), (P, width), (P, k, HIDDEN) -> (P, m), (P, width)"""
        believed = torch.einsum("pm,pmw->pw", compute_probabilities(odds), words)
        messages = torch.cat([believed, state], dim=1)  # (P, 2 width)
        kernels = (self.kernels(shift) * graph.present[:, :, None]).transpose(1, 2)  # (P, kernels, k)
        blocks = zip(kernels.split(BLOCK), graph.neighbours.split(BLOCK), strict=True)
        sums = [near @ messages.index_select(0, rows.flatten()).view(*rows.shape, -1) for near, rows in blocks]
        gathered = self.mix(torch.cat(sums).flatten(1))  # (P, width)
        state = state + self.update(torch.cat([state, gathered, believed], dim=1))
        fit = torch.einsum("pw,pmw->pm", self.fits(state), words) * words.shape[2] ** -0.5
        return odds * (1 + self.gain(state)) + fit, state


def propagate(alone: Tensor, ratios: Tensor, trust: Tensor, neighbours: Tensor, reverse: Tensor, rounds: int) -> Tensor:
    """Return the log odds of each candidate over none after `rounds` of damped belief propagation.

    With trust 1 on a tree, it converges to the exact posterior. One round is exact for a keypoint whose neighbours are connected
    through it alone.

    Parameters
    ----------
    alone : (P, m) log odds of each candidate over none, from its own evidence
    ratios : (P, k, m, m) log-ratio of the p-th keypoint's candidate and of its k-th neighbour's
    trust : (P, k) weight of each neighbour's message
    neighbours : (P, k) the indices of the neighbours
    reverse : (P, k) flat index of the message in the opposite direction; P k if there is none

    Returns
    -------
    (P, m)
    """
    # Candidates come first in all arrays, since operations along a long last axis are fast.
    alone, excess = alone.T.contiguous(), torch.expm1(ratios).permute(2, 3, 0, 1).contiguous()  # (m, P), (m, m, P, k)
    messages: Tensor | None = None  # (m, P, k)
    odds = alone
    for _ in range(rounds):
        sent = odds[:, neighbours]  # (m, P, k) the neighbours' odds, without the message that they got from this keypoint
        if messages is not None:
            received = nnf.pad(messages.flatten(1), (0, 1))  # the last one stands for no message
            sent = sent - received[:, reverse]
        # Σ_s belief(s) ratio(c, s) over the neighbour's m + 1 states, none of them having ratio 1.
        sums = (excess * compute_probabilities(sent, dim=0)).sum(dim=1)
        updated = torch.log1p(sums.clamp_min(-0.9999)) * trust
        messages = updated if messages is None else DAMPING * messages + (1 - DAMPING) * updated
        odds = alone + messages.sum(dim=2)
    return odds.T


def compute_probabilities(odds: Tensor, dim: int = -1) -> Tensor:
    """Return the probabilities of the candidates along an axis, which sum to 1 with that of none. The shape stays."""
    none = torch.zeros_like(odds.narrow(dim, 0, 1))
    return torch.cat([odds, none], dim=dim).softmax(dim=dim).narrow(dim, 0, odds.shape[dim])


def encode_offsets(offsets: Tensor) -> Tensor:
    """Encode displacements as smooth features: direction, and length on a log scale. (..., 2) -> (..., 4 + 6 frequencies)"""
    length = offsets.norm(dim=-1, keepdim=True)
    direction = offsets / length.clamp_min(0.5)
    x, y = direction.split(1, dim=-1)
    double = torch.cat([x * x - y * y, x * y], dim=-1)  # of twice the angle
    phase = torch.log1p(length.clamp_max(MAX_DISTANCE)) * (math.pi / math.log1p(MAX_DISTANCE))
    sines = [torch.sin(phase * frequency) for frequency in FREQUENCIES]
    cosines = [torch.cos(phase * frequency) for frequency in FREQUENCIES]
    angular = [part * sine for sine in sines for part in (direction, double)]
    return torch.cat([direction, double, *sines, *cosines, *angular], dim=-1)
