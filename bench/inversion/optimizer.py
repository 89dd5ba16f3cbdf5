"""An optimizer: Muon for matrices, AdamW for all other weights.

Muon (Jordan et al., 2024; Liu et al., arXiv 2502.16982) updates a matrix by the orthogonal matrix nearest to its averaged
gradient, so that the update has equal length in all directions. A convolution counts as a matrix of outputs by inputs.

`torch.optim.Muon` is the same, but always computes in bf16. Without hardware for bf16 that takes more time than the
rest of a step, and float32 a small part of it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from bench.core.device import pick_dtype

MOMENTUM = 0.95
NEWTON_SCHULZ = 3.4445, -4.7750, 2.0315  # coefficients of Jordan et al.
ITERATIONS = 5


class Optimizer:
    """Muon and AdamW with one learning rate. Muon's updates are scaled to the usual size of AdamW's."""

    def __init__(self, module: nn.Module, rate: float, decay: float) -> None:
        self.weights: dict[str, Tensor] = dict(module.named_parameters())
        self.matrices = {name: view_as_matrix(weight.detach()) for name, weight in self.weights.items() if weight.ndim > 1}
        self.vectors = {name: weight for name, weight in self.weights.items() if name not in self.matrices}
        self.muon = Muon(self.matrices.values(), {"lr": rate, "weight_decay": decay})
        self.adamw = torch.optim.AdamW(self.vectors.values(), rate, weight_decay=decay)
        self.parts = (self.matrices, self.muon), (self.vectors, self.adamw)

    @property
    def rate(self) -> float:
        """The learning rate."""
        return float(self.muon.param_groups[0]["lr"])

    @rate.setter
    def rate(self, rate: float) -> None:
        for group in self.muon.param_groups + self.adamw.param_groups:
            group["lr"] = rate

    def step(self) -> None:
        """Update all weights that have a gradient."""
        for name, view in self.matrices.items():
            gradient = self.weights[name].grad
            view.grad = None if gradient is None else view_as_matrix(gradient)
        self.muon.step()
        self.adamw.step()

    def state(self) -> dict[str, Tensor]:
        """Return the moments of each weight by name, for `restore`."""
        return {
            f"{name}/{key}": value
            for weights, optimizer in self.parts
            for name, weight in weights.items()
            for key, value in optimizer.state[weight].items()
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Load the result of `state`."""
        for weights, optimizer in self.parts:
            whole = optimizer.state_dict()
            whole["state"] = {
                index: {key.removeprefix(f"{name}/"): value for key, value in state.items() if key.startswith(f"{name}/")}
                for index, name in enumerate(weights)
            }
            optimizer.load_state_dict(whole)


class Muon(torch.optim.Optimizer):
    """Muon with Nesterov momentum, decoupled weight decay, and the scale of Liu et al., 0.2 sqrt(max(rows, columns))."""

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        for group in self.param_groups:
            for matrix in (matrix for matrix in group["params"] if matrix.grad is not None):
                state = self.state[matrix]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(matrix)
                momentum = state["momentum_buffer"].lerp_(matrix.grad, 1 - MOMENTUM)
                update = orthogonalize(matrix.grad.lerp(momentum, MOMENTUM), pick_dtype(matrix.device))
                matrix.mul_(1 - group["lr"] * group["weight_decay"])
                matrix.add_(update, alpha=-0.2 * group["lr"] * max(matrix.shape) ** 0.5)


def orthogonalize(matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """Return about the orthogonal matrix nearest to a matrix, by Newton-Schulz iterations: singular values from .7 to 1.2.

    (N, M) -> (N, M)
    """
    a, b, c = NEWTON_SCHULZ
    wide = (matrix.T if len(matrix) > matrix.shape[1] else matrix).to(dtype)
    wide = wide / wide.norm().clamp(min=1e-7)
    for _ in range(ITERATIONS):
        gram = wide @ wide.T
        wide = torch.addmm(wide, torch.addmm(gram, gram, gram, beta=b, alpha=c), wide, beta=a)
    return (wide.T if len(matrix) > matrix.shape[1] else wide).to(matrix.dtype)


def view_as_matrix(weight: Tensor) -> Tensor:
    """View a weight as (outputs, inputs). Convolutions must be in channels-last layout, or 1 x 1."""
    return weight if weight.ndim == 2 else weight.permute(0, 2, 3, 1).view(len(weight), -1)
