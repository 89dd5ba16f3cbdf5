"""An optimizer: Muon for matrices, AdamW for all other weights.

Muon (Jordan et al., 2024; Liu et al., arXiv 2502.16982) updates a matrix by the orthogonal matrix nearest to its averaged
gradient, so that the update has equal length in all directions. A convolution counts as a matrix of outputs by inputs.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn


class Optimizer:
    """Muon and AdamW with one learning rate. Muon's updates are scaled to the usual size of AdamW's."""

    def __init__(self, module: nn.Module, rate: float, decay: float) -> None:
        self.weights: dict[str, Tensor] = dict(module.named_parameters())
        self.matrices = {name: view_as_matrix(weight.detach()) for name, weight in self.weights.items() if weight.ndim > 1}
        self.vectors = {name: weight for name, weight in self.weights.items() if name not in self.matrices}
        self.muon = torch.optim.Muon(self.matrices.values(), rate, weight_decay=decay, adjust_lr_fn="match_rms_adamw")
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


def view_as_matrix(weight: Tensor) -> Tensor:
    """View a weight as (outputs, inputs). Convolutions must be in channels-last layout, or 1 x 1."""
    return weight if weight.ndim == 2 else weight.permute(0, 2, 3, 1).view(len(weight), -1)
