"""Inputs of a training: releases, photographs, sizes and schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from bench.api import Defense, Extractor
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.images.photographs import Source
from bench.images.views import LIMIT, RandomLimit
from bench.inversion.data import Target
from bench.inversion.encoding import Encoding
from bench.inversion.network import COARSENET, Shape
from bench.settings import Asset
from bench.types import Floats, Release

Model = Literal["inversion", "flow"]  # a network that reconstructs the photograph, or one that samples photographs


class Drafts(Protocol):
    """Makes drafts for a network that reads them (`bench.context.drafts`)."""

    def digest(self, defense: Defense, public: Public) -> str:
        """Return the digest of what makes the drafts for a defense."""

    def __call__(self, defense: Defense, release: Release, public: Public) -> Floats:
        """Return the draft of a release. -> (H, W, 3) in [0, 1]"""


@dataclass(frozen=True, kw_only=True)
class Training:
    """The schedule of a training."""

    steps: int = 4000
    batch: int = 8
    rate: float = 4e-3  # peak learning rate; decays to zero by a cosine
    warmup: int = 100  # steps
    decay: float = 0.02  # of the weights
    average: float = 0.998  # decay of the moving average of the weights
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1:
            raise UserError(f"--steps and --batch must be at least 1, got {self.steps} and {self.batch}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """One training. The training set and the validation set must not have a photograph in common."""

    targets: Sequence[Target]  # one network for all of them; their defenses share a dictionary
    photographs: Sequence[Source]
    validation: Sequence[Source]
    extractor: Extractor
    crossfit: Sequence[Asset] = ()  # dictionaries for photographs that the defense's own was built from
    initial_checkpoint: Path | None = None  # a network for the same kind of releases or for raw descriptors; None: random weights
    encoding: Encoding = "invariant"  # input of the network
    model: Model = "inversion"
    drafts: Drafts | None = None  # of the photographs, which the model "flow" reads beside the release
    widths: tuple[int, ...] = Shape.widths  # of the network's levels
    training: Training = Training()  # frozen
    keypoints: tuple[int, int] | None = None  # limits of each view's `max_keypoints`, drawn at random; None: the extractor's

    def __post_init__(self) -> None:
        if self.drafts is not None and self.model != "flow":
            raise UserError("--drafts: only --model flow reads drafts")
        if self.keypoints is None:
            return
        if len(self.keypoints) != 2 or not 1 <= self.keypoints[0] <= self.keypoints[1]:
            raise UserError(f"--keypoints: expected LOW,HIGH with 1 ≤ LOW ≤ HIGH, got {','.join(map(str, self.keypoints))}")
        if not hasattr(self.extractor, LIMIT):
            raise UserError(f"--keypoints: {self.extractor.name()} has no {LIMIT}")

    @property
    def training_extractor(self) -> Extractor:
        """The extractor of the training's views."""
        return self.extractor if self.keypoints is None else RandomLimit(extractor=self.extractor, limits=self.keypoints)


@dataclass(frozen=True, kw_only=True)
class Profile:
    """The sizes of a network and of its training."""

    widths: tuple[int, ...] = Shape.widths
    training: Training = Training()  # frozen


PROFILES = {
    "cpu": Profile(),
    # The encoder widths of CoarseNet, and 4 million training samples: 40 of each of 100,000 photographs. Days on a GPU.
    "paper": Profile(widths=COARSENET, training=Training(steps=125_000, batch=32, rate=2e-3, warmup=1000, average=0.9998)),
}
