"""Inference: reconstruction of a photograph from a release by a network, averaged over symmetries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bench.core.device import pick_dtype
from bench.inversion.encoding import Encoded, Encoding, encode, encode_lines, sample_lines
from bench.inversion.flow import FlowNetwork
from bench.inversion.kinds import AnyNetwork
from bench.inversion.line_network import LineInverter, LineOutput
from bench.inversion.symmetry import AnyRelease, Symmetry
from bench.types import Floats, Release

REACH = 15.0  # pixels; an error of a position beyond it costs no more; as of the attack `neighbourhood`


def reconstruct_image(
    module: AnyNetwork,
    release: Release,
    symmetries: Sequence[Symmetry],
    settings: Floats,
    slots: int,
    encoding: Encoding,
) -> Floats:
    """Return the mean reconstruction of a release. -> (H, W, 3) in [0, 1]

    Raises
    ------
    TypeError
        if the network samples photographs (`bench.inversion.flow`).
    """
    if isinstance(module, FlowNetwork):
        raise TypeError("the network samples photographs, and reconstructs none")
    samples = module.shape.samples

    def encode_one(transformed: Release) -> Encoded:
        if samples:
            return encode_lines([transformed], [settings], slots, encoding, samples)
        return encode([transformed], [settings], slots, encoding)

    return average_reconstructions(module, release, symmetries, encode_one)


@torch.inference_mode()
def locate_keypoints(
    module: LineInverter,
    release: Release,
    symmetries: Sequence[Symmetry],
    settings: Floats,
    slots: int,
    encoding: Encoding,
) -> Floats:
    """Return the estimated position on each line: the sample with the least expected min(distance, REACH). -> (N, 2) pixels

    The posterior is the mean over symmetries of the release.
    """
    samples, device = module.shape.samples, next(module.parameters()).device
    posterior = torch.zeros(len(release), samples)
    for symmetry in symmetries:
        lines = encode_lines([symmetry.transform_release(release)], [settings], slots, encoding, samples)
        logs = run_network(module, lines.to(device)).logs.cpu()
        posterior += logs.exp().flip(1) if symmetry.mirrored else logs.exp()  # a mirrored line runs in the other direction
    points = torch.from_numpy(sample_lines(release, samples))  # (N, S, 2) pixels
    costs = torch.cdist(points, points).clamp(max=REACH) @ posterior[:, :, None]  # (N, S, 1)
    return points[torch.arange(len(release)), costs[:, :, 0].argmin(dim=1)].numpy()


def average_reconstructions(
    module: nn.Module,
    release: AnyRelease,
    symmetries: Sequence[Symmetry],
    encode_one: Callable[[AnyRelease], Encoded],
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
def infer(module: nn.Module, points: Encoded) -> Tensor:
    """Return the images of a network. -> (B, 3, H, W) float32 in [0, 1]

    Deterministic on one machine with a fixed number of threads.
    """
    output = run_network(module, points)
    images: Tensor = output.images if isinstance(output, LineOutput) else output
    return images.clamp(0, 1)


def run_network(module: nn.Module, points: Encoded) -> Any:
    """Return the output of a network, computed in the device's number format."""
    device = next(module.parameters()).device
    dtype = pick_dtype(device)
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        return module(points.to(device))
