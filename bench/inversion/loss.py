"""The training loss: L1 on colour and structural dissimilarity on luminance."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

SIGMA, RADIUS = 1.5, 5  # of the SSIM window, as in the metric
C1, C2 = 0.01**2, 0.03**2  # for images in [0, 1]
LUMA = (0.299, 0.587, 0.114)
WEIGHT = 0.3  # of the dissimilarity term


@functools.cache
def build_window(side: int, device: torch.device) -> Tensor:
    """Build the Gaussian window as a band matrix, so that filtering is two matrix products. -> (side - 2 RADIUS, side)"""
    taps = torch.exp(-(torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64) ** 2) / (2 * SIGMA**2))
    band = torch.zeros(side - 2 * RADIUS, side, dtype=torch.float64)
    for row in range(len(band)):
        band[row, row : row + len(taps)] = taps / taps.sum()
    return band.float().to(device)


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean structural similarity of one-channel images where the window fits, without sample covariance.

    (B, H, W) -> ()
    """
    rows, columns = build_window(a.shape[1], a.device), build_window(a.shape[2], a.device)
    mean_b, bb = rows @ torch.stack([b, b * b]) @ columns.T  # separate, since it needs no gradient in training
    mean_a, aa, ab = rows @ torch.stack([a, a * a, a * b]) @ columns.T
    covariance, variances = ab - mean_a * mean_b, aa - mean_a**2 + bb - mean_b**2
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return (luminance * (2 * covariance + C2) / (variances + C2)).mean()


def reconstruction_loss(reconstruction: Tensor, photograph: Tensor) -> Tensor:
    """Return L1 + 0.3 (1 - SSIM), with SSIM on luminance. (B, 3, H, W), (B, 3, H, W) -> ()"""
    luma = torch.tensor(LUMA, device=reconstruction.device).view(1, 3, 1, 1)
    similarity = ssim((reconstruction * luma).sum(dim=1), (photograph * luma).sum(dim=1))
    return (reconstruction - photograph).abs().mean() + WEIGHT * (1 - similarity)
