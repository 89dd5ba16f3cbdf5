"""What an attacker shows: a photograph painted by a network of a release, under each symmetry that is known."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bench.core.device import pick_dtype
from bench.inversion.encoding import Encoding, Points, encode
from bench.inversion.symmetry import Symmetry
from bench.types import Floats, Release


def painted(
    module: nn.Module, release: Release, seen: Sequence[Symmetry], known: Floats, slots: int, encoding: Encoding
) -> Floats:
    """The mean of what the network paints of a release under each symmetry, moved back. -> (H, W, 3) in [0, 1]

    A network's mistakes on them differ, and some cancel.
    """
    images = []
    for symmetry in seen:
        moved = encode([symmetry.of_release(release)], [known], slots, encoding)
        images.append(symmetry.undone(paint(module, moved)[0]))
    return torch.stack(images).mean(dim=0).permute(1, 2, 0).cpu().numpy()


@torch.inference_mode()
def paint(module: nn.Module, points: Points) -> Tensor:
    """-> (B, 3, H, W) float32 in [0, 1]. Deterministic on one machine with one number of threads."""
    device = next(module.parameters()).device
    dtype = pick_dtype(device)
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        images: Tensor = module(points.to(device))
    return images.clamp(0, 1)
