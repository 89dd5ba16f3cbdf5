"""What a network is a function of: releases, photographs, sizes, and how long it trains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.api import Asset, Defense, Extractor
from bench.core.errors import UserError
from bench.images.photographs import Source
from bench.inversion.data import Served
from bench.inversion.encoding import Encoding
from bench.inversion.network import COARSENET, Shape


@dataclass(frozen=True, kw_only=True)
class Training:
    """How long and how fast."""

    steps: int = 4000
    batch: int = 8
    rate: float = 4e-3  # the learning rate at its peak; cosine to zero
    warmup: int = 100  # steps
    decay: float = 0.02  # of the weights
    average: float = 0.998  # decay of the moving average of the weights
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1:
            raise UserError(f"training needs at least one step of one photograph, got {self.steps} of {self.batch}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """One training. No photograph should be in both sets."""

    defense: Defense  # with the settings that are fixed
    served: Served  # fields whose settings are drawn at random in training; one network serves them all
    photographs: Sequence[Source]
    validation: Sequence[Source]
    extractor: Extractor
    crossfit: Sequence[Asset] = ()  # dictionaries for photographs that helped to make the defense's own
    start: Path | None = None  # weights to start from, of a network for such releases or for raw descriptors; random ones if None
    encoding: Encoding = "invariant"  # what the network is told of a keypoint
    widths: tuple[int, ...] = Shape.widths  # of the network's levels
    training: Training = Training()  # frozen


@dataclass(frozen=True, kw_only=True)
class Profile:
    """The sizes of a network and of its training."""

    widths: tuple[int, ...] = Shape.widths
    training: Training = Training()  # frozen


PROFILES = {
    "cpu": Profile(),
    # The paper's network and about as many photographs as it had, each seen 40 times: days of a GPU.
    "paper": Profile(widths=COARSENET, training=Training(steps=125_000, batch=32, rate=2e-3, warmup=1000, average=0.9998)),
}
