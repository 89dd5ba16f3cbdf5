"""A network in training: its weights, their moving average, and the state of the optimizer."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from bench.core.device import pick_device, pick_dtype
from bench.inversion.encoding import Encoded, EncodedLines, NoisyRelease
from bench.inversion.line_network import line_loss
from bench.inversion.loss import reconstruction_loss
from bench.inversion.optimizer import Optimizer
from bench.inversion.plan import Training

Module = TypeVar("Module", bound=nn.Module)
Loss = Callable[[Tensor, Tensor], Tensor]  # (B, 3, H, W) reconstructions, (B, 3, H, W) photographs -> ()


class Learner(Generic[Module]):
    """Executes training steps. Checkpoints store its state."""

    def __init__(self, module: Module, training: Training, loss: Loss = reconstruction_loss) -> None:
        self.training, self.loss = training, loss
        self.device = pick_device()
        self.dtype = pick_dtype(self.device)
        self.module: Module = module.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = Optimizer(self.module, training.rate, training.decay)
        self.step = 0
        self.reset_average()

    def reset_average(self) -> None:
        """Set the average to the current weights."""
        self.average = {name: value.clone() for name, value in self.module.state_dict().items()}

    def compute_loss(self, outputs: Any, points: Encoded, photographs: Tensor) -> Tensor:
        """Return the loss of the network's outputs. -> ()"""
        if isinstance(points, EncodedLines):
            return line_loss(outputs, photographs, points)
        if isinstance(points, NoisyRelease):
            return torch.as_tensor(outputs).square().mean()
        return self.loss(outputs, photographs)

    def learn(self, points: Encoded, photographs: Tensor, progress: float, parallel: nn.Module | None = None) -> Tensor:
        """Execute one training step, and return its loss. -> ()

        `progress` is the completed fraction of the training after the warm-up. If several processes split the batch, `parallel`
        is called instead of the network.
        """
        warm = self.training.warmup
        factor = (self.step + 1) / warm if self.step < warm else 0.5 * (1 + math.cos(math.pi * progress))
        self.optimizer.rate = self.training.rate * factor
        self.module.train()
        points = points.to(self.device)
        with torch.autocast(self.device.type, self.dtype, enabled=self.dtype != torch.float32):
            outputs = (parallel or self.module)(points)
        loss = self.compute_loss(outputs, points, photographs.to(self.device))
        self.module.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        decay = min(self.training.average, self.step / (self.step + 9))  # small at first, while the weights change fast
        for name, weight in self.module.state_dict().items():
            if weight.is_floating_point():
                self.average[name].lerp_(weight, 1 - decay)
        return loss.detach()

    def load_average(self) -> Module:
        """Load the averaged weights into the network and return it for inference."""
        self.module.load_state_dict(self.average)
        return self.module.eval()
