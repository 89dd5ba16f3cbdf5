"""The neighbour model: the log-ratio that two descriptors of one photograph belong to neighbouring keypoints.

    log P(near | d, d') / P(near) = Σ_r λ_r e_r(d) e_r(d') + b,    e = a small network of one descriptor.

The form is symmetric. Its weights are those of the last layer; negative λ_r let similar descriptors be unlikely neighbours.
Training: `tools/train_neighbours.py`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bench.api import Extractor
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.inversion import weights
from bench.registry import discovery, spec
from bench.types import Floats, Indices

KIND = "neighbour-model"
SHIPPED = ASSETS / "neighbours.safetensors"
MAX_LOG_RATIO = 6.0  # limit in both directions
SHAPES = ("hidden.weight", "hidden.bias", "out.weight", "out.bias", "scale", "bias")


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourModel:
    """A trained model."""

    arrays: tensor_file.Arrays
    meta: dict[str, Any]
    digest: str

    def explain_other_features(self, extractor: Extractor, public: Public) -> str | None:
        """Return the reason why the model does not suit the features of `extractor`; None if it was trained for them."""
        reason = weights.explain_other_features(self.meta, extractor, public)
        return reason and f"the model of neighbours was {reason}"

    @cached_property
    def layers(self) -> dict[str, Floats]:
        """The weights in single precision."""
        return {name: self.arrays[name].astype(np.float32) for name in SHAPES}

    def embed(self, descriptors: Floats) -> Floats:
        """Return the embedding of each descriptor. (N, D) -> (N, R)"""
        layers = self.layers
        hidden = descriptors * np.float32(descriptors.shape[1] ** 0.5) @ layers["hidden.weight"].T + layers["hidden.bias"]
        hidden = hidden / (1 + np.exp(-hidden))  # SiLU
        embedded: Floats = hidden @ layers["out.weight"].T + layers["out.bias"]
        return embedded

    def log_ratios(self, candidates: Floats, odds: float = np.inf) -> Floats:
        """Return the log-ratio of each pair of keypoints; -inf on the diagonal. -> (N, N)

        Parameters
        ----------
        candidates : (N, m, D) descriptors; if m > 1 or the odds are finite, at most one of them is the true one
        odds : log odds of a candidate over none (`bench.context.encoding.prior_odds`)
        """
        count, m, _ = candidates.shape
        chance = 1 / (m + np.exp(-odds))  # of one candidate
        embedded = self.embed(candidates.reshape(count * m, -1)).reshape(count, m, -1)
        ratios = np.full((count, count), 1 - (m * chance) ** 2, dtype=np.float32)
        for one in range(m):
            for other in range(m):
                logs = (embedded[:, one] * self.layers["scale"]) @ embedded[:, other].T + self.layers["bias"]
                ratios += np.float32(chance**2) * np.exp(np.clip(logs, -MAX_LOG_RATIO, MAX_LOG_RATIO))
        result: Floats = np.log(ratios)
        np.fill_diagonal(result, -np.inf)
        return result


def select_neighbours(log_ratios: Floats, count: int) -> tuple[Indices, Floats]:
    """Return the likeliest neighbours of each keypoint and their log-ratios. -> (N, k) twice, k = min(count, N − 1)"""
    count = min(count, len(log_ratios) - 1)
    order: Indices = np.argsort(-log_ratios, axis=1, kind="stable")[:, :count]
    return order, np.take_along_axis(log_ratios, order, axis=1)


def weigh(log_ratios: Floats, odds: float = -5.0) -> Floats:
    """Return the chance that keypoints are neighbours, from their log-ratio and the log odds of two random keypoints."""
    weights: Floats = (1 / (1 + np.exp(-np.clip(log_ratios + odds, -50, 50)))).astype(np.float32)
    return weights


def load(path: Path = SHIPPED) -> NeighbourModel:
    """Read and verify a model; an unchanged file is read once.

    Raises
    ------
    UserError
        if the file is missing or damaged.
    """
    status = path.stat() if path.is_file() else None
    return _load(path, status and (status.st_mtime_ns, status.st_size))


@functools.lru_cache(maxsize=4)
def _load(path: Path, version: object) -> NeighbourModel:
    arrays, meta, digest = tensor_file.load(path, KIND)
    if missing := [name for name in SHAPES if name not in arrays]:
        raise UserError(f"{path}: has no tensor {missing[0]}")
    if isinstance(trained := meta.get("extractor"), str):  # the shipped file: its extractor had the default fields
        meta = {**meta, "extractor": spec.to_json(spec.read(trained, discovery.EXTRACTOR))}
    return NeighbourModel(arrays=arrays, meta=meta, digest=digest)
