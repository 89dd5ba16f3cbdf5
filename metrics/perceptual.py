"""Perceptual distance that tolerates shifts (ST-LPIPS; Ghildyal and Liu, ECCV 2022), in the network of the library `lpips`.

The weights are those of the authors, in the package `stlpips-pytorch`. Their AlexNet differs from the library's: convolutions of
stride 2 and the maxima of pooling are followed by a blur, whose output has every second pixel.
"""

from __future__ import annotations

import functools
import importlib.util
import itertools
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal

from bench.api import Metric
from bench.core.errors import UserError
from bench.formats.pretrained import INSTALLED, find_weights, read_weights
from bench.geometry.metric_inputs import to_tensors
from bench.types import Floats

FILE = "stlpips_pytorch/weights/vST0.0/alex_shift_tolerant.pth"
INSTALL = "pip install 'feature-privacy-bench[perceptual]'"
ALIASES = "lins."  # other names of the library for lin0, lin1, ..., which are not in the file
SLICES = (3, 7, 11, 13, 15)  # layers up to each activation that is compared


@dataclass(frozen=True, kw_only=True)
class Perceptual(Metric):
    """Learned perceptual distance of AlexNet features that tolerates shifts (ST-LPIPS), weighted by human judgements."""

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "distance"
    range: ClassVar[tuple[float, float]] = (0.0, float("inf"))
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({"network": "alex", "version": "ST0.0"})
    packages: ClassVar[tuple[str, ...]] = ("lpips", "stlpips-pytorch", "torchvision")

    weights: Path = INSTALLED  # of the package stlpips-pytorch, or a file; records hold the digest of the content

    def __post_init__(self) -> None:
        if importlib.util.find_spec("lpips") is None:
            raise UserError(f"perceptual: its library is not installed; install it with {INSTALL}")
        object.__setattr__(self, "weights", find_weights("perceptual", self.weights, "stlpips-pytorch", FILE, INSTALL))

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        import torch

        # (H, W, 3) in [0, 1] each
        images = to_tensors(truth, estimate)
        with torch.inference_mode():
            return float(_load_network(self.weights)(*images, normalize=True))


@functools.lru_cache(maxsize=1)
def _load_network(weights: Path) -> Any:
    """Load the library's network with the authors' layers and weights.

    Raises
    ------
    UserError
        if the file does not hold them.
    """
    import lpips
    import torch

    with warnings.catch_warnings(), torch.device("meta"):  # without random weights
        warnings.simplefilter("ignore")  # the library uses a deprecated interface of torchvision
        network = lpips.LPIPS(net="alex", pretrained=False, pnet_rand=True, verbose=False)
        layers = list(enumerate(_build_layers()))
    for number, (first, last) in enumerate(itertools.pairwise((0, *SLICES)), start=1):
        parts = OrderedDict((str(index), layer) for index, layer in layers[first:last])
        setattr(network.net, f"slice{number}", torch.nn.Sequential(parts))
    state = {name.replace(".filt", ".weight"): value for name, value in read_weights("perceptual", weights).items()}
    try:
        keys = network.load_state_dict(state, strict=False, assign=True)
    except RuntimeError:  # other shapes
        keys = None
    if keys is None or keys.unexpected_keys or any(not name.startswith(ALIASES) for name in keys.missing_keys):
        raise UserError(f"perceptual: {weights}: not the weights of ST-LPIPS with AlexNet")
    return network.eval()


def _build_layers() -> Iterator[Any]:
    """Yield the layers of AlexNet in which each stride of 2 is a blur. Its filters are of 3 x 3 for each channel."""
    from torch.nn import Conv2d, MaxPool2d, ReLU

    def build_blur(channels: int) -> Any:
        return Conv2d(channels, channels, 3, stride=2, padding=2, padding_mode="reflect", groups=channels, bias=False)

    yield from (Conv2d(3, 64, 11, stride=1, padding=2), build_blur(64), ReLU())
    yield from (MaxPool2d(3, stride=1), build_blur(64), Conv2d(64, 192, 5, padding=2), ReLU())
    yield from (MaxPool2d(3, stride=1), build_blur(192), Conv2d(192, 384, 3, padding=1), ReLU())
    yield from (Conv2d(384, 256, 3, padding=1), ReLU(), Conv2d(256, 256, 3, padding=1), ReLU())


PLUGIN = Perceptual
