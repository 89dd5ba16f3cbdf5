"""Contract tests of plugins. Each function raises AssertionError if a plugin violates its contract.

```python
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.testing import check_defense

def test_contract(tmp_path):
    check_defense(Mine(dictionary=write_dictionary(tmp_path)), Public(), draw_features())
```
"""

from __future__ import annotations

import copy
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bench.api import Attack, Dataset, Defense, DescriptorAttack, Extractor, ImageAttack, Metric, PositionAttack, SelectiveAttack
from bench.cache import feature_cache, store
from bench.codebook import dictionary
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.formats import tensor_file
from bench.geometry.nearest_words import unit_rows
from bench.identification import distractors, thumbnails
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.samples import Sample
from bench.localization import maps
from bench.localization.scene_index import SceneIndex
from bench.task_api import Outcome, ProtectedImage, Task, Trial
from bench.tasks.reconstruction import Reconstruction, build_view
from bench.threat_model import TrueNeighbours, TrueWords
from bench.types import Bytes, Descriptors, Features, Floats, Indices, Lines, Permuted, Points, Release, Subspaces, WordSets

TOLERANCE = 1e-5  # of norms and angles in float32
LINE_TOLERANCE = 1e-3  # pixels, between a keypoint and its line


EMPTY_SAMPLE = Sample(name="made up", images=())


def build_image(secret: Features, release: Release) -> ProtectedImage:
    """Return features and their release as an image. Its pixels are black."""
    return ProtectedImage(pixels=lambda: np.zeros((*secret.size[::-1], 3), np.uint8), secret=secret, release=release)


def check_defense(defense: Defense, public: Public, secret: Features) -> None:
    """Check a defense.

    The release has the declared type and the keypoints of the secret. All randomness comes from `rng`. The release shares no
    memory with the secret, and the secret stays unchanged.
    """
    before = copy.deepcopy(secret)
    release = defense.protect(secret, public, np.random.default_rng(1))
    _require(type(release) is defense.releases, f"released {type(release).__name__}, declares {defense.releases.__name__}")
    _require(are_equal(secret, before), "changed the secret")
    _require(not _shared(release, secret), "the release shares memory with the secret")
    _require(type(release.positions) is defense.positions, f"released {type(release.positions).__name__} as positions")
    if isinstance(release.positions, Points):
        _require(np.array_equal(release.keypoints, secret.keypoints), "the released keypoints differ from the secret ones")
    if isinstance(release.positions, Lines):
        _check_lines(release.positions, secret.keypoints, "keypoint")
    if isinstance(release.positions, Permuted):
        _check_permuted(release.positions, secret.keypoints)
    _require(release.size == secret.size, "the released size of the photograph differs from that of the secret")
    _check_release(release, len(secret))
    _require(are_equal(release, defense.protect(secret, public, np.random.default_rng(1))), "the same rng gave another release")
    if not isinstance(release, Descriptors) or not isinstance(release.positions, Points):
        other = defense.protect(secret, public, np.random.default_rng(2))
        _require(not are_equal(release, other), "another rng gave the same release")
    privacy = defense.privacy(public)
    _require(privacy.guarantee, "the guarantee has no name")
    _require(privacy.epsilon is None or privacy.epsilon >= 0, "epsilon is negative")
    _require(privacy.log10_true is None or privacy.log10_true <= 0, "the probability of the true word is above 1")


def check_applicability(attack: Attack, defense: Defense, extractor: Extractor, public: Public) -> bool:
    """Return whether an attack applies, and check that the answer is the same at each call and a refusal has a reason."""
    task = Reconstruction()
    reason = task.explain_not_applicable(defense, attack, extractor, public)
    _require(reason is None or reason.strip(), "an attack that does not apply must return a reason")
    _require(reason == task.explain_not_applicable(defense, attack, extractor, public), "the second call gave another reason")
    return reason is None


def check_attack(
    attack: Attack,
    defense: Defense,
    extractor: Extractor,
    secret: Features,
    *,
    sample: Sample = EMPTY_SAMPLE,
    scene_index: SceneIndex | None = None,
) -> None:
    """Check an attack.

    The result has the type, shape and range that its class declares. The attack reads the release and its declared knowledge
    alone. So its result is bit-identical if the secret and all caches, also those on disk, are overwritten after the release. For
    an attack that needs the server's map, pass `scene_index` and a `sample` of its scene.
    """
    with tempfile.TemporaryDirectory() as folder, store.use_folder(Path(folder)):
        _check_attack(attack, defense, extractor, secret, sample, scene_index)


def _check_attack(
    attack: Attack, defense: Defense, extractor: Extractor, secret: Features, sample: Sample, scene_index: SceneIndex | None
) -> None:
    quantised: list[Indices] = []

    def quantise(words: dictionary.Dictionary, rows: Any) -> Indices:
        quantised.append(feature_cache.find_nearest_words(words, rows))
        return quantised[-1]

    public = Public(quantise, scene_index=scene_index)
    store.fetch(feature_cache.KIND, "the secret", lambda: (feature_cache.to_arrays(secret), {"size": list(secret.size)}))
    mine = copy.deepcopy(secret)
    length, signed = secret.descriptors.shape[1], secret.codes is None
    other_secrets = [draw_features(len(secret), seed, length, signed) for seed in range(5, 8)]

    def draw_others(count: int) -> Iterator[Release]:
        return (defense.protect(features, Public(), np.random.default_rng(4)) for features in other_secrets[:count])

    trial = Trial(
        sample=sample,
        images=(build_image(mine, defense.protect(mine, public, np.random.default_rng(1))),),
        defense=defense,
        attack=attack,
        extractor=extractor,
        public=public,
        metrics=(),
        rng=np.random.default_rng(3),
        others=draw_others,
        repeats=tuple(defense.protect(mine, public, np.random.default_rng([2, number])) for number in range(attack.repeats())),
    )
    estimates = _estimate(trial)
    for kind, estimate in estimates.items():
        if kind is DescriptorAttack:
            _require(estimate.shape == secret.descriptors.shape, "the result has another shape than the secret descriptors")
        elif kind is ImageAttack:
            _require(estimate.shape == (*secret.size[::-1], 3), "the result has another size than the photograph")
            _require(estimate.min() >= 0, "the result has values below 0")
            _require(estimate.max() <= 1, "the result has values above 1")
        elif kind is PositionAttack:
            _require(estimate.shape == secret.keypoints.shape, "the result has another shape than the keypoints of the secret")
            _require(np.isfinite(estimate).all(), "the result has values that are not finite")
        if kind in (DescriptorAttack, SelectiveAttack):
            np.testing.assert_allclose(np.linalg.norm(estimate, axis=1), 1, atol=TOLERANCE)
        _require(estimate.dtype == np.float32, "the result is not float32")
    if not attack.needs.isdisjoint((TrueWords, TrueNeighbours)):
        return  # an oracle reads a part of the secret, by declaration
    for array in (*_arrays(mine), *quantised):
        array[...] = 0
    for entry in store.list_entries():
        if entry.kind not in (maps.KIND, dictionary.KIND):  # these two hold public data alone
            overwrite_with_zeros(entry.path, entry.kind)
    public.clear()
    again = _estimate(trial)
    _require(all(np.array_equal(estimates[kind], again[kind]) for kind in estimates), "the attack saw more than the release")


def check_metric(metric: Metric, seed: int = 0) -> None:
    """Check a metric: its values are in its range, it changes no argument, and the truth scores better than noise."""
    rng = np.random.default_rng(seed)
    if metric.compares == "descriptors":
        truth, estimate = draw_features(30, seed).descriptors, draw_features(30, seed + 1).descriptors
        best_estimate = truth.copy()
    elif metric.compares == "positions":
        truth, estimate = draw_features(30, seed).keypoints, draw_features(30, seed + 1).keypoints
        best_estimate = truth.copy()
    else:
        # A portrait with a caption, since `face` has no value for a picture without a face, and `reads` for one without text. The
        # estimate is noise alone, since a metric such as `identified` has its best value for a portrait under noise.
        truth = _add_caption(photographs.read(photographs.list_people()[0].path).pixels)
        estimate, best_estimate = rng.random(truth.shape, np.float32), truth.copy()
        if metric.compares == "views":
            others = distractors.load_distractors().thumbnails[: distractors.COUNT]
            truth = np.concatenate([thumbnails.compute_thumbnail(truth)[None], others])
    before = truth.copy(), estimate.copy()
    perfect, value = metric(truth, best_estimate), metric(truth, estimate)
    _require(np.array_equal(truth, before[0]), "changed the truth")
    _require(np.array_equal(estimate, before[1]), "changed the estimate")
    low, high = metric.range
    if not isinstance(value, float):
        raise AssertionError("the value is not a float")
    _require(low <= value <= high, "the value is outside the declared range")
    _require(perfect is None or low <= perfect <= high, "the value of the truth is outside the declared range")
    best = (high if metric.higher_is_better_for == "attacker" else low) if perfect is None else perfect
    _require(best > value if metric.higher_is_better_for == "attacker" else best < value, "the truth must be the best estimate")


def _add_caption(pixels: Bytes) -> Floats:
    """Return an image with two words on a white bar below. (H, W, 3) -> the same shape, float32 in [0, 1]"""
    picture = Image.fromarray(pixels)
    draw, top = ImageDraw.Draw(picture), picture.height - 48
    draw.rectangle((0, top, *picture.size), "white")
    draw.text((16, top + 8), "Station Road", "black", ImageFont.load_default(26))
    return (np.asarray(picture) / 255).astype(np.float32)


def check_extractor(extractor: Extractor, image: np.ndarray, source: Source | None = None) -> None:
    """Check an extractor: unit descriptors at keypoints within the image, ordered by position, the same at each call."""
    before = image.copy()
    features = extractor.extract(image, source)
    _require(np.array_equal(image, before), "changed the image")
    _require(are_equal(features, extractor.extract(image, source)), "the second call gave other features")
    height, width = image.shape[:2]
    _require(features.size == (width, height), "the features have another size than the image")
    _require(len(features) > 0, "there is no keypoint")
    _require(features.keypoints.shape == (len(features), 2), "keypoints must be (N, 2)")
    _require((features.keypoints >= 0).all(), "a keypoint has a negative coordinate")
    _require((features.keypoints <= features.size).all(), "a keypoint is outside the image")
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=TOLERANCE)
    _require(
        features.codes is None or arrays_equal(unit_rows(features.codes), features.descriptors),
        "the codes are not those of the descriptors",
    )
    _require(
        are_equal(features, features.by_position()), "the order of keypoints would reveal their strength: return by_position()"
    )


def overwrite_with_zeros(file: Path, kind: str) -> None:
    """Replace all numbers of a file of arrays by zeros, with a valid digest."""
    arrays, meta, _ = tensor_file.load(file, kind)
    tensor_file.save(file, kind, {name: np.zeros_like(array) for name, array in arrays.items()}, meta)


def check_task(task: Task, defense: Defense, extractor: Extractor, secret: Features) -> None:
    """Check a task that takes no attack: its metrics are finite and the same at each call, and it changes no argument."""
    _require(not task.judges_attacks, "check_task is for tasks that take no attack")
    public, before = Public(), copy.deepcopy(secret)
    release = defense.protect(secret, public, np.random.default_rng(1))
    released = copy.deepcopy(release)

    def others(count: int) -> Iterator[Release]:
        return (defense.protect(draw_features(9, seed), public, np.random.default_rng(3)) for seed in range(count))

    def judged() -> Outcome:
        trial = Trial(
            sample=EMPTY_SAMPLE,
            images=(build_image(secret, release),),
            defense=defense,
            attack=None,
            extractor=extractor,
            public=public,
            metrics=(),
            rng=np.random.default_rng(2),
            others=others,
            repeats=(),
        )
        return task.evaluate(trial)

    first = judged()
    _require(first.metrics, "the outcome has no metric")
    _require(
        all(value is None or (isinstance(value, float) and np.isfinite(value)) for value in first.metrics.values()),
        "a metric is neither None nor a finite float",
    )
    _require(first.metrics == judged().metrics, "the same rng gave another outcome")
    _require(are_equal(secret, before), "changed the secret")
    _require(are_equal(release, released), "changed the release")


def check_dataset(dataset: Dataset) -> None:
    """Check a dataset.

    Images have distinct names and contents, the size of their camera, and finite poses. They are the same at each call.
    """
    scene, again = dataset.scene(), dataset.scene()
    images = (*scene.references, *scene.queries)
    _require(images, "the scene is empty")
    _require(len({image.name for image in images}) == len(images), "two images have the same name")
    for image, other in zip(images, (*again.references, *again.queries), strict=True):
        pixels = image.pixels.read()
        _require(pixels.dtype == np.uint8, f"{image.name}: its pixels are not uint8")
        _require(
            pixels.shape == (image.camera.height, image.camera.width, 3), f"{image.name}: its size is not that of its camera"
        )
        _require(image.pixels.content_hash() == other.pixels.content_hash(), f"{image.name}: the second call gave another image")
        _require(np.array_equal(pixels, other.pixels.read()), f"{image.name}: the second call gave another image")
        _require(
            image.cam_from_world is None or np.isfinite(image.cam_from_world.matrix()).all(),
            f"{image.name}: its pose is not finite",
        )
        mask = image.pixels.foreground()
        _require(mask is None or mask.shape == pixels.shape[:2], f"{image.name}: its foreground mask has another size")
    _require(len({image.pixels.content_hash() for image in images}) == len(images), "two images have the same content hash")


def _require(holds: object, message: str) -> None:
    """Raise AssertionError with the message unless the condition holds. An `assert` would do nothing under `python -O`."""
    if not holds:
        raise AssertionError(message)


def are_equal(one: Any, other: Any) -> bool:
    """Return whether two dataclasses of arrays are equal bit for bit."""
    if isinstance(one, np.ndarray):
        return arrays_equal(one, other)
    if dataclasses.is_dataclass(one):
        return all(are_equal(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one))
    return bool(one == other)


def arrays_equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two arrays have the same type and equal values."""
    return one.dtype == other.dtype and np.array_equal(one, other)


def _estimate(trial: Trial) -> dict[type[Attack], Floats]:
    """Return the results of the attack by its classes: an attack may locate keypoints and reconstruct the image."""
    attack = trial.attack
    estimates: dict[type[Attack], Floats] = {}
    if isinstance(attack, DescriptorAttack):
        estimates[DescriptorAttack] = attack.recover(build_view(trial), np.random.default_rng(3))
    if isinstance(attack, SelectiveAttack):
        estimates[SelectiveAttack] = attack.select(build_view(trial), np.random.default_rng(3)).descriptors
    if isinstance(attack, ImageAttack):
        estimates[ImageAttack] = attack.reconstruct(build_view(trial), np.random.default_rng(3))
    if isinstance(attack, PositionAttack):
        estimates[PositionAttack] = attack.locate(build_view(trial), np.random.default_rng(3))
    _require(estimates, "the attack recovers neither descriptors nor images nor positions")
    return estimates


def _arrays(value: Any) -> list[np.ndarray]:
    """Return the arrays of a dataclass, and of those in it."""
    parts = [getattr(value, field.name) for field in dataclasses.fields(value)]
    inner = [array for part in parts if dataclasses.is_dataclass(part) for array in _arrays(part)]
    return [part for part in parts if isinstance(part, np.ndarray)] + inner


def _shared(release: Release, secret: Features) -> bool:
    return any(np.shares_memory(mine, theirs) for mine in _arrays(release) for theirs in _arrays(secret))


def _check_lines(positions: Lines, points: Floats, kind: str) -> None:
    lines = positions.lines.astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1, atol=TOLERANCE)
    misses = np.abs((lines[:, :2] * points).sum(axis=1) + lines[:, 2]).max()
    _require(misses <= LINE_TOLERANCE, f"a line misses its {kind} by {misses:.3g} pixels")


def _check_permuted(positions: Permuted, keypoints: Floats) -> None:
    points = positions.points
    _require(not (points == keypoints).all(axis=1).any(), "a permuted point is its keypoint: it exchanged no coordinate")
    _require(arrays_equal(np.sort(points, axis=0), np.sort(keypoints, axis=0)), "a permuted coordinate is that of no keypoint")
    _check_lines(positions, points, "permuted point")


def _check_release(release: Release, count: int) -> None:
    for array in _arrays(release):
        _require(len(array) == count, "an array has another length than the number of keypoints")
        _require(np.isfinite(array).all(), "an array has values that are not finite")
        _require(array.dtype in (np.float32, np.int64), "an array is neither float32 nor int64")
    if isinstance(release, Descriptors):
        np.testing.assert_allclose(np.linalg.norm(release.descriptors, axis=1), 1, atol=TOLERANCE)
    if isinstance(release, Subspaces):
        gram = np.einsum("nid,njd->nij", release.bases, release.bases)  # (N, dim, dim)
        np.testing.assert_allclose(gram, np.broadcast_to(np.eye(release.dim), gram.shape), atol=TOLERANCE)
    if isinstance(release, WordSets):
        np.testing.assert_allclose(np.linalg.norm(release.candidates, axis=2), 1, atol=TOLERANCE)
        _require(release.words is None or (np.diff(release.words, axis=1) > 0).all(), "words must ascend, each once")
