"""Checks submitted records: schema, hashes, consistency with a new plan, and reproducibility of a sample of them.

The sample is computed again. Attacks then run in a process that never holds the secret (`bench.runner.attack_process`). So an
attack that read the secret cannot repeat its numbers.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bench.api import Defense, Metric, Plugin
from bench.codebook.clustered import name_digest
from bench.codebook.public import ASSETS, CLUSTERED, REFERENCES, SHIPPED
from bench.core import strict_json
from bench.core.errors import SampleError, UserError
from bench.core.progress import Progress
from bench.formats import tensor_file
from bench.images.photographs import list_photographs
from bench.images.samples import Images
from bench.registry import discovery, fields, spec
from bench.registry.composed import compose
from bench.registry.discovery import Kind
from bench.runner import consistency, records
from bench.runner.attack_process import execute_in_attack_process
from bench.runner.consistency import shorten
from bench.runner.plan import Experiment, Plan, RunConfiguration, build_plan
from bench.runner.records import EVERY_SAMPLE, Record
from bench.runner.trial import TrialRunner
from bench.settings import Asset
from bench.task_api import Task
from leaderboard.regression import ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE

P = TypeVar("P", bound=Plugin)

SCHEMAS = {1: ASSETS / "record.schema.json", records.SCHEMA: ASSETS / "record-2.schema.json"}
BUILTIN = "builtin"  # the photographs of every installation


@dataclass(frozen=True, order=True)
class Fault:
    """An error in a line, counted from 1."""

    line: int
    message: str


@dataclass(frozen=True, eq=False)
class NumberedRecord:
    """A record that follows the schema, and the number of its line."""

    number: int
    record: Record


def check(
    path: Path, *, images: Path | None = None, files: Sequence[Path] = (), sample: int = 3, seed: int = 0
) -> tuple[int, list[Fault]]:
    """Return the number of lines of a file of records, and the faults in them.

    Parameters
    ----------
    images : the photographs, if they are not the built-in ones
    files : dictionaries and networks that the records name by digest
    sample : number of records to compute again
    seed : selects these records

    Raises
    ------
    UserError
        if the file, `images` or one of `files` does not exist.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    texts = path.read_bytes().split(b"\n")
    texts = texts[:-1] if not texts[-1] else texts
    parsed = list(_parse_lines(texts))
    lines = [one for one in parsed if isinstance(one, NumberedRecord)]
    faults = [one for one in parsed if isinstance(one, Fault)]
    faults += [Fault(line.number, message) for line in lines for message in _check_consistency(line.record)]
    faults += _find_duplicates(lines)
    planned = list(_rebuild_plans(lines, _LocalInputs(images, files)))
    faults += [one for one in planned if isinstance(one, Fault)]
    completed = []
    for experiment, members, plan in (one for one in planned if not isinstance(one, Fault)):
        faults += _check_experiment(experiment, members, plan)
        completed += [(plan, experiment, line) for line in members if line.record["status"] == "ok"]
    faults += _repeat_sample(completed, sample, seed)
    if not texts:
        faults.append(Fault(1, "there is no record"))
    return len(texts), sorted(set(faults))


# ---- single lines


def _parse_lines(texts: Sequence[bytes]) -> Iterator[NumberedRecord | Fault]:
    from jsonschema import Draft202012Validator

    validators = {
        version: Draft202012Validator(json.loads(path.read_text(encoding="utf-8"))) for version, path in SCHEMAS.items()
    }
    for number, text in enumerate(texts, start=1):
        try:
            record = strict_json.parse(text)
        except ValueError as error:
            yield Fault(number, shorten(error))
            continue
        version = record.get("schema") if isinstance(record, dict) else None
        validator = validators[version if version == 1 else records.SCHEMA]
        errors = sorted(validator.iter_errors(record), key=lambda error: error.json_path)
        for violation in errors:
            part = violation.json_path.removeprefix("$").lstrip(".") or "the record"
            yield Fault(number, f"{part}: {shorten(violation.message)}")
        if not errors:
            if (fault := records.explain_invalid(record)) is not None:
                yield Fault(number, fault)
            yield NumberedRecord(number, records.upgrade(record))


def _check_consistency(record: Record) -> Iterator[str]:
    """Yield a message for each hash that does not match its content, and for each metric outside its range."""
    task = {"name": record["task"], **record["task_settings"]}
    configured = (task, record["defense"], record["attack"], record["dataset"], record["seed"], record["metric_settings"])
    if (expected := records.experiment_id(*configured)) != record["experiment_id"]:
        yield f"experiment_id: is {record['experiment_id']}, but that of this configuration is {expected}"
    if (expected := records.run_hash(record["experiment_id"], record["environment"])) != record["run_hash"]:
        yield f"run_hash: is {record['run_hash']}, but that of this experiment and environment is {expected}"
    yield from consistency.list_impossible_values(record)


def _find_duplicates(lines: Sequence[NumberedRecord]) -> Iterator[Fault]:
    """Yield a fault for each sample of an experiment that occurs twice. A failed sample may occur again."""
    seen: dict[tuple[str, str], NumberedRecord] = {}
    for line in lines:
        key = line.record["experiment_id"], line.record["sample"]
        if key in seen and seen[key].record["status"] != "failed":
            yield Fault(line.number, f"repeats the sample and experiment of line {seen[key].number}")
        seen[key] = line


# ---- experiments, planned again from their configurations


class _LocalInputs:
    """The photographs and files of this machine."""

    def __init__(self, images: Path | None, files: Sequence[Path]) -> None:
        self.images = None if images is None else list_photographs(images)
        shipped = {
            Asset(name): tensor_file.read_header(ASSETS / file)[2] for name, file in SHIPPED.items() if (ASSETS / file).is_file()
        }
        clustered = {Asset(name): name_digest(shipped[Asset(source)]) for name, source in CLUSTERED.items() if source in shipped}
        try:
            own = {Asset(file): tensor_file.read_header(file)[2] for file in files}
        except UserError as error:
            raise UserError(f"--file {error}") from None
        self.assets = {digest: name for name, digest in (shipped | clustered | own).items()}  # digest -> value of a field

    def photographs(self, record: Record) -> Images:
        """Return the photographs of a record.

        Raises
        ------
        UserError
            if this machine lacks them.
        """
        if record["dataset"]["spec"] is not None or record["dataset"]["name"] == BUILTIN:
            return None
        if self.images is None:
            raise UserError(f"cannot be checked without the photographs of {record['dataset']['name']}; pass them by --images")
        return self.images

    def plugin(self, kind: Kind[P], configuration: Mapping[str, Any]) -> P:
        """Return the plugin of a configuration. Files that this machine lacks are replaced by the default ones.

        Raises
        ------
        UserError
            if the plugin is not installed or does not accept the value of a field.
        """
        plugin = discovery.load_plugin(kind, configuration["name"])
        types = fields.resolve_types(plugin)
        given = {}
        for name in types.keys() & configuration.keys():
            value = configuration[name]
            if types[name] in (Asset, Path) and str(value).startswith("sha256:"):
                if value in self.assets:
                    given[name] = types[name](self.assets[value])
            else:
                text = str(value).lower() if value is None or isinstance(value, bool) else str(value)
                try:
                    given[name] = fields.parse_value(types[name], text)
                except ValueError:
                    raise UserError(
                        f"{plugin.name()}: {name} must be {fields.describe_type(types[name])}, not {text!r}"
                    ) from None
        return spec.build(plugin, given)


Planned = tuple[Experiment, list[NumberedRecord], Plan]


def _rebuild_plans(lines: Sequence[NumberedRecord], inputs: _LocalInputs) -> Iterator[Planned | Fault]:
    """Yield each experiment with its lines and its plan, or why there is none."""
    groups: dict[str, list[NumberedRecord]] = {}
    for line in lines:
        groups.setdefault(line.record["experiment_id"], []).append(line)
    for members in groups.values():
        first = members[0]
        try:
            plan = build_plan(_build_configuration(first.record, inputs))
            yield plan.experiments[0], members, plan
        except (UserError, SampleError) as error:
            yield Fault(first.number, " ".join(str(error).split()))


def _build_defense(configuration: Record, inputs: _LocalInputs, *, has_scene: bool) -> Defense:
    defense: Defense = inputs.plugin(discovery.DEFENSE, configuration)
    field = defense.dictionary_field
    if has_scene and field is not None and configuration[field] not in inputs.assets:
        return dataclasses.replace(defense, **{field: Asset(REFERENCES)})  # type: ignore[type-var]
    return defense


def _build_configuration(record: Record, inputs: _LocalInputs) -> RunConfiguration:
    task: Task = inputs.plugin(discovery.TASK, {"name": record["task"], **record["task_settings"]})
    dataset = record["dataset"]["spec"]
    configurations = record["defense"].get("parts", [record["defense"]])
    parts = [_build_defense(configuration, inputs, has_scene=dataset is not None) for configuration in configurations]
    defense = parts[0] if len(parts) == 1 else compose(parts)
    return RunConfiguration(
        pairs=((defense, None if record["attack"] is None else inputs.plugin(discovery.ATTACK, record["attack"])),),
        images=inputs.photographs(record),
        task=task,
        extractor=inputs.plugin(discovery.EXTRACTOR, record["dataset"]["extractor"]),
        dataset=None if dataset is None else inputs.plugin(discovery.DATASET, dataset),
        seed=record["seed"],
        metrics=tuple(_build_metrics(record["metric_settings"], inputs)),
    )


def _build_metrics(settings: Mapping[str, Mapping[str, Any]], inputs: _LocalInputs) -> Iterator[Metric]:
    """Yield the metrics of a record that not every run computes: those that need a setting or an optional extra."""
    for name in settings.keys() & discovery.discover(discovery.METRIC).keys():
        if fields.is_optional(discovery.load_plugin(discovery.METRIC, name)):
            yield inputs.plugin(discovery.METRIC, {"name": name, **settings[name]})


def _check_experiment(experiment: Experiment, members: Sequence[NumberedRecord], plan: Plan) -> Iterator[Fault]:
    """Yield a fault for each contradiction: other inputs, a pair that does not apply, another guarantee, missing samples."""
    first = members[0]
    if experiment.metadata["experiment_id"] != first.record["experiment_id"]:
        yield Fault(
            first.number, f"not the experiment that this machine plans: {_find_difference(first.record, experiment.metadata)}"
        )
        return
    names = {sample.name for sample in plan.samples}
    for line in members:
        record = line.record
        if (experiment.reason is None) == (record["status"] == "n/a"):
            message = f"does not apply ({experiment.reason})" if experiment.reason else "applies, but the record says n/a"
            yield Fault(line.number, f"status: the pair {message}")
        if record["sample"] not in (names if experiment.reason is None else {EVERY_SAMPLE}):
            yield Fault(line.number, f"sample: the dataset has no {record['sample']!r}")
        for message in consistency.list_other_guarantees(record, experiment):
            yield Fault(line.number, message)
    missing = sorted(names - {line.record["sample"] for line in members}) if experiment.reason is None else []
    if missing:
        yield Fault(first.number, f"its experiment lacks {len(missing)} of {len(names)} samples, such as {missing[0]!r}")


def _find_difference(record: Record, local: Record) -> str:
    """Return the first part of the configuration that differs on this machine."""
    for part in ("defense", "attack", "dataset", "metric_settings", "task_settings"):
        theirs, ours = record[part] or {}, local[part] or {}
        for name in (*theirs, *ours):
            if theirs.get(name) != ours.get(name) and (part != "dataset" or name not in ("name", "spec")):
                values = f"{shorten(theirs.get(name))}, here {shorten(ours.get(name))}"
                return f"{part}.{name} is {values} (pass the file by --file if it is not the shipped one)"
    return "its configuration is the same"


# ---- a sample, computed again


def _repeat_sample(completed: Sequence[tuple[Plan, Experiment, NumberedRecord]], sample: int, seed: int) -> Iterator[Fault]:
    """Compute a sample of the records again, in a process without the secret, and yield a fault for each difference."""
    usable = [one for one in completed if one[1].metadata["experiment_id"] == one[2].record["experiment_id"]]
    selection = np.sort(np.random.default_rng(seed).permutation(len(usable))[:sample])
    with Progress("computed again", len(selection)) as progress:
        for plan, experiment, line in (usable[index] for index in selection):
            yield from _compare(line, _repeat(plan, experiment, line.record["sample"]))
            progress.advance(note=line.record["sample"])


def _repeat(plan: Plan, experiment: Experiment, name: str) -> Record | None:
    sample = next((sample for sample in plan.samples if sample.name == name), None)
    separate = dataclasses.replace(plan, execute=execute_in_attack_process)
    return None if sample is None or experiment.reason else TrialRunner(separate).execute(experiment, sample).record


def _compare(line: NumberedRecord, repeated: Record | None) -> Iterator[Fault]:
    if repeated is None:
        return  # reported already
    if repeated["status"] != "ok":
        yield Fault(line.number, f"computed again, it failed: {shorten(repeated['reason'])}")
        return
    submitted, metrics = line.record["metrics"], repeated["metrics"]
    for name in sorted({*submitted, *metrics}):
        theirs, ours = submitted.get(name), metrics.get(name)
        if theirs is None or ours is None:
            equal = theirs is ours
        else:
            equal = abs(theirs - ours) <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(ours)
        if not equal:
            values = f"is {_format_number(theirs)}, but {_format_number(ours)} when computed again"
            yield Fault(line.number, f"metrics.{name}: {values}")


def _format_number(value: float | None) -> str:
    return "missing" if value is None else f"{value:.6g}"


def format_faults(faults: Iterable[Fault]) -> Iterator[str]:
    """Yield a line for each fault."""
    return (f"line {fault.line}: {fault.message}" for fault in faults)
