"""The training loss: L1 on colour and structural dissimilarity on luminance.

Both have a backward pass of their own. The window of the SSIM is a band matrix, and blocks of its rows need few columns. The
gradient of L1 is a sign.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

SIGMA, RADIUS = 1.5, 5  # of the SSIM window, as in the metric
C1, C2 = 0.01**2, 0.03**2  # for images in [0, 1]
LUMA = (0.299, 0.587, 0.114)
WEIGHT = 0.3  # of the dissimilarity term
ROWS = 24  # of a block of the band matrix, about


def reconstruction_loss(reconstruction: Tensor, photograph: Tensor) -> Tensor:
    """Return L1 + 0.3 (1 - SSIM), with SSIM on luminance. (B, 3, H, W), (B, 3, H, W) -> ()"""
    luma = torch.tensor(LUMA, device=reconstruction.device).view(1, 3, 1, 1)
    similarity = ssim((reconstruction * luma).sum(dim=1), (photograph * luma).sum(dim=1))
    error: Tensor = _MeanMagnitude.apply(reconstruction - photograph)
    return error + WEIGHT * (1 - similarity)


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean structural similarity of one-channel images where the window fits, without sample covariance.

    (B, H, W) -> ()
    """
    mean_b, bb = filter_images(torch.cat([b, b * b])).chunk(2)  # separate, since it needs no gradient in training
    mean_a, aa, ab = filter_images(torch.cat([a, a * a, a * b])).chunk(3)
    covariance, variances = ab - mean_a * mean_b, aa - mean_a**2 + bb - mean_b**2
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return (luminance * (2 * covariance + C2) / (variances + C2)).mean()


def filter_images(images: Tensor) -> Tensor:
    """Apply the Gaussian window where it fits, and transpose. (B, H, W) -> (B, W - 2 RADIUS, H - 2 RADIUS)"""
    with torch.autocast(images.device.type, enabled=False):  # variances are differences of nearly equal numbers
        filtered: Tensor = _ColumnFilter.apply(images.float())
        twice: Tensor = _ColumnFilter.apply(filtered.transpose(1, 2))
    return twice


class _ColumnFilter(torch.autograd.Function):
    """Filters the columns. (B, H, W) -> (B, H - 2 RADIUS, W)"""

    @staticmethod
    def forward(ctx: Any, images: Tensor) -> Tensor:
        ctx.side = images.shape[1]
        return _multiply(list_blocks(ctx.side, images.device)[0], images)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,) = gradients
        return _multiply(list_blocks(ctx.side, gradient.device)[1], gradient)


class _MeanMagnitude(torch.autograd.Function):
    """The mean of |x|. Its gradient at 0 is that of x > 0, or at -0 that of x < 0."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.abs().mean()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return torch.copysign(x.new_tensor(1 / x.numel()), x) * gradients[0]  # `sign` takes three times as long


Block = tuple[Tensor, slice]  # rows of a band matrix, without the columns of zeros before and after, and these columns


@functools.cache
def list_blocks(side: int, device: torch.device) -> tuple[Sequence[Block], Sequence[Block]]:
    """Return the blocks of the Gaussian window as a band matrix, (side - 2 RADIUS, side), and those of its transpose.

    Raises
    ------
    ValueError
        if the window does not fit.
    """
    if side <= 2 * RADIUS:
        raise ValueError(f"the window of the SSIM needs images of at least {2 * RADIUS + 1} pixels a side, got {side}")
    taps = torch.exp(-(torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64) ** 2) / (2 * SIGMA**2))
    band = torch.zeros(side - 2 * RADIUS, side, dtype=torch.float64)
    for row in range(len(band)):
        band[row, row : row + len(taps)] = taps / taps.sum()
    return _split(band.float().to(device)), _split(band.T.float().to(device))


def _split(band: Tensor) -> Sequence[Block]:
    blocks = []
    for rows in band.tensor_split(-(-len(band) // ROWS)):
        (used,) = rows.any(dim=0).nonzero(as_tuple=True)
        columns = slice(int(used[0]), int(used[-1]) + 1)
        blocks.append((rows[:, columns].contiguous(), columns))
    return blocks


def _multiply(blocks: Sequence[Block], images: Tensor) -> Tensor:
    """Return the product of a band matrix and each image."""
    return torch.cat([rows @ images[:, columns] for rows, columns in blocks], dim=1)
