"""Runs defenses against attacks on photographs: plans the cells, resumes, survives failures, and yields records.

Every attack sees the same release, and a resumed run gives what an uninterrupted one gives, whoever carries it out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.api import Attack, Dataset, Defense, Execute, Extractor, Metric, Plugin, Privacy, Task, execute_in_process
from bench.cache import feature_cache
from bench.codebook.public import Public
from bench.core import environment, hashing
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.images.samples import Images, Sample
from bench.localization.scene_index import Place
from bench.registry import discovery, fields, spec
from bench.runner import directory, engines, records, trial
from bench.runner.engines import Engine, Job
from bench.runner.records import EVERY_SAMPLE, Record
from bench.runner.trial import Result, Trials
from bench.tasks.reconstruction import Reconstruction
from bench.types import Knowledge

Describe = Callable[[Iterable[object]], Mapping[str, Any]]  # from plugins to the environment that they run in


@dataclass(frozen=True, eq=False)
class Experiment:
    """One defense against one attack."""

    defense: Defense
    attack: Attack | None
    privacy: Privacy
    metadata: Record  # what all its records begin with
    reason: str | None  # why it does not apply, if it does not


@dataclass(frozen=True, kw_only=True, eq=False)
class RunConfiguration:
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

    configuration: RunConfiguration
    task: Task
    experiments: tuple[Experiment, ...]
    samples: tuple[Sample, ...]
    hashes: Mapping[str, str]  # unit's name -> its content's hash
    extractor: Extractor
    metrics: tuple[Metric, ...]
    public: Public
    seed: int
    execute: Execute = execute_in_process  # where attacks are carried out

    @property
    def hash(self) -> str:
        """Of configuration and inputs."""
        return hashing.short_hash(sorted(cell.metadata["cell_id"] for cell in self.experiments))

    @property
    def needs_map(self) -> bool:
        """Whether some cell will ask for the place's map."""
        return self.task.needs_map or any(
            cell.attack is not None and Knowledge.MAP in cell.attack.needs for cell in self.experiments
        )

    def __len__(self) -> int:
        """The number of its records."""
        return sum(1 for _ in self.record_keys())

    def record_keys(self) -> Iterator[tuple[str, str]]:
        """What its records are known by, `run_hash` and unit, in order."""
        for place, unit in enumerate(self.samples):
            for cell in self.experiments:
                if cell.reason is None:
                    yield cell.metadata["run_hash"], unit.name
                elif place == 0:  # what holds for every unit comes with the first
                    yield cell.metadata["run_hash"], EVERY_SAMPLE


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
    return sort_records([plan], execute([plan], None if out is None else Path(out)))


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
    pairs = cross(task, defenses, attacks)
    return prepare_pairs(pairs, images, extractor=extractor, task=task, dataset=dataset, seed=seed, metrics=metrics)


def cross(task: Task, defenses: Sequence[Defense], attacks: Sequence[Attack] = ()) -> tuple[tuple[Defense, Attack | None], ...]:
    """Every defense with every attack, or with None where the task judges the release itself.

    Raises
    ------
    UserError
        if there is no defense, or the task needs attacks and has none or the other way round.
    """
    if not defenses:
        raise UserError("no defense was given")
    if task.judges_attacks and not attacks:
        raise UserError(f"{task.name()} needs an attack")
    if not task.judges_attacks and attacks:
        raise UserError(f"{task.name()} judges the release itself and takes no attack")
    tried: Sequence[Attack | None] = attacks or [None]
    return tuple((defense, attack) for defense in defenses for attack in tried)


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
    asked = RunConfiguration(
        pairs=tuple(pairs),
        images=images,
        task=task,
        extractor=extractor or Sift(),
        dataset=dataset,
        seed=seed,
        metrics=tuple(metrics),
    )
    return prepared(asked)


def prepared(asked: RunConfiguration, describe: Describe = environment.describe) -> Plan:
    """The plan, once a keypoint was protected by each of its defenses, so that a user's mistake shows before anything is written.

    Raises
    ------
    UserError
        as `prepare`.
    """
    plan = planned(asked, describe)
    if all(cell.reason for cell in plan.experiments):
        raise UserError("nothing to run: " + "; ".join(sorted({str(cell.reason) for cell in plan.experiments})))
    Trials(plan).rehearse()
    return plan


def planned(asked: RunConfiguration, describe: Describe = environment.describe) -> Plan:
    """The plan, before anything was tried. `describe` tells the environment in which it will be carried out.

    Raises
    ------
    UserError
        if something is wrong with what was asked.
    """
    task, extractor, dataset, seed = asked.task, asked.extractor, asked.dataset, asked.seed
    collection = task.collect(asked.images, dataset)
    hashes = {unit.name: unit.content_hash() for unit in collection.samples}
    place = None if collection.scene is None else Place(collection.scene, extractor)
    public = Public(feature_cache.nearest_words, place=place)
    judged = {
        "name": collection.name,
        "spec": None if dataset is None else spec.written(dataset),
        "hash": hashing.digest(hashes | dict(collection.beside)),
        "extractor": spec.configuration(extractor, public),
    }
    metrics = (*_metrics(), *asked.metrics) if task.judges_attacks else ()
    settings = {metric.name(): _settings(metric) for metric in metrics}
    taking_part = [plugin for pair in asked.pairs for plugin in pair if plugin is not None]
    ran = dict(describe([task, extractor, *taking_part, *metrics]))
    cells = []
    for defense, attack in asked.pairs:
        protected = spec.configuration(defense, public)
        reason = task.explain_not_applicable(defense, attack, extractor, public)
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
        cell_id = records.experiment_id(spec.written(task), head["defense"], head["attack"], judged, seed, settings)
        head |= {"cell_id": cell_id, "run_hash": records.run_hash(cell_id, ran), "environment": ran}
        cells.append(Experiment(defense, attack, defense.privacy(public), head, reason))
    unique = {cell.metadata["cell_id"]: cell for cell in cells}  # one that was asked for twice is done once
    return Plan(asked, task, tuple(unique.values()), collection.samples, hashes, extractor, metrics, public, seed)


def execute(plans: Sequence[Plan], out: Path | None = None, engine: Engine = engines.IN_PROCESS) -> Iterator[Record]:
    """Do what was planned and yield its records: first those that `out` holds already, then others as they are made.

    What several plans have in common is done once. A folder is written by one process at a time, and by this one alone, whatever
    the engine. `in_order` puts the records into the order of the plans.

    Parameters
    ----------
    out : the folder that is written, or resumed; None keeps nothing
    engine : who does it; by default this process, in the order of the plans

    Raises
    ------
    UserError
        before anything is written, if `out` cannot be written, holds a damaged record, or another process writes to it.
    OSError
        if the disk is full; every record yielded so far is kept.
    """
    if out is None:
        yield from (made.record for made in _made(plans, set(), engine))
        return
    with records.Log(out / records.FILE) as log:
        if log.before.notice:
            logging.getLogger(__name__).warning(log.before.notice)
        directory.write_plan(out, plans)
        done = {records.key(record): record for record in log.before.records if record["status"] != "failed"}
        held = [done[key] for key in dict.fromkeys(key for plan in plans for key in plan.record_keys()) if key in done]
        yield from held
        with directory.RunningJobs(out, engine.name) as hand:
            for made in _made(plans, set(map(records.key, held)), engine, hand.taken):
                directory.write_result(made, out)
                log.append(made.record)
                hand.done(made.record)
                yield made.record


def sort_records(plans: Sequence[Plan], found: Iterable[Record]) -> list[Record]:
    """Records in the order of the plans, which does not depend on who made them, or when."""
    places = {key: place for place, key in enumerate(dict.fromkeys(key for plan in plans for key in plan.record_keys()))}
    return sorted(found, key=lambda record: places[records.key(record)])


def _made(
    plans: Sequence[Plan],
    done: set[tuple[str, str]],
    engine: Engine,
    watched: Callable[[Iterator[Job]], Iterator[Job]] = lambda jobs: jobs,
) -> Iterator[Result]:
    """What is not done yet: first what does not apply and needs nobody to do it."""
    begun = set(done)
    for cell in (cell for plan in plans for cell in plan.experiments if cell.reason is not None):
        if (key := (cell.metadata["run_hash"], EVERY_SAMPLE)) not in begun:
            begun.add(key)
            yield Result(record=trial.record(cell, None, status="n/a", reason=cell.reason))
    jobs: dict[tuple[str, str], Job] = {}
    for job in (
        Job(plan, cell, unit) for plan in plans for unit in plan.samples for cell in plan.experiments if cell.reason is None
    ):
        if job.key not in done:
            jobs.setdefault(job.key, job)
    yield from engine(watched(iter(jobs.values())))


def _metrics() -> Iterator[Metric]:
    """All that need not be told anything."""
    for metric in discovery.everything(discovery.METRIC):
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
    return spec.configuration(attack, public, task.resolve(defense, attack, extractor, public))
