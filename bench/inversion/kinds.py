"""The kinds of networks that `bench train` trains."""

from __future__ import annotations

from bench.inversion.flow import FlowNetwork
from bench.inversion.line_network import LineInverter
from bench.inversion.network import Inverter, Shape

AnyNetwork = Inverter | LineInverter | FlowNetwork


def build_network(shape: Shape, model: str | None = None) -> AnyNetwork:
    """Return a network of this shape with random weights. `model` is a key of `bench.inversion.weights.MODELS`."""
    if model == "flow":
        return FlowNetwork(shape)
    return LineInverter(shape) if shape.samples else Inverter(shape)
