"""Reconstruction from word sets: the context model computes posteriors of the candidates, the inversion network reads both.

A plain sum over candidates has few true words among many false ones. With posteriors, the network sums mostly true ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bench.context.encoding import build_graph
from bench.context.network import ContextModel
from bench.inversion.encoding import EncodedRelease, encode
from bench.inversion.network import Inverter
from bench.inversion.reconstruct import average_reconstructions
from bench.inversion.symmetry import Symmetry
from bench.types import Floats, WordSets


def reconstruct_from_posteriors(
    inverter: Inverter, context: ContextModel, release: WordSets, odds: float, symmetries: Sequence[Symmetry]
) -> Floats:
    """Return the mean reconstruction of a release. -> (H, W, 3) in [0, 1]

    Parameters
    ----------
    odds : prior log odds of a candidate over none (`bench.context.encoding.prior_odds`)
    """

    def encode_one(transformed: WordSets) -> EncodedRelease:
        return encode_posteriors(transformed, compute_log_posteriors(context, transformed, odds), odds)

    return average_reconstructions(inverter, release, symmetries, encode_one)


@torch.inference_mode()
def compute_log_posteriors(context: ContextModel, release: WordSets, odds: float) -> Tensor:
    """Return the log posterior of each candidate, then of none of them. -> (N, m + 1)"""
    graph = build_graph([release], [odds], context.shape.neighbours)
    return context(graph.to(next(context.parameters()).device)).logits.log_softmax(dim=1).cpu()


def encode_posteriors(release: WordSets, logs: Tensor, odds: float) -> EncodedRelease:
    """Encode a release with the log posteriors (N, m + 1) of its candidates as input of the inversion network."""
    plain = encode([release], [np.empty(0, np.float32)], release.subset_size, "posteriors")
    defense = torch.tensor([odds, release.subset_size]) / 4
    values = torch.cat([plain.values, logs, defense.expand(len(release), -1)], dim=1)
    return replace(plain, values=values)
