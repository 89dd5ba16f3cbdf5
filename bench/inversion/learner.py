"""A network that learns: its weights, their moving average, and the optimizer's state."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

from bench.core.device import pick_device, pick_dtype
from bench.inversion.encoding import Points
from bench.inversion.loss import reconstruction_loss
from bench.inversion.optimizer import Optimizer
from bench.inversion.plan import Training

Module = TypeVar("Module", bound=nn.Module)
Loss = Callable[[Tensor, Tensor], Tensor]  # (B, 3, H, W) painted, (B, 3, H, W) photographs -> ()


class Learner(Generic[Module]):
    """Takes steps; what it is made of is what a checkpoint holds."""

    def __init__(self, module: Module, training: Training, loss: Loss = reconstruction_loss) -> None:
        self.training, self.loss = training, loss
        self.device = pick_device()
        self.dtype = pick_dtype(self.device)
        self.module: Module = module.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimizer = Optimizer(self.module, training.rate, training.decay)
        self.step = 0
        self.remember()

    def remember(self) -> None:
        """Let the average be the weights as they are."""
        self.average = {name: value.clone() for name, value in self.module.state_dict().items()}

    def learn(self, points: Points, photographs: Tensor, done: float, shared: nn.Module | None = None) -> Tensor:
        """One step, and its loss. `done` is the share of the training before it, after the warm-up; `shared` is called instead
        of the network where several processes share the batch. -> ()"""
        warm = self.training.warmup
        factor = (self.step + 1) / warm if self.step < warm else 0.5 * (1 + math.cos(math.pi * done))
        self.optimizer.rate = self.training.rate * factor
        self.module.train()
        with torch.autocast(self.device.type, self.dtype, enabled=self.dtype != torch.float32):
            painted = (shared or self.module)(points.to(self.device))
        loss = self.loss(painted, photographs.to(self.device))
        self.module.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        keep = min(self.training.average, self.step / (self.step + 9))  # short memory while weights still run away
        for name, weight in self.module.state_dict().items():
            if weight.is_floating_point():
                self.average[name].lerp_(weight, 1 - keep)
        return loss.detach()

    def averaged(self) -> Module:
        """The network with averaged weights, ready to paint."""
        self.module.load_state_dict(self.average)
        return self.module.eval()
