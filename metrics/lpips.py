"""Learned perceptual distance (Zhang et al., CVPR 2018), with weights that the user supplies."""

from __future__ import annotations

import functools
import importlib.util
import pickle
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal

from bench.api import Metric
from bench.core.errors import UserError
from bench.geometry.metric_inputs import to_tensors
from bench.types import Floats


@dataclass(frozen=True, kw_only=True)
class LPIPS(Metric):
    """Learned perceptual distance of AlexNet features, weighted by human judgements, from its authors' library.

    `weights` are torchvision's for AlexNet on ImageNet (alexnet-owt-7be5be79.pth). They are not part of this program, and nothing
    is downloaded. To enable this metric, pass the path of the weights.
    """

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    unit: ClassVar[str] = "distance"
    range: ClassVar[tuple[float, float]] = (0.0, float("inf"))
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]] = "defender"
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType({"network": "alex", "version": "0.1"})

    weights: Path

    def __post_init__(self) -> None:
        if importlib.util.find_spec("lpips") is None:
            raise UserError("lpips: its library is not installed; install it with pip install 'feature-privacy-bench[lpips]'")
        if not self.weights.is_file():
            raise UserError(f"lpips: {self.weights}: no such file; pass the path of torchvision's alexnet-owt-7be5be79.pth")
        _load_network(self.weights)

    def __call__(self, truth: Floats, estimate: Floats) -> float:
        import torch

        # (H, W, 3) in [0, 1] each
        images = to_tensors(truth, estimate)
        with torch.no_grad():
            return float(_load_network(self.weights)(*images, normalize=True))


@functools.lru_cache(maxsize=1)
def _load_network(weights: Path) -> Any:
    """Load the library's network with the user's weights instead of downloaded ones.

    Raises
    ------
    UserError
        if the file does not hold torchvision's weights of AlexNet.
    """
    import lpips
    import torch

    settings = LPIPS.parameters
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library uses a deprecated interface of torchvision
        network = lpips.LPIPS(net=settings["network"], version=settings["version"], pnet_rand=True, verbose=False)
    layers = network.net.state_dict()  # slice1.0.weight for features.0.weight
    try:
        state = torch.load(weights, map_location="cpu", weights_only=True)
        network.net.load_state_dict({name: state[f"features.{name.partition('.')[2]}"] for name in layers})
    except (KeyError, RuntimeError, TypeError, pickle.UnpicklingError) as error:
        raise UserError(f"lpips: {weights}: these are not torchvision's weights of AlexNet ({type(error).__name__})") from error
    return network


PLUGIN = LPIPS
