"""Plans: the experiments and samples of a run, with the configuration and the hashes that their records hold."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.api import Attack, Dataset, Defense, Extractor, Metric, Plugin, Privacy
from bench.cache import dictionary_cache, feature_cache
from bench.codebook.public import Public
from bench.core import environment, hashing
from bench.core.errors import UserError
from bench.images.samples import Images, Sample
from bench.localization.scene_index import SceneIndex
from bench.registry import composed, discovery, fields, spec
from bench.runner import records
from bench.runner.records import EVERY_SAMPLE, Record
from bench.task_api import Execute, Task, execute_in_process
from bench.threat_model import ServerMap

VARIABLE = "FEATURE_PRIVACY_EXTRA_METRICS"  # environment variable
NO_EXTRAS = "none"  # its value for runs whose records are the same in all installations

Describe = Callable[[Iterable[object]], Mapping[str, Any]]  # plugins -> the environment that executes them


@dataclass(frozen=True, kw_only=True, eq=False)
class RunConfiguration:
    """Configuration of a run. It can be pickled, so that other processes can build the same plan."""

    pairs: tuple[tuple[Defense, Attack | None], ...]
    images: Images
    task: Task
    extractor: Extractor
    dataset: Dataset | None
    seed: int
    metrics: tuple[Metric, ...] = ()  # in addition to those that need no setting and no extra


@dataclass(frozen=True, eq=False)
class Experiment:
    """One defense × one attack × one dataset."""

    defense: Defense
    attack: Attack | None
    privacy: Privacy
    metadata: Record  # the entries that all its records have in common
    reason: str | None  # why it does not apply; None if it does


@dataclass(frozen=True, eq=False)
class Plan:
    """All experiments and samples of a run."""

    configuration: RunConfiguration
    task: Task
    experiments: tuple[Experiment, ...]
    samples: tuple[Sample, ...]
    hashes: Mapping[str, str]  # name of a sample -> hash of its content
    extractor: Extractor
    metrics: tuple[Metric, ...]
    public: Public
    seed: int
    execute: Execute = execute_in_process  # executes the attacks

    @property
    def hash(self) -> str:
        """Hash of configuration and inputs."""
        return hashing.short_hash(sorted(experiment.metadata["experiment_id"] for experiment in self.experiments))

    @property
    def needs_map(self) -> bool:
        """Whether an experiment uses the server's map."""
        attacks = (experiment.attack for experiment in self.experiments if experiment.attack is not None)
        return self.task.needs_map or any(ServerMap in attack.needs for attack in attacks)

    def __len__(self) -> int:
        """Return the number of records."""
        return sum(1 for _ in self.list_record_keys())

    def list_record_keys(self) -> Iterator[tuple[str, str]]:
        """Yield the keys of the records, `run_hash` and sample, in order."""
        for number, sample in enumerate(self.samples):
            for experiment in self.experiments:
                if experiment.reason is None:
                    yield experiment.metadata["run_hash"], sample.name
                elif number == 0:  # one record stands for all samples
                    yield experiment.metadata["run_hash"], EVERY_SAMPLE


def cross(task: Task, defenses: Sequence[Defense], attacks: Sequence[Attack] = ()) -> tuple[tuple[Defense, Attack | None], ...]:
    """Return every defense paired with every attack, or with None if the task evaluates the release itself.

    Raises
    ------
    UserError
        if there is no defense, no attack for a task that needs one, or an attack for a task that takes none.
    """
    if not defenses:
        raise UserError("no defense was given; give at least one")
    if task.judges_attacks and not attacks:
        raise UserError(f"the task {task.name()} needs an attack; give at least one")
    if not task.judges_attacks and attacks:
        raise UserError(f"the task {task.name()} evaluates the release itself and takes no attack")
    candidates: Sequence[Attack | None] = attacks or [None]
    return tuple((defense, attack) for defense in defenses for attack in candidates)


def build_plan(configuration: RunConfiguration, describe: Describe = environment.describe) -> Plan:
    """Return the plan of a run. `describe` returns the environment that will execute it.

    Raises
    ------
    UserError
        if the configuration is invalid.
    """
    task, extractor, dataset, seed = configuration.task, configuration.extractor, configuration.dataset, configuration.seed
    collection = task.collect(configuration.images, dataset)
    hashes = {sample.name: sample.content_hash() for sample in collection.samples}
    index = None if collection.scene is None else SceneIndex(collection.scene, extractor)
    public = Public(feature_cache.find_nearest_words, scene_index=index, clusterer=dictionary_cache.cluster_words)
    dataset_record = {
        "name": collection.name,
        "spec": None if dataset is None else spec.to_json(dataset),
        "hash": hashing.digest(hashes | dict(collection.extra_inputs)),
        "extractor": spec.to_json_with_digests(extractor, public),
    }
    metrics = (*_default_metrics(), *configuration.metrics) if task.judges_attacks else ()
    if collection.scene is None:
        metrics = tuple(metric for metric in metrics if metric.compares != "views")
    settings = {metric: _settings(metric) for metric in metrics}  # once, since digests of large files take time
    attacks = [attack for _, attack in configuration.pairs if attack is not None]
    plugins = [*attacks, *(part for defense, _ in configuration.pairs for part in composed.list_parts(defense))]
    environment_record = dict(describe([task, extractor, *plugins, *metrics]))
    experiments = []
    for defense, attack in configuration.pairs:
        defense_record = spec.to_json_with_digests(defense, public)
        metric_settings = {metric.name(): settings[metric] for metric in select_metrics(metrics, defense)}
        reason = _explain_hidden_positions(task, defense) or task.explain_not_applicable(defense, attack, extractor, public)
        attack_record = _attack_record(task, defense, attack, extractor, public, reason)
        experiment_id = records.experiment_id(
            spec.to_json(task), defense_record, attack_record, dataset_record, seed, metric_settings
        )
        metadata = {
            "schema": records.SCHEMA,
            "task": task.name(),
            "defense": defense_record,
            "attack": attack_record,
            "dataset": dataset_record,
            "task_settings": _settings(task),
            "metric_settings": metric_settings,
            "seed": seed,
            "sources": {
                "defense": _hash_defense(defense),
                "attack": attack and environment.hash_plugin_file(attack),
            },
            "experiment_id": experiment_id,
            "run_hash": records.run_hash(experiment_id, environment_record),
            "environment": environment_record,
        }
        experiments.append(Experiment(defense, attack, defense.privacy(public), metadata, reason))
    unique = {experiment.metadata["experiment_id"]: experiment for experiment in experiments}
    return Plan(configuration, task, tuple(unique.values()), collection.samples, hashes, extractor, metrics, public, seed)


def select_metrics(metrics: Iterable[Metric], defense: Defense) -> tuple[Metric, ...]:
    """Return the metrics of a defense, by the defense alone: an experiment is the same whatever else a run has."""
    return tuple(metric for metric in metrics if metric.compares != "positions" or defense.hides_positions())


def _explain_hidden_positions(task: Task, defense: Defense) -> str | None:
    """Return the reason if the task needs other positions than the defense releases; None if it accepts them."""
    if issubclass(defense.positions, task.accepts_positions):
        return None
    accepted = " or ".join(kind.__name__ for kind in task.accepts_positions)
    return f"{task.name()} needs {accepted}; {defense.name()} releases {defense.positions.__name__}"


def _hash_defense(defense: Defense) -> str | None:
    """Return the hash of a defense's file, or of those of its parts."""
    files = [environment.hash_plugin_file(part) for part in composed.list_parts(defense)]
    return files[0] if len(files) == 1 else hashing.digest(files)


def list_extra_metrics() -> tuple[Metric, ...]:
    """Return the metrics whose optional extra or program is installed; none if FEATURE_PRIVACY_EXTRA_METRICS is "none".

    A configuration names them. So a plan depends on its configuration, and not on what is installed.

    Raises
    ------
    UserError
        if the variable has another value, or an extra is damaged.
    """
    value = os.environ.get(VARIABLE)
    if value not in (None, "", NO_EXTRAS):
        raise UserError(f"{VARIABLE}={value}: must be {NO_EXTRAS}, or not set")
    if value == NO_EXTRAS:
        return ()
    metrics = discovery.load_plugins(discovery.METRIC)
    return tuple(metric() for metric in metrics if (metric.packages or metric.programs) and metric.is_installed())


def _default_metrics() -> Iterator[Metric]:
    """Yield all metrics that need no setting and no extra."""
    for metric in discovery.load_plugins(discovery.METRIC):
        if not fields.is_optional(metric):
            yield metric()


def _settings(plugin: Plugin) -> dict[str, Any]:
    settings = spec.to_json(plugin)
    del settings["name"]
    return settings | (dict(plugin.parameters) if isinstance(plugin, Metric) else {})


def _attack_record(
    task: Task, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public, reason: str | None
) -> dict[str, Any] | None:
    if attack is None:
        return None
    if reason is not None:
        return spec.to_json(attack)
    return spec.to_json_with_digests(attack, public, task.resolve(defense, attack, extractor, public))
