"""Base class of tasks: what a trial is made of, how a task evaluates it, and how attacks are executed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from bench.api import Attack, Dataset, Defense, Extractor, Metric, Plugin, View
from bench.types import Bytes, Features, Floats, Release

if TYPE_CHECKING:
    from bench.codebook.public import Public
    from bench.images.samples import Collection, Images, Sample
    from bench.images.scene import Mask

# Executes a method of an attack, such as `attack.recover`, on a view.
Execute = Callable[[Callable[[View, np.random.Generator], Any], View, np.random.Generator], Any]


def execute_in_process(method: Callable[[View, np.random.Generator], Any], view: View, rng: np.random.Generator) -> Any:
    """Return `method(view, rng)`, executed in this process. `bench.runner.attack_process` executes it in another."""
    return method(view, rng)


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtractedImage:
    """One image of a sample, and the secret extracted from it."""

    pixels: Callable[[], Bytes]  # (H, W, 3); read on demand
    secret: Features
    foreground: Callable[[], Mask | None] = lambda: None  # (H, W) True where something hides the static scene, if that is known
    notes: tuple[str, ...] = ()  # on how the image was read


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
    others: Callable[[int], Iterator[Release]]  # from a number to the first so many releases of other photographs
    repeats: tuple[Release, ...]  # further releases of the first image's features
    execute: Execute = execute_in_process
    provenance: Mapping[str, Any] | None = None  # JSON: all that the releases are a function of; None disables the attack cache

    @property
    def secret(self) -> Features:
        """The secret of the first image, which for most samples is the only one."""
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
    estimates: Mapping[str, Any] = field(default_factory=dict)  # JSON: estimates that are no measures, such as a pose
    notes: tuple[str, ...] = ()
    saved_seconds: float = 0.0  # seconds that the attack cache saved


class Task(Plugin, ABC):
    """The measure of a release. The runner plans, resumes and records; a task evaluates one trial at a time."""

    judges_attacks: ClassVar[bool]  # whether it evaluates what an attack recovers, and not the release itself
    needs_scene: ClassVar[bool] = False  # whether it is about a scene, also where none is named
    needs_map: ClassVar[bool] = False  # whether it asks for the server's map

    @abstractmethod
    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        """Return the samples of photographs or of a scene; of the built-in ones where neither is given.

        Raises
        ------
        UserError
            if they are missing or damaged, or are not for this task.
        """

    @abstractmethod
    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        """Return why there is nothing to evaluate in that pair; None if there is."""

    @abstractmethod
    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        """Return digests of the other plugins and files that the attack would use, for its recorded configuration.

        Raises
        ------
        UserError
            if something that it would use is missing or damaged.
        """

    @abstractmethod
    def evaluate(self, trial: Trial) -> Outcome:
        """Evaluate one trial.

        Raises
        ------
        SampleError
            if it cannot be done.
        """
