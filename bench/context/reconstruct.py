"""Reconstruction from word sets: the context model computes posteriors of the candidates, the inversion network reads both.

A plain sum over candidates has few true words among many false ones. With posteriors, the network sums mostly true ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bench.api import Defense
from bench.codebook.public import ASSETS, Public
from bench.context import weights
from bench.context.encoding import build_graph, prior_odds
from bench.context.network import ContextModel
from bench.core.errors import UserError
from bench.inversion.encoding import EncodedRelease, encode
from bench.inversion.network import Inverter
from bench.inversion.reconstruct import average_reconstructions, reconstruct_image
from bench.inversion.symmetry import Symmetry
from bench.inversion.weights import Network
from bench.types import Floats, Release, WordSets


def reconstruct_release(
    network: Network, release: Release, defense: Defense, symmetries: Sequence[Symmetry], public: Public
) -> Floats:
    """Return the mean reconstruction by a network, with the context model that it was trained with. -> (H, W, 3) in [0, 1]

    Raises
    ------
    UserError
        if the installed context model is another.
    """
    if network.meta["encoding"] != "posteriors":
        settings = network.encode_settings(defense, public)
        return reconstruct_image(network.module, release, symmetries, settings, network.meta["slots"], network.meta["encoding"])
    if not isinstance(release, WordSets) or not isinstance(network.module, Inverter):
        raise TypeError(f"{network.path} reads WordSets, got {type(release).__name__}")
    odds = prior_odds(defense, public, release.subset_size)
    return reconstruct_from_posteriors(network.module, load_context(network).module, release, odds, symmetries)


def verify(network: Network) -> str:
    """Verify a network and the context model that it reads, and return the digest of the network.

    Its metadata have that of the context model.

    Raises
    ------
    UserError
        if a file does not match its metadata, or the installed context model is another.
    """
    if network.meta["encoding"] == "posteriors":
        load_context(network).verify()
    return network.verify()


def load_context(network: Network) -> weights.Network:
    """Load the context model that a network was trained with.

    Raises
    ------
    UserError
        if the installed one is another.
    """
    installed = weights.load(ASSETS / "context.safetensors")
    if installed.digest != network.meta.get("context"):
        raise UserError(f"{network.path} was trained with another context model than {installed.path}; reinstall")
    return installed


def reconstruct_from_posteriors(
    inverter: Inverter, context: ContextModel, release: WordSets, odds: float, symmetries: Sequence[Symmetry]
) -> Floats:
    """Return the mean reconstruction of a release. -> (H, W, 3) in [0, 1]

    The posterior is the same in all symmetries: the geometric mean of those in the first and the last. A posterior for each of
    the eight takes twice the time in all. It changes SSIM by .0006 ± .0009 at ε = 10 and -.0002 ± .0006 at ε = 12 (30
    photographs for tuning, m = 2, two standard errors of the paired difference). That of the first alone changes it by -.0009 at
    ε = 10.

    Parameters
    ----------
    odds : prior log odds of a candidate over none (`bench.context.encoding.prior_odds`)
    """
    views = [symmetry.transform_release(release) for symmetry in dict.fromkeys((symmetries[0], symmetries[-1]))]
    logs = torch.stack([compute_log_posteriors(context, view, odds) for view in views]).mean(dim=0).log_softmax(dim=1)

    def encode_one(transformed: WordSets) -> EncodedRelease:
        return encode_posteriors(transformed, logs, odds)

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
