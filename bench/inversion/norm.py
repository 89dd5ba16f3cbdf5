"""Batch norm over a batch that several processes share. PyTorch's `SyncBatchNorm` works on GPUs only."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, distributed, nn


class JointBatchNorm2d(nn.BatchNorm2d):
    """Batch norm by mean and variance over the batches of all processes, which have equal size. (B, C, H, W) -> the same."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        wide = x if x.dtype == torch.float64 else x.float()  # half precision is too coarse for sums over a batch
        processes = distributed.get_world_size()
        moments = torch.stack([wide.mean(dim=(0, 2, 3)), wide.square().mean(dim=(0, 2, 3))])  # (2, C)
        mean, square = _AllReduceSum.apply(moments) / processes
        variance = (square - mean.square()).clamp(min=0)  # rounding could make it negative
        self._update_running_statistics(mean.detach(), variance.detach(), x.numel() // x.shape[1] * processes)
        scale = self.weight * torch.rsqrt(variance + self.eps)
        shift = self.bias - mean * scale
        return (wide * scale[:, None, None] + shift[:, None, None]).to(x.dtype)

    @torch.no_grad()
    def _update_running_statistics(self, mean: Tensor, variance: Tensor, count: int) -> None:
        """Update the running statistics as batch norm does, with the unbiased variance."""
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.momentum is not None
        assert self.num_batches_tracked is not None
        self.num_batches_tracked += 1
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance * (count / max(1, count - 1)), self.momentum)


class _AllReduceSum(torch.autograd.Function):
    """Sums a tensor over all processes. The gradient is summed over all processes, too."""

    @staticmethod
    def forward(context: Any, part: Tensor) -> Tensor:
        whole = part.clone()
        distributed.all_reduce(whole)
        return whole

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        return _AllReduceSum.forward(context, gradient)


def convert_batch_norms(module: nn.Module) -> None:
    """Convert every batch norm of a module, in place, to a `JointBatchNorm2d`."""
    for inner in module.modules():
        if type(inner) is nn.BatchNorm2d:
            inner.__class__ = JointBatchNorm2d
