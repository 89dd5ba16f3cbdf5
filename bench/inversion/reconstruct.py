"""Inference: reconstruction of a photograph from a release by a network, averaged over symmetries."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from bench.core.device import pick_dtype
from bench.inversion.encoding import EncodedRelease, Encoding, encode
from bench.inversion.symmetry import AnyRelease, Symmetry
from bench.types import Floats, Release


def reconstruct_image(
    module: nn.Module, release: Release, symmetries: Sequence[Symmetry], settings: Floats, slots: int, encoding: Encoding
) -> Floats:
    """Return the mean reconstruction of a release. -> (H, W, 3) in [0, 1]"""
    return average_reconstructions(
        module, release, symmetries, lambda transformed: encode([transformed], [settings], slots, encoding)
    )


def average_reconstructions(
    module: nn.Module,
    release: AnyRelease,
    symmetries: Sequence[Symmetry],
    encode_one: Callable[[AnyRelease], EncodedRelease],
) -> Floats:
    """Return the mean of the reconstructions from all symmetries of the release, each transformed back. -> (H, W, 3) in [0, 1]

    The errors of the network differ between symmetries, and some cancel.
    """
    images = []
    for symmetry in symmetries:
        encoded = encode_one(symmetry.transform_release(release))
        images.append(symmetry.invert_image(infer(module, encoded)[0]))
    return torch.stack(images).mean(dim=0).permute(1, 2, 0).cpu().numpy()


@torch.inference_mode()
def infer(module: nn.Module, points: EncodedRelease) -> Tensor:
    """Return the output of a network. -> (B, 3, H, W) float32 in [0, 1]

    Deterministic on one machine with a fixed number of threads.
    """
    device = next(module.parameters()).device
    dtype = pick_dtype(device)
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        images: Tensor = module(points.to(device))
    return images.clamp(0, 1)
