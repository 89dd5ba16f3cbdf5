"""Execution of one sample of one experiment: read, extract, protect, evaluate, record.

The randomness of a release is a function of (seed, photograph's content, defense, extractor) alone. It does not depend on the
attack, the order, the process, or earlier samples. The strings "release", "device", "population", "attack", "rehearsal" and the
keys of `provenance` enter that randomness and the keys of caches. They are data, and their wording must not change.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from bench.api import Defense, Extractor
from bench.cache import feature_cache
from bench.core import hashing
from bench.core.errors import PluginError, SampleError, UserError, wrap_plugin_errors
from bench.core.randomness import derive_generator
from bench.images import samples
from bench.images.photographs import Source
from bench.images.samples import ImageSource, Sample
from bench.mechanisms import composition, protection
from bench.registry import fields, spec
from bench.runner.other_releases import ReleasePool
from bench.runner.plan import Experiment, Plan, select_metrics
from bench.runner.records import EVERY_SAMPLE, Record, seal
from bench.task_api import ExtractedImage, Outcome, ProtectedImage, Trial, execute_in_process
from bench.threat_model import PublicDatabase
from bench.types import Bytes, Features, Release


@dataclass(frozen=True, kw_only=True)
class Result:
    """The record of one sample of one experiment, and its files. Only `execute` writes them."""

    record: Record
    reconstruction: bytes | None = None  # PNG
    photograph: bytes | None = None  # PNG, with a sample's first reconstruction
    trace: str | None = None  # traceback of a plugin that raised


class TrialRunner:
    """Executes the trials of a plan. Consecutive trials of one sample use the same features and releases."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._order = hashing.digest(list(plan.hashes))  # determines the order of other releases
        self._protect_sample = functools.lru_cache(maxsize=1)(self._protect_images)
        self._pool = functools.lru_cache(maxsize=None)(self._build_pool)
        self._pictured: str | None = None  # the sample whose photograph was last returned

    def execute(self, experiment: Experiment, sample: Sample) -> Result:
        """Read, extract, protect and evaluate the sample, and return the result. A failure gives a record, too."""
        try:
            return self._evaluate(experiment, sample)
        except (SampleError, UserError) as error:
            trace = "".join(traceback.format_exception(error)) if isinstance(error, PluginError) else None
            return Result(record=build_record(experiment, sample, status="failed", reason=str(error)), trace=trace)

    def clear(self) -> None:
        """Drop the last sample's features and releases, which may be gigabytes."""
        _extract_sample.cache_clear()
        self._protect_sample.cache_clear()

    def build_trial(self, experiment: Experiment, sample: Sample) -> Trial:
        """Extract and protect a sample, and return the trial.

        Raises
        ------
        SampleError
            if it cannot be read, has no keypoint, or a plugin raises.
        """
        plan, attack = self.plan, experiment.attack
        images, content = self._protect_sample(experiment.defense, sample), plan.hashes[sample.name]
        configurations = experiment.metadata["defense"], experiment.metadata["dataset"]["extractor"]
        # Without the task's settings, so that an attack draws the same numbers if another inverter is chosen.
        configuration = attack and spec.to_json_with_digests(
            attack, plan.public, attack.assets(experiment.defense, plan.extractor, plan.public)
        )
        provenance = {
            "seed": plan.seed,
            "dataset": [experiment.metadata["dataset"]["hash"], self._order],
            "unit": [sample.name, content],
            "made with": configurations,
        }
        return Trial(
            sample=sample,
            images=images,
            defense=experiment.defense,
            attack=attack,
            extractor=plan.extractor,
            public=plan.public,
            metrics=select_metrics(plan.metrics, experiment.defense),
            rng=derive_generator("attack", plan.seed, content, *configurations, configuration),
            others=self._pool(experiment.defense).without(sample.name),
            repeats=tuple(
                self.protect(experiment, images[0].secret, content, number)
                for number in range(1, 1 + (0 if attack is None else attack.repeats()))
            ),
            execute=plan.execute,
            # With a cached result, the attack process would not execute the attack.
            provenance=provenance if plan.execute is execute_in_process else None,
        )

    def protect(self, experiment: Experiment, features: Features, content: str, *repetition: int | str) -> Release:
        """Return the release of the features of a photograph with that content hash. The first release has no `repetition`."""
        plan, defense = self.plan, experiment.defense
        configurations = experiment.metadata["defense"], experiment.metadata["dataset"]["extractor"]
        if defense.is_memoized():  # all photographs and all repetitions belong to one device
            rng = derive_generator("device", plan.seed, *configurations)
        else:
            rng = derive_generator("release", plan.seed, content, *configurations, *repetition)
        with wrap_plugin_errors(f"plugin {defense.name()}"):
            release = defense.protect(features, plan.public, rng)
            if not isinstance(release, defense.releases):
                raise TypeError(f"protect returned {type(release).__name__}, expected {defense.releases.__name__}")
        return release

    def _protect_images(self, defense: Defense, sample: Sample) -> tuple[ProtectedImage, ...]:
        """Return each image of a sample with its release, which is a function of the image's content alone."""
        experiment, images = self._find_experiment(defense), []
        for source, extracted in zip(sample.images, extract_sample(self.plan, sample), strict=True):
            content = self.plan.hashes[sample.name] if len(sample.images) == 1 else source.content_hash()
            rng = derive_generator("order", self.plan.seed, content, experiment.metadata["defense"])
            shuffled = dataclasses.replace(extracted, secret=protection.hide_order(extracted.secret, defense, rng))
            release = self.protect(experiment, shuffled.secret, content)
            images.append(ProtectedImage(**vars(shuffled), release=release))
        return tuple(images)

    def _build_pool(self, defense: Defense) -> ReleasePool:
        """Return releases of the dataset's photographs by that defense."""
        plan, metadata = self.plan, self._find_experiment(defense).metadata
        sources = [image for sample in plan.samples for image in sample.images if isinstance(image, Source)]
        derive = functools.partial(
            derive_generator, "population", plan.seed, metadata["defense"], metadata["dataset"]["extractor"]
        )
        return ReleasePool(sources, plan.extractor, defense, plan.public, derive)

    def _find_experiment(self, defense: Defense) -> Experiment:
        """Return an experiment with that defense."""
        return next(experiment for experiment in self.plan.experiments if experiment.defense == defense)

    def _evaluate(self, experiment: Experiment, sample: Sample) -> Result:
        trial = self.build_trial(experiment, sample)
        started = time.perf_counter()
        with wrap_plugin_errors(f"task {self.plan.task.name()}"):
            outcome = self.plan.task.evaluate(trial)
        seconds = time.perf_counter() - started + outcome.saved_seconds
        keypoints = max(len(image.secret) for image in trial.images)
        notes = [note for image in trial.images for note in image.notes]
        record = build_record(experiment, sample, status="ok", outcome=outcome, keypoints=keypoints, notes=notes, seconds=seconds)
        if outcome.image is None:
            return Result(record=record)
        photograph = None if self._pictured == sample.name else _encode_png(trial.pixels())
        self._pictured = sample.name
        image = np.rint(outcome.image * 255.0).astype(np.uint8)
        return Result(record=record, reconstruction=_encode_png(image), photograph=photograph)


def dry_run(plan: Plan) -> None:
    """Protect one keypoint of the first readable image by each defense, to detect errors before anything is written.

    The public databases of the attacks have to suit its features as well.

    Raises
    ------
    UserError
        if no pair applies, a defense refuses its configuration, or a database is of other features.
    """
    if all(experiment.reason for experiment in plan.experiments):
        reasons = "; ".join(sorted({str(experiment.reason) for experiment in plan.experiments}))
        raise UserError(f"nothing to run: {reasons}; `bench list attacks` shows the attacks that apply to each defense")
    runner = TrialRunner(plan)
    for sample in plan.samples:
        try:
            features = extract_sample(plan, sample)[0].secret
        except SampleError:
            continue
        for experiment in {experiment.defense: experiment for experiment in plan.experiments}.values():
            with contextlib.suppress(SampleError):  # the run writes failed records for a plugin that raises
                runner.protect(experiment, features.take(np.arange(1)), "rehearsal")
        for attack in dict.fromkeys(experiment.attack for experiment in plan.experiments if experiment.reason is None):
            if attack is not None and PublicDatabase in attack.needs:
                asset = fields.name_public_database(attack)
                plan.public.dictionary(asset).check_suits(features.descriptors, f"{asset} (of {attack.name()})")
        return


def extract_sample(plan: Plan, sample: Sample) -> tuple[ExtractedImage, ...]:
    """Return the images of a sample with their features. They are read and extracted once.

    Raises
    ------
    SampleError
        if one cannot be read, or has no keypoint.
    """
    return _extract_sample(plan.extractor, sample, plan.hashes[sample.name])


@functools.lru_cache(maxsize=1)
def _extract_sample(extractor: Extractor, sample: Sample, content: str) -> tuple[ExtractedImage, ...]:
    """Return the images. `content`, the hash of the sample, is part of the cache key: a changed file is read again."""
    return tuple(_extract_image(extractor, image) for image in sample.images)


def _extract_image(extractor: Extractor, image: ImageSource) -> ExtractedImage:
    read: Callable[[], Bytes]
    if isinstance(image, Source):
        with wrap_plugin_errors("the reader of photographs"):
            pixels, notes = samples.read_pixels(image)
        with wrap_plugin_errors(f"plugin {extractor.name()}"):
            features, remarks = extractor.extract(pixels, image), extractor.list_notes(image)
        read = functools.partial(_same, pixels)
    else:
        with wrap_plugin_errors(f"plugin {extractor.name()}"):
            features, remarks = feature_cache.extract(extractor, image), extractor.list_notes(image.file())
        read, notes = image.read, ()
    if len(features) == 0:
        raise SampleError("no keypoint was found")
    foreground = functools.partial(samples.read_foreground, image)
    return ExtractedImage(pixels=read, secret=features, foreground=foreground, notes=(*notes, *remarks))


def build_record(
    experiment: Experiment,
    sample: Sample | None,
    *,
    status: str,
    reason: str | None = None,
    outcome: Outcome | None = None,
    keypoints: int | None = None,
    notes: Sequence[str] = (),
    seconds: float | None = None,
) -> Record:
    """Return the record of a sample, or of all samples for None. `keypoints` is the greatest number in one of its images."""
    estimates = {"estimates": dict(outcome.estimates)} if outcome is not None and outcome.estimates else {}
    return seal(
        experiment.metadata
        | estimates
        | {
            "sample": EVERY_SAMPLE if sample is None else sample.name,
            "condition": None if sample is None else sample.condition,
            "status": status,
            "reason": reason,
            "metrics": {} if outcome is None else {**outcome.metrics, "keypoints": keypoints},
            "privacy": build_privacy(experiment, keypoints),
            "seconds": seconds,
            "notes": [*notes, *(outcome.notes if outcome else ())],
        }
    )


def fail(record: Record, reason: str) -> Record:
    """Return the record of a sample that failed after its evaluation."""
    entries = {name: value for name, value in record.items() if name != "estimates"}
    privacy = record["privacy"] | dict.fromkeys(("keypoints", "epsilon_image", "epsilon_image_optimal"))
    return seal(entries | {"status": "failed", "reason": reason, "metrics": {}, "privacy": privacy, "seconds": None})


def build_privacy(experiment: Experiment, keypoints: int | None) -> dict[str, Any]:
    """Return the guarantee for the release of one image, and the parts that it does not cover."""
    epsilon, memoized = experiment.privacy.epsilon, experiment.defense.is_memoized()
    # A memoized defense repeats its answers, so all releases count as one.
    releases = 1 if memoized or experiment.attack is None else 1 + experiment.attack.repeats()
    image: dict[str, float | str | None] = {"epsilon_image": None, "epsilon_image_optimal": None}
    if epsilon is not None and keypoints is not None:
        answers = keypoints * releases
        image["epsilon_image"] = spec.encode_infinity(composition.compose_basic(epsilon, answers))
        image["epsilon_image_optimal"] = spec.encode_infinity(composition.compose_optimal(epsilon, answers))
    per_distance = experiment.privacy.per_distance
    return {
        "guarantee": experiment.privacy.guarantee,
        "epsilon_descriptor": spec.encode_infinity(epsilon),
        **({} if per_distance is None else {"epsilon_per_distance": float(per_distance)}),
        "keypoints": keypoints,
        "releases": releases,  # number of releases of the photograph
        **image,
        "delta": composition.DELTA,  # of the optimal composition
        "uncovered": [experiment.defense.positions.disclosed, composition.COUNT, *([composition.LINKS] if memoized else [])],
        "log10_true": experiment.privacy.log10_true,
        "seeded": True,
        "private": False,  # a seeded release is for measurements
    }


def _same(pixels: Bytes) -> Bytes:
    return pixels


def _encode_png(image: Bytes) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "png", compress_level=2)  # three times as fast as 6, and 15% larger
    return buffer.getvalue()
