"""Base class of tasks, and their data: images with secret and release, the trial, and its outcome."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from bench.api import Attack, Dataset, Defense, Extractor, Metric, Plugin, View
from bench.types import Bytes, Features, Floats, Points, Positions, Release

if TYPE_CHECKING:
    from bench.codebook.public import Public
    from bench.images.samples import Collection, Images, Sample
    from bench.images.scene import Mask

# Executes a method of an attack, such as `attack.recover`, on a view.
Execute = Callable[[Callable[[View, np.random.Generator], Any], View, np.random.Generator], Any]


def execute_in_process(method: Callable[[View, np.random.Generator], Any], view: View, rng: np.random.Generator) -> Any:
    """Return `method(view, rng)`, executed in this process. `bench.runner.attack_process` executes it in another."""
    return method(view, rng)


# Start of the note on a query whose intrinsics are wrong, since its raw features fit another focal length.
REJECTED = "intrinsics rejected"


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtractedImage:
    """One image of a sample, and the secret extracted from it."""

    pixels: Callable[[], Bytes]  # (H, W, 3); read on demand
    secret: Features
    foreground: Callable[[], Mask | None] = lambda: None  # (H, W) True where an object hides the static scene; None if unknown
    notes: tuple[str, ...] = ()  # on the conversion of the image


@dataclass(frozen=True, kw_only=True, eq=False)
class ProtectedImage(ExtractedImage):
    """One image of a sample with its release."""

    release: Release


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One sample of one experiment: the secret, the release, and the attack."""

    sample: Sample
    images: tuple[ProtectedImage, ...]  # one for each image of the sample
    defense: Defense
    attack: Attack | None  # None where the task evaluates the release itself
    extractor: Extractor
    public: Public
    metrics: tuple[Metric, ...]
    rng: np.random.Generator
    others: Callable[[int], Iterator[Release]]  # count -> the first `count` releases of other photographs
    repeats: tuple[Release, ...]  # further releases of the first image's features
    execute: Execute = execute_in_process
    provenance: Mapping[str, Any] | None = None  # JSON: all inputs of the releases; None disables the attack cache

    @property
    def secret(self) -> Features:
        """The secret of the first image. Most samples have one image."""
        return self.images[0].secret

    @property
    def release(self) -> Release:
        """The release of the first image."""
        return self.images[0].release

    def pixels(self) -> Bytes:
        """Read the first image. -> (H, W, 3)"""
        return self.images[0].pixels()

    def with_release(self, release: Release) -> Trial:
        """Return the trial with another release of the first image."""
        return replace(self, images=(replace(self.images[0], release=release), *self.images[1:]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """The result of a trial."""

    metrics: Mapping[str, float | None]
    image: Floats | None = None  # (H, W, 3) in [0, 1], the reconstruction if there is one
    estimates: Mapping[str, Any] = field(default_factory=dict)  # JSON: estimates other than metrics, such as a pose
    notes: tuple[str, ...] = ()
    saved_seconds: float = 0.0  # seconds that the attack cache saved


class Task(Plugin, ABC):
    """A measure of releases or of attacks on them. A task evaluates one trial; the runner plans, resumes and records."""

    judges_attacks: ClassVar[bool]  # whether it evaluates the result of an attack, not the release itself
    needs_scene: ClassVar[bool] = False  # whether its samples come from a scene; without a dataset it has a default scene
    needs_map: ClassVar[bool] = False  # whether it uses the server's map
    accepts_positions: ClassVar[tuple[type[Positions], ...]] = (Points,)

    @abstractmethod
    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        """Return the samples of `images` or of `dataset`; if both are None, of the task's default.

        Raises
        ------
        UserError
            if the input is missing or damaged, or the task does not accept it.
        """

    @abstractmethod
    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        """Return the reason why the task cannot evaluate this pair; None if it can."""

    @abstractmethod
    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        """Return digests of the other plugins and files that the attack uses, for its recorded configuration.

        Raises
        ------
        UserError
            if one of them is missing or damaged.
        """

    @abstractmethod
    def evaluate(self, trial: Trial) -> Outcome:
        """Evaluate one trial.

        Raises
        ------
        SampleError
            if the trial cannot be evaluated.
        """
