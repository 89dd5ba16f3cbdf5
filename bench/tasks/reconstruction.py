"""Reconstruction: accuracy of an attacker's image and descriptors, recovered from a release."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.api import Attack, Dataset, Defense, Extractor, ImageAttack, LocalMetric, Metric, PositionAttack, Selection, View
from bench.cache import attack_cache
from bench.codebook.public import Public
from bench.codebook.true_words import find_true_candidates, find_true_words
from bench.core.errors import SampleError, UserError, wrap_plugin_errors
from bench.images import samples
from bench.images.samples import Collection, Images
from bench.images.scene import Mask
from bench.registry import discovery, fields, spec
from bench.registry.composed import Composed
from bench.task_api import Outcome, Task, Trial
from bench.threat_model import (
    DefenseDatabase,
    Knowledge,
    OtherReleases,
    PublicAssets,
    PublicDatabase,
    RepeatedReleases,
    ServerMap,
    TrueNeighbours,
    TrueWords,
)
from bench.types import Descriptors, Floats, Indices, Points, Positions, WordSets

RELEASES = {OtherReleases, RepeatedReleases}  # available for every defense


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Task):
    """Comparison of the attacker's image with the photograph, and of the attacker's descriptors with the true ones.

    If an attack recovers descriptors, the `inverter` reconstructs the image from them with the network for raw descriptors.
    """

    judges_attacks = True
    accepts_positions = (Positions,)  # the attack decides

    inverter: str = "dia"  # an attack that reconstructs images

    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        if dataset is None:
            return samples.collect_photographs(images)
        if images is not None:
            raise UserError("reconstruction takes photographs or the queries of a dataset, not both")
        return samples.collect_queries(dataset)

    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        if attack is None:
            return "reconstruction needs an attack"
        served: set[type[Knowledge]] = {ServerMap} if public.scene_index is not None else set()
        if defense.dictionary_field is not None and issubclass(defense.releases, WordSets):
            served.add(TrueWords)
        if defense.hides_positions():
            served.add(TrueNeighbours)
        missing = attack.needs - offer_knowledge(attack, defense, public).keys() - RELEASES - served
        if missing:
            wanted = " and ".join(sorted(need.description for need in missing))
            return f"{attack.name()} needs {wanted}; there is none for {defense.name()}"
        return attack.explain_not_applicable(defense, extractor, public)

    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        if attack is None:
            return {}
        for kind, load in offer_knowledge(attack, defense, public).items():
            if kind in attack.needs:
                load()
        digests = dict(attack.assets(defense, extractor, public))
        if isinstance(attack, ImageAttack):
            return digests
        inverter, left, reason = self._load_inverter(attack, defense, extractor, public)
        if reason is not None:
            return digests | {"inversion": None}
        return digests | {"inversion": spec.to_json_with_digests(inverter, public, inverter.assets(left, extractor, public))}

    def evaluate(self, trial: Trial) -> Outcome:
        attack = trial.attack
        if attack is None:
            raise SampleError("reconstruction needs an attack")
        if isinstance(attack, PositionAttack):
            return self._evaluate_positions(attack, trial)
        if isinstance(attack, ImageAttack):
            return compute_metrics(trial, None, reconstruct_image(attack, build_view(trial), trial))
        recovered = attack_cache.recover_cached(attack, trial, build_view(trial))
        inverter, undefended, reason = self._load_inverter(attack, trial.defense, trial.extractor, trial.public)
        if reason is not None:
            outcome = compute_metrics(trial, recovered.selection, None, (*recovered.notes, f"no image: {reason}"))
            return dataclasses.replace(outcome, saved_seconds=recovered.saved_seconds)
        keypoints = trial.release.keypoints[recovered.selection.rows]
        release = Descriptors(
            positions=Points(keypoints=keypoints), size=trial.release.size, descriptors=recovered.selection.descriptors
        )
        view = build_view(dataclasses.replace(trial.with_release(release), attack=inverter, defense=undefended))
        outcome = compute_metrics(trial, recovered.selection, reconstruct_image(inverter, view, trial), recovered.notes)
        return dataclasses.replace(outcome, saved_seconds=recovered.saved_seconds)

    def _evaluate_positions(self, attack: PositionAttack, trial: Trial) -> Outcome:
        """Score the recovered positions and an image: the attack's own one if it reconstructs images, else the inverter's.

        The inverter reads the recovered positions and the released descriptors.
        """
        view = build_view(trial)
        with wrap_plugin_errors(f"plugin {attack.name()}"):
            located = trial.execute(attack.locate, view, trial.rng)
            attack_cache.check_array(located, (len(trial.release), 2))
        if isinstance(attack, ImageAttack):
            image = reconstruct_image(attack, build_view(trial), trial)
            return compute_metrics(trial, None, image, tuple(map(str, view.notes)), located)
        release = dataclasses.replace(trial.release, positions=Points(keypoints=located))
        inverter, left, reason = self._load_inverter(attack, trial.defense, trial.extractor, trial.public)
        if reason is not None:
            return compute_metrics(trial, None, None, (*map(str, view.notes), f"no image: {reason}"), located)
        shown = build_view(dataclasses.replace(trial.with_release(release), attack=inverter, defense=left))
        return compute_metrics(trial, None, reconstruct_image(inverter, shown, trial), tuple(map(str, view.notes)), located)

    def _load_inverter(
        self, attack: Attack, defense: Defense, extractor: Extractor, public: Public
    ) -> tuple[ImageAttack, Defense, str | None]:
        """Return the attack that inverts what an attack recovers, the defense that is left, and the reason if it does not apply.

        Recovered descriptors are raw. Recovered positions leave the descriptors of a composed defense protected.
        """
        inverter = spec.read(self.inverter, discovery.ATTACK)
        if not isinstance(inverter, ImageAttack):
            raise UserError(f"reconstruction: inverter must reconstruct images, and {inverter.name()} does not")
        left: Defense = discovery.load_plugin(discovery.DEFENSE, "none")()
        if isinstance(attack, PositionAttack) and isinstance(defense, Composed):
            left = defense.descriptors
        return inverter, left, inverter.explain_not_applicable(left, extractor, public)


def offer_knowledge(attack: Attack, defense: Defense, public: Public) -> dict[type[Knowledge], Callable[[], Knowledge]]:
    """Return a loader for each kind of knowledge, except releases of that defense and the server's map."""
    databases = fields.list_assets(defense)
    own = fields.name_public_database(attack)
    offers: dict[type[Knowledge], Callable[[], Knowledge]] = {
        PublicDatabase: lambda: PublicDatabase(words=public.dictionary(own).words),
        PublicAssets: lambda: PublicAssets(assets=public),
    }
    if "database" in databases:
        offers[DefenseDatabase] = lambda: DefenseDatabase(words=public.dictionary(databases["database"]).words)
    return offers


def build_view(trial: Trial) -> View:
    """Return the attack's input: copies of the releases, and the knowledge that the attack declares in `needs`."""
    attack = trial.attack
    assert attack is not None
    offers = offer_knowledge(attack, trial.defense, trial.public) | {
        OtherReleases: lambda: OtherReleases(draw=lambda count: map(copy.deepcopy, trial.others(count))),
        RepeatedReleases: lambda: RepeatedReleases(releases=copy.deepcopy(trial.repeats)),
        ServerMap: lambda: _build_server_map(trial),
        TrueWords: lambda: _find_true_words(trial),
        TrueNeighbours: lambda: TrueNeighbours(order=order_by_distance(trial.secret.keypoints)),
    }
    return View(
        release=copy.deepcopy(trial.release),  # an attack cannot change the input of the next attack
        defense=trial.defense,
        extractor=trial.extractor,
        knowledge={kind: load for kind, load in offers.items() if kind in attack.needs},
    )


def _build_server_map(trial: Trial) -> ServerMap:
    from bench.localization.server import Server  # it imports COLMAP

    return ServerMap(server=Server(public=trial.public, camera=trial.sample.subject.camera))


def _find_true_words(trial: Trial) -> TrueWords:
    true = find_true_words(trial.defense, trial.secret, trial.public)
    return TrueWords(candidates=find_true_candidates(trial.release, true))


def order_by_distance(keypoints: Floats) -> Indices:
    """Return the other keypoints of each keypoint, nearest first. (N, 2) -> (N, N − 1)"""
    distances = np.linalg.norm(keypoints[:, None] - keypoints[None], axis=2)
    np.fill_diagonal(distances, -1)
    return np.argsort(distances, axis=1, kind="stable")[:, 1:]


def reconstruct_image(attack: ImageAttack, view: View, trial: Trial) -> Floats:
    """Run the attack, check its image, and return it. -> (H, W, 3)"""
    with wrap_plugin_errors(f"plugin {attack.name()}"):
        image: Floats = trial.execute(attack.reconstruct, view, trial.rng)
        width, height = view.release.size
        attack_cache.check_array(image, (height, width, 3))
        if image.min() < 0 or image.max() > 1:
            raise ValueError(f"returned values from {image.min()} to {image.max()}, expected 0 to 1")
    return image


def compute_metrics(
    trial: Trial, selection: Selection | None, image: Floats | None, notes: tuple[str, ...] = (), located: Floats | None = None
) -> Outcome:
    """Compute all metrics; None if what they compare is missing. With a foreground, also those of both parts."""
    values: dict[str, float | None] = {}
    truth = (trial.pixels() / 255.0).astype(np.float32)
    for metric in trial.metrics:
        if metric.compares == "images":
            values[metric.name()] = None if image is None else _compute_metric(metric, truth, image)
        elif metric.compares == "views":
            views = None if image is None else list_views(trial)
            values[metric.name()] = None if image is None or views is None else _compute_metric(metric, views, image)
        elif metric.compares == "positions":
            values[metric.name()] = None if located is None else _compute_metric(metric, trial.secret.keypoints, located)
        else:
            values[metric.name()] = (
                None
                if selection is None or len(selection.rows) == 0
                else _compute_metric(metric, trial.secret.descriptors[selection.rows], selection.descriptors)
            )
    if image is not None and (mask := trial.images[0].foreground()) is not None:
        values |= compute_part_metrics(trial.metrics, truth, image, mask)
    described = () if image is None else describe_truth(trial.metrics, truth)
    return Outcome(metrics=values, image=image, notes=(*notes, *described))


def describe_truth(metrics: Sequence[Metric], truth: Floats) -> Iterator[str]:
    """Yield what the metrics of images find in the photograph."""
    for metric in metrics:
        if metric.compares == "images":
            with wrap_plugin_errors(f"plugin {metric.name()}"):
                note = metric.describe_truth(truth)
            if note is not None:
                yield f"{metric.name()}: {note}"


def list_views(trial: Trial) -> Floats | None:
    """Return another view of the sample's scene and 255 views of others, (256, 16, 16); None if the sample has no scene."""
    index = trial.public.scene_index
    if index is None:
        return None
    from bench import scene_views  # most runs render no scene

    return scene_views.list_candidates(trial.sample.subject, index.scene.references)


def compute_part_metrics(metrics: Sequence[Metric], truth: Floats, image: Floats, mask: Mask) -> dict[str, float | None]:
    """Return each per-pixel metric over the foreground and over the background; None for an empty part."""
    values: dict[str, float | None] = {}
    for metric in metrics:
        if isinstance(metric, LocalMetric):
            with wrap_plugin_errors(f"plugin {metric.name()}"):
                each = metric.local(truth, image)  # (H, W)
            for part, inside in (("foreground", mask), ("background", ~mask)):
                values[f"{metric.name()}_{part}"] = float(each[inside].mean()) if inside.any() else None
    return values


def _compute_metric(metric: Metric, truth: Floats, estimate: Floats) -> float | None:
    with wrap_plugin_errors(f"plugin {metric.name()}"):
        value = metric(truth, estimate)
        if value is not None and not np.isfinite(value):
            raise ValueError(f"returned {value}; a metric must return None if its value is not finite")
        return None if value is None else float(value)


PLUGIN = Reconstruction
