"""What an attacker shows: a photograph painted by a network of a release, twice where it can be."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from attacks.inversion.encoding import Encoding, Points, encode
from bench.device import pick_dtype
from bench.types import Floats, Release


def painted(module: nn.Module, release: Release, mirror: Release | None, known: Floats, slots: int, encoding: Encoding) -> Floats:
    """The mean of what the network paints of a release and of that of the mirrored photograph. -> (H, W, 3) in [0, 1]

    A network's mistakes on the two differ, and some cancel. `mirror` is None where it is not known.
    """
    both = [release] if mirror is None else [release, mirror]
    images = paint(module, encode(both, [known] * len(both), slots, encoding)).cpu()
    mean = images[0] if mirror is None else (images[0] + images[1].flip(2)) / 2
    return mean.permute(1, 2, 0).numpy()


@torch.inference_mode()
def paint(module: nn.Module, points: Points) -> Tensor:
    """-> (B, 3, H, W) float32 in [0, 1]. Deterministic on one machine with one number of threads."""
    device = next(module.parameters()).device
    dtype = pick_dtype(device)
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        images: Tensor = module(points.to(device))
    return images.clamp(0, 1)
