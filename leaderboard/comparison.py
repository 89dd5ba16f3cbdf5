"""Comparison groups of records: experiments whose numbers can be compared.

The experiments of a group share the schema, the task with its settings, the dataset, the extractor, the metric settings and the
source code. A dataset is identified by its content, so another split is another dataset. Each seed has its own group. The
experiments that have all seeds form one more group, where each sample counts with its mean over the seeds. Runs of one experiment
in several environments stay separate.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from bench.core.errors import UserError
from bench.core.hashing import canonical_json, short_hash
from bench.runner import records as files
from bench.runner.records import FILE, Record
from leaderboard.intervals import Interval
from leaderboard.measures import RANKING, Measure, expand_measures, summarize, summarize_bits
from leaderboard.signal import Signal, judge_experiments
from leaderboard.tables import FIRST_METRICS, build_labels, format_setting, label_extractor, name_samples

T = TypeVar("T")


@dataclass(frozen=True)
class LocatedRecord:
    """A record, and the folder of its file and its images."""

    record: Record
    folder: Path


@dataclass(frozen=True, kw_only=True, eq=False)
class GroupedExperiment:
    """One experiment with the records of all its samples and seeds. `attack` is "none needed" if the task takes no attack."""

    defense: str  # labels
    attack: str
    records: tuple[LocatedRecord, ...]

    @property
    def metadata(self) -> Record:
        """The first record, for the fields that are equal in all records."""
        return self.records[0].record

    @property
    def key(self) -> str:
        """An identifier of the experiment, unique over all groups."""
        return short_hash(sorted({located.record["run_hash"] for located in self.records}))

    @property
    def reason(self) -> str | None:
        """The reason why the experiment does not apply, or None."""
        return self.metadata["reason"] if self.metadata["status"] == "n/a" else None

    @functools.cached_property
    def completed(self) -> list[Record]:
        return [located.record for located in self.records if located.record["status"] == "ok"]

    @property
    def failed(self) -> list[Record]:
        return [located.record for located in self.records if located.record["status"] == "failed"]

    @functools.cached_property
    def by_sample(self) -> list[list[Record]]:
        """The completed records, one list per sample."""
        samples: dict[str, list[Record]] = {}
        for record in self.completed:
            samples.setdefault(record["sample"], []).append(record)
        return list(samples.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparisonGroup:
    """Experiments that can be compared."""

    experiments: tuple[GroupedExperiment, ...]
    seeds: tuple[int, ...]
    samples: tuple[str, ...]  # samples that at least one experiment has completed, in the order of the records
    conditions: tuple[str | None, ...]  # such as day and night; (None,) where samples have none
    measures: tuple[Measure, ...]  # measures with a value in at least one record

    @property
    def metadata(self) -> Record:
        return self.experiments[0].metadata

    @property
    def key(self) -> str:
        """An identifier of the group."""
        return short_hash([_comparison_key(self.metadata), self.seeds])

    @property
    def title(self) -> str:
        return f"{self.metadata['task'].capitalize()} on {self.metadata['dataset']['name']}"

    @property
    def settings(self) -> str:
        """The settings of the task."""
        given = {name: value for name, value in (self.metadata.get("task_settings") or {}).items() if value is not None}
        return ", ".join(f"{name} {format_setting(value)}" for name, value in given.items())

    @property
    def facts(self) -> list[str]:
        """The facts that hold for all numbers of the group."""
        seeds = ", ".join(map(str, self.seeds))
        return [
            f"{len(self.samples)} {name_samples(self.metadata['task'], len(self.samples))}",
            f"{label_extractor(self.metadata['dataset']['extractor'])} features",
            *([self.settings] if self.settings else []),
            f"seed {seeds}" if len(self.seeds) == 1 else f"mean over seeds {seeds}",
            f"source {_shorten_digest(self.metadata['environment']['source'])}",
            f"content {_shorten_digest(self.metadata['dataset']['hash'])}",
        ]

    @property
    def has_attacks(self) -> bool:
        """Whether the group judges attacks on releases, and not the releases themselves."""
        return any(experiment.metadata["attack"] is not None for experiment in self.experiments)

    @functools.cached_property
    def signals(self) -> dict[GroupedExperiment, Signal]:
        """The signal of each experiment that has one, over the samples that it has completed with every seed."""
        records = {
            experiment: [record for sample in self.complete_samples(experiment) for record in sample]
            for experiment in self.experiments
        }
        completed = {experiment: each for experiment, each in records.items() if each}
        signals = zip(completed, judge_experiments(list(completed.values())), strict=True)
        return {experiment: signal for experiment, signal in signals if signal is not None}

    def complete_samples(self, experiment: GroupedExperiment) -> list[list[Record]]:
        """Return the records of each sample that the experiment has completed with every seed."""
        return [records for records in experiment.by_sample if len(records) == len(self.seeds)]

    def list_values(self, experiment: GroupedExperiment, measure: Measure, condition: str | None = None) -> list[float | None]:
        """Return a measure of each complete sample, averaged over the seeds. A condition selects samples."""
        return [
            _mean([measure.convert(float(value)) for value in values])
            for values in self._list_values_by_seed(experiment, measure, condition)
        ]

    def _list_values_by_seed(self, experiment: GroupedExperiment, measure: Measure, condition: str | None) -> list[list[Any]]:
        """Return the values in records, one list per complete sample."""
        samples = self.complete_samples(experiment)
        selection = [records for records in samples if condition is None or records[0].get("condition") == condition]
        values = [[record["metrics"].get(measure.metric) for record in records] for records in selection]
        return [[value for value in each if value is not None] for each in values]

    def average(self, experiment: GroupedExperiment, measure: Measure, condition: str | None = None) -> Interval | None:
        """Return the measure's average over the samples; None if no sample has a value."""
        if measure.kind == "bits":
            ranks = self._list_values_by_seed(experiment, measure, condition)
            return summarize_bits([tuple(map(float, values)) for values in ranks if len(values) == len(self.seeds)])
        return summarize(measure, self.list_values(experiment, measure, condition))

    def count_missing(self, experiment: GroupedExperiment) -> int:
        """Return the number of the group's samples that the experiment has not completed; 0 if it does not apply."""
        return 0 if experiment.reason else len(self.samples) - len(self.complete_samples(experiment))


def load_records(*results: Path) -> list[LocatedRecord]:
    """Return the latest records of files, and of all files below folders.

    Raises
    ------
    UserError
        if one of `results` has no record, or if a file is damaged. The message names the file and the line.
    """
    latest: dict[tuple[str, str], LocatedRecord] = {}
    for result in results:
        contents = [(path.parent, files.read(path)) for path in _list_files(result)]
        if not any(content.records for _, content in contents):
            raise UserError(f"--results {result}: there is no record in it (looked for files called {FILE})")
        for folder, content in contents:
            if content.notice:
                logging.getLogger(__name__).warning(content.notice)
            latest |= {(record["run_hash"], record["sample"]): LocatedRecord(record, folder) for record in content.records}
    return list(latest.values())


def _list_files(result: Path) -> list[Path]:
    return sorted(result.rglob(FILE)) if result.is_dir() else [files.find_file(result)]


def build_groups(records: Sequence[LocatedRecord]) -> list[ComparisonGroup]:
    """Return all groups: those with attacks first, then by task and name of the dataset. Of equal ones the latest comes first."""
    groups = []
    for comparable in reversed(_group_by(records, lambda located: _comparison_key(located.record))):
        seeds = tuple(sorted({located.record["seed"] for located in comparable}))
        experiments = _group_experiments(comparable)
        if len(seeds) > 1:
            shared = [part for part in experiments if {located.record["seed"] for located in part} == set(seeds)]
            groups += [_build_group(shared, seeds)] if shared else []
        for seed in seeds:
            parts = ([located for located in part if located.record["seed"] == seed] for part in experiments)
            groups.append(_build_group([part for part in parts if part], (seed,)))
    return sorted(groups, key=lambda group: (not group.has_attacks, group.metadata["task"], group.metadata["dataset"]["name"]))


def _comparison_key(record: Record) -> list[Any]:
    dataset = [record["dataset"][key] for key in ("hash", "extractor")]
    task = [record["task"], record.get("task_settings")]  # older records lack them
    return [record["schema"], task, dataset, record["metric_settings"], record["environment"]["source"]]


def _group_experiments(records: Sequence[LocatedRecord]) -> list[list[LocatedRecord]]:
    """Group the records by defense, attack and environment."""
    return _group_by(records, lambda located: [located.record[name] for name in ("defense", "attack", "environment")])


def _build_group(parts: Sequence[Sequence[LocatedRecord]], seeds: tuple[int, ...]) -> ComparisonGroup:
    """Return the group of the experiments that have these records."""
    first = [part[0].record for part in parts]
    labels = build_labels([(record["defense"], record["attack"]) for record in first])
    experiments = tuple(
        GroupedExperiment(defense=defense, attack=attack + environment, records=tuple(part))
        for part, (defense, attack), environment in zip(parts, labels, _label_environments(first), strict=True)
    )
    completed = [record for experiment in experiments for record in experiment.completed]
    metrics = {name for record in completed for name, value in record["metrics"].items() if value is not None}
    conditions = {str(condition) for record in completed if (condition := record.get("condition")) is not None}
    measures = expand_measures(_order_metrics(metrics))
    return ComparisonGroup(
        experiments=experiments,
        seeds=seeds,
        samples=tuple(dict.fromkeys(record["sample"] for record in completed)),
        conditions=tuple(sorted(conditions)) or (None,),
        measures=tuple(sorted(measures, key=lambda measure: (_order_ranking(measure), measure.kind != "fraction"))),
    )


def _order_metrics(metrics: set[str]) -> list[str]:
    """Return the paper's metrics in its order, then the others by name."""
    return [*(name for name in FIRST_METRICS if name in metrics), *sorted(metrics - set(FIRST_METRICS))]


def _order_ranking(measure: Measure) -> int:
    """Return the position of a measure that ranks defenses; the others follow."""
    return RANKING.index(measure.metric) if measure.metric in RANKING else len(RANKING)


def _label_environments(first: Sequence[Record]) -> list[str]:
    """Return a suffix for the label of each experiment that was run in several environments; "" for the others."""
    pairs = [canonical_json([record["defense"], record["attack"]]) for record in first]
    environments = [record["environment"] for record in first]
    differing = sorted(name for name in environments[0] if len({canonical_json(one.get(name)) for one in environments}) > 1)
    return [
        f" ({', '.join(f'{name} {environment.get(name)}' for name in differing)})" if pairs.count(pair) > 1 else ""
        for environment, pair in zip(environments, pairs, strict=True)
    ]


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _group_by(items: Iterable[T], key: Callable[[T], Any]) -> list[list[T]]:
    groups: dict[str, list[T]] = {}
    for item in items:
        groups.setdefault(canonical_json(key(item)), []).append(item)
    return list(groups.values())


def _shorten_digest(digest: str) -> str:
    return digest.removeprefix("sha256:")[:8]
