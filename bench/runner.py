"""Runs defenses against attacks on photographs: plans the cells, resumes, survives failures, and yields records.

The randomness of a release is a function of (seed, photograph's content, defense, extractor) alone, never of the attack, the
order, or what was done before. So every attack sees the same release, and a resumed run gives what an uninterrupted one gives.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import logging
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bench import composition, environment, fields, pool, records, registry, spec, units
from bench.datasets.photographs import Source
from bench.errors import PluginError, UnitError, UserError, blamed
from bench.features import kept
from bench.features.sift import Sift
from bench.place import Place
from bench.plugin import (
    Attack,
    CarryOut,
    Dataset,
    Defense,
    Extractor,
    Metric,
    Outcome,
    Plugin,
    Privacy,
    Shot,
    Task,
    Trial,
    at_once,
)
from bench.population import Population
from bench.public import Public
from bench.records import EVERY_UNIT, Record
from bench.tasks.reconstruction import Reconstruction
from bench.types import Bytes, Features, Floats, Release
from bench.units import Images, ImageSource, Unit

ERRORS = "errors.log"


@dataclass(frozen=True, eq=False)
class Cell:
    """One defense against one attack."""

    defense: Defense
    attack: Attack | None
    privacy: Privacy
    population: Population  # releases of the dataset's photographs by that defense
    head: Record  # what all its records begin with
    reason: str | None  # why it does not apply, if it does not


@dataclass(frozen=True, kw_only=True, eq=False)
class Asked:
    """What a plan is made from. Can be pickled, so that other processes make the same plan."""

    pairs: tuple[tuple[Defense, Attack | None], ...]
    images: Images
    task: Task
    extractor: Extractor
    dataset: Dataset | None
    seed: int
    metrics: tuple[Metric, ...] = ()  # beside those that need nothing


@dataclass(frozen=True, eq=False)
class Plan:
    """Everything that a run will do, checked as far as it can be without doing it."""

    asked: Asked
    task: Task
    cells: tuple[Cell, ...]
    units: tuple[Unit, ...]
    hashes: Mapping[str, str]  # unit's name -> its content's hash
    extractor: Extractor
    metrics: tuple[Metric, ...]
    public: Public
    seed: int
    carry_out: CarryOut = at_once  # where attacks are carried out

    @property
    def hash(self) -> str:
        """Of configuration and inputs."""
        return records.short_hash(sorted(cell.head["cell_id"] for cell in self.cells))

    def __len__(self) -> int:
        """The number of its records."""
        return sum(1 if cell.reason else len(self.units) for cell in self.cells)


def run(
    defenses: Sequence[Defense],
    attacks: Sequence[Attack] = (),
    images: Images = None,
    *,
    extractor: Extractor | None = None,
    task: Task | None = None,
    dataset: Dataset | None = None,
    seed: int = 0,
    metrics: Sequence[Metric] = (),
    out: Path | str | None = None,
) -> list[Record]:
    """Run every defense against every attack, and return one record for each unit, such as a photograph, of each pair.

    Parameters
    ----------
    defenses, attacks : plugins, such as `[LDP(epsilon=10)]` and `[DIA()]`
    images : a folder, files or sources, or None for the built-in photographs
    extractor : `Sift()` if None
    task : `Reconstruction()` if None
    dataset : the place that it is about, for a task that is about one
    seed : of everything random. A release whose seed is known is for measuring and protects nobody.
    metrics : those that must be told something, such as a file, beside all that need not be
    out : a folder to keep records and reconstructions in; what it holds already is not done again

    Raises
    ------
    UserError
        if something is wrong with what was asked; nothing has been written then.
    """
    plan = prepare(defenses, attacks, images, extractor=extractor, task=task, dataset=dataset, seed=seed, metrics=metrics)
    return list(execute(plan, None if out is None else Path(out)))


def prepare(
    defenses: Sequence[Defense],
    attacks: Sequence[Attack] = (),
    images: Images = None,
    *,
    extractor: Extractor | None = None,
    task: Task | None = None,
    dataset: Dataset | None = None,
    seed: int = 0,
    metrics: Sequence[Metric] = (),
) -> Plan:
    """Check what was asked, and lay out what is to be done. Parameters as those of `run`.

    Raises
    ------
    UserError
        if something is wrong with it, or no pair of it applies.
    """
    task = task or Reconstruction()
    if not defenses:
        raise UserError("no defense was given")
    if task.attacked and not attacks:
        raise UserError(f"{task.name()} needs an attack")
    if not task.attacked and attacks:
        raise UserError(f"{task.name()} judges the release itself and takes no attack")
    tried: Sequence[Attack | None] = attacks or [None]
    pairs = [(defense, attack) for defense in defenses for attack in tried]
    return prepare_pairs(pairs, images, extractor=extractor, task=task, dataset=dataset, seed=seed, metrics=metrics)


def prepare_pairs(
    pairs: Sequence[tuple[Defense, Attack | None]],
    images: Images = None,
    *,
    task: Task,
    extractor: Extractor | None = None,
    dataset: Dataset | None = None,
    seed: int = 0,
    metrics: Sequence[Metric] = (),
) -> Plan:
    """As `prepare`, for these pairs of a defense and an attack instead of all; None where the task judges the release itself.

    Raises
    ------
    UserError
        as `prepare`.
    """
    asked = Asked(
        pairs=tuple(pairs),
        images=images,
        task=task,
        extractor=extractor or Sift(),
        dataset=dataset,
        seed=seed,
        metrics=tuple(metrics),
    )
    plan = planned(asked)
    if all(cell.reason for cell in plan.cells):
        raise UserError("nothing to run: " + "; ".join(sorted({str(cell.reason) for cell in plan.cells})))
    _rehearse(plan)
    return plan


def planned(asked: Asked) -> Plan:
    """The plan, before anything was tried.

    Raises
    ------
    UserError
        if something is wrong with what was asked.
    """
    task, extractor, dataset, seed = asked.task, asked.extractor, asked.dataset, asked.seed
    collection = task.collection(asked.images, dataset)
    hashes = {unit.name: unit.content_hash() for unit in collection.units}
    public = Public(place=None if collection.scene is None else Place(collection.scene, extractor))
    judged = {
        "name": collection.name,
        "spec": None if dataset is None else spec.written(dataset),
        "hash": units.digest(hashes | dict(collection.beside)),
        "extractor": spec.configuration(extractor, public),
    }
    metrics = (*_metrics(), *asked.metrics) if task.attacked else ()
    settings = {metric.name(): _settings(metric) for metric in metrics}
    taking_part = [plugin for pair in asked.pairs for plugin in pair if plugin is not None]
    ran = environment.describe([task, extractor, *taking_part, *metrics])
    sources = [image for unit in collection.units for image in unit.images if isinstance(image, Source)]
    populations: dict[Defense, Population] = {}
    cells = []
    for defense, attack in asked.pairs:
        protected = spec.configuration(defense, public)
        if defense not in populations:
            drawn = functools.partial(randomness, "population", seed, protected, judged["extractor"])
            populations[defense] = Population(sources, extractor, defense, public, drawn)
        reason = task.inapplicable(defense, attack, extractor, public)
        head = {
            "schema": records.SCHEMA,
            "task": task.name(),
            "defense": protected,
            "attack": _attack_configuration(task, defense, attack, extractor, public, reason),
            "dataset": judged,
            "task_settings": _settings(task),
            "metric_settings": settings,
            "seed": seed,
            "sources": {"defense": environment.file_digest(defense), "attack": attack and environment.file_digest(attack)},
        }
        cell_id = records.cell_id(spec.written(task), head["defense"], head["attack"], judged, seed, settings)
        head |= {"cell_id": cell_id, "run_hash": records.run_hash(cell_id, ran), "environment": ran}
        cells.append(Cell(defense, attack, defense.privacy(public), populations[defense], head, reason))
    unique = {cell.head["cell_id"]: cell for cell in cells}  # one that was asked for twice is done once
    return Plan(asked, task, tuple(unique.values()), collection.units, hashes, extractor, metrics, public, seed)


def execute(plan: Plan, out: Path | None = None, workers: int = 1) -> Iterator[Record]:
    """Do what was planned and yield its records, those that `out` holds already included, always in the same order.

    Parameters
    ----------
    workers : processes that do it; of more than one each does whole units

    Raises
    ------
    UserError
        before anything is written, if `out` cannot be written or holds a damaged record.
    OSError
        if the disk is full; every record yielded so far is kept.
    """
    maker = _alone if workers <= 1 else functools.partial(pool.units, workers=workers)
    if out is None:
        yield from (record for record, _ in _executed(plan, {}, functools.partial(maker, plan, None)))
        return
    file = out / records.FILE
    before = records.read(file) if file.is_file() else records.Contents([], 0)
    if before.notice:
        logging.getLogger(__name__).warning(before.notice)
    done = {(record["run_hash"], record["unit"]): record for record in before.records if record["status"] != "failed"}
    with records.Log(file) as log:
        for record, fresh in _executed(plan, done, functools.partial(maker, plan, out)):
            if fresh:
                log.append(record)
            yield record


def picture(out: Path, record: Record) -> Path:
    """Where the reconstruction of a record is kept."""
    return out / "reconstructions" / record["cell_id"] / f"{record['unit']}.png"


def randomness(*parts: Any) -> np.random.Generator:
    """A generator that is a function of `parts` alone, which are JSON."""
    return np.random.default_rng(int(hashlib.sha256(records.canonical(parts).encode()).hexdigest(), 16))


def _metrics() -> Iterator[Metric]:
    """All that need not be told anything."""
    for metric in registry.everything(registry.METRIC):
        if not fields.without_default(metric):
            yield metric()


def _settings(plugin: Plugin) -> dict[str, Any]:
    settings = spec.written(plugin)
    del settings["name"]
    return settings | (dict(plugin.parameters) if isinstance(plugin, Metric) else {})


def _attack_configuration(
    task: Task, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public, reason: str | None
) -> dict[str, Any] | None:
    if attack is None:
        return None
    if reason is not None:
        return spec.written(attack)
    return spec.configuration(attack, public, task.resolved(defense, attack, extractor, public))


def _rehearse(plan: Plan) -> None:
    """Protect one keypoint of the first good image, so that a user's mistake shows before anything is written."""
    for unit in plan.units:
        try:
            features = _observed(plan, unit.images[0]).features
        except UnitError:
            continue
        one = features.take(np.arange(1))
        for cell in plan.cells:
            with contextlib.suppress(UnitError):  # a broken plugin makes failed records, later
                _protect(plan, cell, one, "rehearsal")
        return


Work = tuple[Unit, Sequence[Cell]]


def _executed(
    plan: Plan, done: Mapping[tuple[str, str], Record], make: Callable[[Sequence[Work]], Iterator[Iterable[Record]]]
) -> Iterator[tuple[Record, bool]]:
    """All records in order, and whether each was made just now. What holds for every unit comes with the first."""
    applicable = [cell for cell in plan.cells if cell.reason is None]
    left = [(unit, [cell for cell in applicable if (cell.head["run_hash"], unit.name) not in done]) for unit in plan.units]
    for place, ((unit, _), made) in enumerate(zip(left, make(left), strict=True)):
        fresh = iter(made)
        for cell in applicable if place else plan.cells:
            name = unit.name if cell.reason is None else EVERY_UNIT
            if (earlier := done.get((cell.head["run_hash"], name))) is not None:
                yield earlier, False
            elif cell.reason is not None:
                yield _record(cell, None, status="n/a", reason=cell.reason), True
            else:
                yield next(fresh), True


def _alone(plan: Plan, out: Path | None, work: Sequence[Work]) -> Iterator[Iterable[Record]]:
    """Do it here, each record when it is asked for."""
    return (unit_records(plan, unit, cells, out) for unit, cells in work)


@dataclass(frozen=True, eq=False)
class _Observed:
    """What the owner of an image has."""

    image: ImageSource
    features: Features
    pixels: Callable[[], Bytes]
    notes: tuple[str, ...]


def unit_records(plan: Plan, unit: Unit, cells: Sequence[Cell], out: Path | None) -> Iterator[Record]:
    """Read and extract one unit, protect it once by each defense, and let every attack at it."""
    if not cells:
        return
    try:
        observed = [_observed(plan, image) for image in unit.images]
    except (UnitError, UserError) as error:
        yield from _failed(cells, unit, error, out)
        return
    for _, group in itertools.groupby(cells, key=lambda cell: cell.head["defense"]):
        members = list(group)
        try:
            shots = tuple(_shot(plan, members[0], unit, number, seen) for number, seen in enumerate(observed))
        except (UnitError, UserError) as error:
            yield from _failed(members, unit, error, out)
            continue
        for cell in members:
            try:
                yield _judged(plan, cell, unit, shots, [note for seen in observed for note in seen.notes], out)
            except (UnitError, UserError) as error:
                yield from _failed([cell], unit, error, out)


def _observed(plan: Plan, image: ImageSource) -> _Observed:
    if isinstance(image, Source):
        with blamed("the reader of photographs"):
            pixels, notes = units.read(image)
        with blamed(f"plugin {plan.extractor.name()}"):
            features = plan.extractor.extract(pixels, image.path)
        seen = _Observed(image, features, lambda: pixels, notes)
    else:
        with blamed(f"plugin {plan.extractor.name()}"):
            features = kept.features(plan.extractor, image)
        seen = _Observed(image, features, image.read, ())
    if len(features) == 0:
        raise UnitError("no keypoint was found")
    return seen


def _shot(plan: Plan, cell: Cell, unit: Unit, number: int, seen: _Observed) -> Shot:
    """The release of one image of a unit: that of the first is a function of its content alone."""
    content = plan.hashes[unit.name] if len(unit.images) == 1 else seen.image.content_hash()
    release = _protect(plan, cell, seen.features, content)
    return Shot(
        pixels=seen.pixels, secret=seen.features, release=release, foreground=functools.partial(units.foreground, seen.image)
    )


def _protect(plan: Plan, cell: Cell, features: Features, content: str, *repetition: int) -> Release:
    made_with = cell.head["defense"], cell.head["dataset"]["extractor"]
    if cell.defense.remembers():  # all photographs, and all their repetitions, come from one device
        rng = randomness("device", plan.seed, *made_with)
    else:
        rng = randomness("release", plan.seed, content, *made_with, *repetition)
    with blamed(f"plugin {cell.defense.name()}"):
        release = cell.defense.protect(features, plan.public, rng)
        if not isinstance(release, cell.defense.releases):
            raise TypeError(f"protect returned {type(release).__name__}, expected {cell.defense.releases.__name__}")
    return release


def trial(plan: Plan, cell: Cell, unit: Unit) -> Trial:
    """A unit of a cell, extracted and protected as `execute` does it, before it is judged.

    Raises
    ------
    UnitError
        if it cannot be read, has no keypoint, or a plugin breaks.
    """
    shots = tuple(_shot(plan, cell, unit, number, _observed(plan, image)) for number, image in enumerate(unit.images))
    return _trial(plan, cell, unit, shots)


def _trial(plan: Plan, cell: Cell, unit: Unit, shots: tuple[Shot, ...]) -> Trial:
    head = cell.head
    content = plan.hashes[unit.name]
    first = shots[0].secret
    return Trial(
        unit=unit,
        shots=shots,
        defense=cell.defense,
        attack=cell.attack,
        extractor=plan.extractor,
        public=plan.public,
        metrics=plan.metrics,
        rng=randomness("attack", plan.seed, content, head["defense"], head["dataset"]["extractor"], head["attack"]),
        others=cell.population.without(unit.name),
        repeats=tuple(_protect(plan, cell, first, content, number) for number in _repetitions(cell.attack)),
        carry_out=plan.carry_out,
    )


def _judged(plan: Plan, cell: Cell, unit: Unit, shots: tuple[Shot, ...], notes: Sequence[str], out: Path | None) -> Record:
    tried = _trial(plan, cell, unit, shots)
    started = time.perf_counter()
    with blamed(f"task {plan.task.name()}"):
        outcome = plan.task.judge(tried)
    keypoints = max(len(shot.secret) for shot in shots)
    record = _record(cell, unit, status="ok", outcome=outcome, keypoints=keypoints, notes=notes)
    record["seconds"] = time.perf_counter() - started
    if out is not None and outcome.image is not None:
        _save_picture(picture(out, record), outcome.image)
    return record


def _repetitions(attack: Attack | None) -> range:
    """The numbers of the further releases that an attack sees. The first release has none."""
    return range(1, 1 + (0 if attack is None else attack.repeats()))


def _failed(cells: Sequence[Cell], unit: Unit, error: Exception, out: Path | None) -> Iterator[Record]:
    if isinstance(error, PluginError) and out is not None:
        with (out / ERRORS).open("a", encoding="utf-8") as log:
            log.write(f"{unit.name}\n{''.join(traceback.format_exception(error))}\n")
    for cell in cells:
        yield _record(cell, unit, status="failed", reason=str(error))


def _record(
    cell: Cell,
    unit: Unit | None,
    *,
    status: str,
    reason: str | None = None,
    outcome: Outcome | None = None,
    keypoints: int | None = None,
    notes: Sequence[str] = (),
) -> Record:
    """The record of a unit, or of all of them for None. `keypoints` are those of its image that has most."""
    return cell.head | {
        "unit": EVERY_UNIT if unit is None else unit.name,
        "condition": None if unit is None else unit.condition,
        "status": status,
        "reason": reason,
        "metrics": {} if outcome is None else {**outcome.metrics, "keypoints": keypoints},
        "privacy": privacy(cell, keypoints),
        "seconds": None,
        "notes": [*notes, *(outcome.notes if outcome else ())],
    }


def privacy(cell: Cell, keypoints: int | None) -> dict[str, Any]:
    """What the defense promises of what is released of one image, and what nothing covers."""
    epsilon, remembers = cell.privacy.epsilon, cell.defense.remembers()
    # A device that remembers answers once, however often it is asked.
    releases = 1 if remembers or cell.attack is None else 1 + cell.attack.repeats()
    spent: dict[str, float | str | None] = {"epsilon_image": None, "epsilon_image_optimal": None}
    if epsilon is not None and keypoints is not None:
        answers = keypoints * releases
        spent["epsilon_image"] = spec.finite(composition.basic(epsilon, answers))
        spent["epsilon_image_optimal"] = spec.finite(composition.optimal(epsilon, answers))
    return {
        "guarantee": cell.privacy.guarantee,
        "epsilon_descriptor": spec.finite(epsilon),
        "keypoints": keypoints,
        "releases": releases,  # of the photograph
        **spent,
        "delta": composition.DELTA,  # of the optimal one
        "uncovered": [*composition.UNCOVERED, *([composition.LINKS] if remembers else [])],
        "log10_true": cell.privacy.log10_true,
        "seeded": True,
        "private": False,  # a seeded release is for measuring
    }


def _save_picture(path: Path, image: Floats) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(image * 255.0).astype(np.uint8)).save(path)
