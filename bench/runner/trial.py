"""Carries out a plan, one unit of one cell at a time: read, extract, protect, judge, record.

The randomness of a release is a function of (seed, photograph's content, defense, extractor) alone, never of the attack, the
order, the process, or what was done before.
"""

from __future__ import annotations

import contextlib
import functools
import io
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from bench.api import Attack, Defense, Outcome, ProtectedImage, Trial, execute_in_process
from bench.cache import feature_cache
from bench.core import hashing
from bench.core.errors import PluginError, SampleError, UserError, blame
from bench.core.randomness import randomness
from bench.images import samples
from bench.images.photographs import Source
from bench.images.samples import ImageSource, Sample
from bench.mechanisms import composition
from bench.registry import spec
from bench.runner.other_releases import OtherReleases
from bench.runner.records import EVERY_SAMPLE, Record
from bench.types import Bytes, Features, Floats, Release

if TYPE_CHECKING:
    from bench.runner.plan import Experiment, Plan


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came of one unit of one cell. Whoever keeps the run writes it down; nobody else writes anything."""

    record: Record
    picture: bytes | None = None  # the reconstruction, if one was made, as PNG
    trace: str | None = None  # of a plugin that broke


@dataclass(frozen=True, eq=False)
class _Observed:
    """What the owner of an image has."""

    image: ImageSource
    features: Features
    pixels: Callable[[], Bytes]
    notes: tuple[str, ...]


class Trials:
    """The trials of a plan. What those of one unit share is made once, if they come in a row."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._order = hashing.digest(list(plan.hashes))  # in which the releases of others come
        self._observed = functools.lru_cache(maxsize=1)(self._observe)
        self._shots = functools.lru_cache(maxsize=1)(self._release)
        self._population = functools.lru_cache(maxsize=None)(self._others)

    def execute(self, cell: Experiment, unit: Sample) -> Result:
        """Read and extract the unit, protect it, let the attack at it, and record how that ended."""
        try:
            return self._judged(cell, unit)
        except (SampleError, UserError) as error:
            trace = "".join(traceback.format_exception(error)) if isinstance(error, PluginError) else None
            return Result(record=record(cell, unit, status="failed", reason=str(error)), trace=trace)

    def forget(self) -> None:
        """Let go of the last unit's releases, which may be gigabytes, and would wait for the collector of cycles."""
        self._observed.cache_clear()
        self._shots.cache_clear()

    def rehearse(self) -> None:
        """Protect one keypoint of the first good image by each defense.

        Raises
        ------
        UserError
            if a defense cannot do what was asked of it.
        """
        plan = self.plan
        for unit in plan.samples:
            try:
                features = self._seen(unit.images[0]).features
            except SampleError:
                continue
            for cell in {cell.defense: cell for cell in plan.experiments}.values():
                with contextlib.suppress(SampleError):  # a broken plugin makes failed records, later
                    self._protect(cell, features.take(np.arange(1)), "rehearsal")
            return

    def _observe(self, unit: Sample) -> tuple[_Observed, ...]:
        return tuple(self._seen(image) for image in unit.images)

    def _seen(self, image: ImageSource) -> _Observed:
        extractor = self.plan.extractor
        if isinstance(image, Source):
            with blame("the reader of photographs"):
                pixels, notes = samples.read_pixels(image)
            with blame(f"plugin {extractor.name()}"):
                features = extractor.extract(pixels, image.path)
            seen = _Observed(image, features, lambda: pixels, notes)
        else:
            with blame(f"plugin {extractor.name()}"):
                features = feature_cache.features(extractor, image)
            seen = _Observed(image, features, image.read, ())
        if len(features) == 0:
            raise SampleError("no keypoint was found")
        return seen

    def _release(self, defense: Defense, unit: Sample) -> tuple[ProtectedImage, ...]:
        """The release of each image of a unit: a function of the image's content alone."""
        cell, shots = self._cell(defense), []
        for seen in self._observed(unit):
            content = self.plan.hashes[unit.name] if len(unit.images) == 1 else seen.image.content_hash()
            release = self._protect(cell, seen.features, content)
            foreground = functools.partial(samples.read_foreground, seen.image)
            shots.append(ProtectedImage(pixels=seen.pixels, secret=seen.features, release=release, foreground=foreground))
        return tuple(shots)

    def _protect(self, cell: Experiment, features: Features, content: str, *repetition: int) -> Release:
        plan, defense = self.plan, cell.defense
        made_with = cell.metadata["defense"], cell.metadata["dataset"]["extractor"]
        if defense.is_memoized():  # all photographs, and all their repetitions, come from one device
            rng = randomness("device", plan.seed, *made_with)
        else:
            rng = randomness("release", plan.seed, content, *made_with, *repetition)
        with blame(f"plugin {defense.name()}"):
            release = defense.protect(features, plan.public, rng)
            if not isinstance(release, defense.releases):
                raise TypeError(f"protect returned {type(release).__name__}, expected {defense.releases.__name__}")
        return release

    def _others(self, defense: Defense) -> OtherReleases:
        """Releases of the dataset's photographs by that defense."""
        plan, head = self.plan, self._cell(defense).metadata
        sources = [image for unit in plan.samples for image in unit.images if isinstance(image, Source)]
        drawn = functools.partial(randomness, "population", plan.seed, head["defense"], head["dataset"]["extractor"])
        return OtherReleases(sources, plan.extractor, defense, plan.public, drawn)

    def _cell(self, defense: Defense) -> Experiment:
        """One that has that defense."""
        return next(cell for cell in self.plan.experiments if cell.defense == defense)

    def trial(self, cell: Experiment, unit: Sample) -> Trial:
        """A unit of a cell, extracted and protected, before it is judged.

        Raises
        ------
        UnitError
            if it cannot be read, has no keypoint, or a plugin breaks.
        """
        plan, head, attack = self.plan, cell.metadata, cell.attack
        shots, content = self._shots(cell.defense, unit), plan.hashes[unit.name]
        made_with = head["defense"], head["dataset"]["extractor"]
        # Without what the task does with what was recovered: an attack that is painted by another inverter stays what it was.
        attacked = attack and spec.configuration(attack, plan.public, attack.assets(cell.defense, plan.extractor, plan.public))
        made_from = {
            "seed": plan.seed,
            "dataset": [head["dataset"]["hash"], self._order],
            "unit": [unit.name, content],
            "made with": made_with,
        }
        return Trial(
            sample=unit,
            images=shots,
            defense=cell.defense,
            attack=attack,
            extractor=plan.extractor,
            public=plan.public,
            metrics=plan.metrics,
            rng=randomness("attack", plan.seed, content, *made_with, attacked),
            others=self._population(cell.defense).without(unit.name),
            repeats=tuple(self._protect(cell, shots[0].secret, content, number) for number in _repetitions(attack)),
            execute=plan.execute,
            provenance=made_from if plan.execute is execute_in_process else None,  # whoever wants it done elsewhere wants it done
        )

    def _judged(self, cell: Experiment, unit: Sample) -> Result:
        tried = self.trial(cell, unit)
        started = time.perf_counter()
        with blame(f"task {self.plan.task.name()}"):
            outcome = self.plan.task.evaluate(tried)
        seconds = time.perf_counter() - started + outcome.saved_seconds
        keypoints = max(len(shot.secret) for shot in tried.images)
        notes = [note for seen in self._observed(unit) for note in seen.notes]
        found = record(cell, unit, status="ok", outcome=outcome, keypoints=keypoints, notes=notes, seconds=seconds)
        return Result(record=found, picture=None if outcome.image is None else _png(outcome.image))


def _repetitions(attack: Attack | None) -> range:
    """The numbers of the further releases that an attack sees. The first release has none."""
    return range(1, 1 + (0 if attack is None else attack.repeats()))


def record(
    cell: Experiment,
    unit: Sample | None,
    *,
    status: str,
    reason: str | None = None,
    outcome: Outcome | None = None,
    keypoints: int | None = None,
    notes: Sequence[str] = (),
    seconds: float | None = None,
) -> Record:
    """The record of a unit, or of all of them for None. `keypoints` are those of its image that has most."""
    found = {"estimates": dict(outcome.estimates)} if outcome is not None and outcome.estimates else {}
    return (
        cell.metadata
        | found
        | {
            "unit": EVERY_SAMPLE if unit is None else unit.name,
            "condition": None if unit is None else unit.condition,
            "status": status,
            "reason": reason,
            "metrics": {} if outcome is None else {**outcome.metrics, "keypoints": keypoints},
            "privacy": privacy(cell, keypoints),
            "seconds": seconds,
            "notes": [*notes, *(outcome.notes if outcome else ())],
        }
    )


def privacy(cell: Experiment, keypoints: int | None) -> dict[str, Any]:
    """What the defense promises of what is released of one image, and what nothing covers."""
    epsilon, remembers = cell.privacy.epsilon, cell.defense.is_memoized()
    # A device that remembers answers once, however often it is asked.
    releases = 1 if remembers or cell.attack is None else 1 + cell.attack.repeats()
    spent: dict[str, float | str | None] = {"epsilon_image": None, "epsilon_image_optimal": None}
    if epsilon is not None and keypoints is not None:
        answers = keypoints * releases
        spent["epsilon_image"] = spec.finite(composition.basic(epsilon, answers))
        spent["epsilon_image_optimal"] = spec.finite(composition.optimal(epsilon, answers))
    by_distance = cell.privacy.per_distance
    return {
        "guarantee": cell.privacy.guarantee,
        "epsilon_descriptor": spec.finite(epsilon),
        **({} if by_distance is None else {"epsilon_per_distance": float(by_distance)}),
        "keypoints": keypoints,
        "releases": releases,  # of the photograph
        **spent,
        "delta": composition.DELTA,  # of the optimal one
        "uncovered": [*composition.UNCOVERED, *([composition.LINKS] if remembers else [])],
        "log10_true": cell.privacy.log10_true,
        "seeded": True,
        "private": False,  # a seeded release is for measuring
    }


def _png(image: Floats) -> bytes:
    written = io.BytesIO()
    Image.fromarray(np.rint(image * 255.0).astype(np.uint8)).save(written, "png")
    return written.getvalue()
