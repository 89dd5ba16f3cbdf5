"""Somebody's records, checked: whether they are whole, say what they hash, are possible, and come out again.

A sample of them is made again here. Attacks then run in a process that never holds the secret (`bench.runner.attack_process`), so that one
which looked at what it must not see cannot repeat its numbers.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bench.api import Plugin
from bench.codebook.public import ASSETS, REFERENCES, SHIPPED
from bench.core.errors import SampleError, UserError
from bench.core.progress import Progress
from bench.images.photographs import list_photographs
from bench.images.samples import Images
from bench.registry import discovery, fields, spec
from bench.registry.discovery import Kind
from bench.runner import records
from bench.runner.attack_process import execute_in_attack_process
from bench.runner.plan import Experiment, Plan, RunConfiguration, build_plan
from bench.runner.records import EVERY_SAMPLE, Record
from bench.runner.trial import TrialRunner, build_privacy
from bench.settings import Asset
from bench.task_api import Task
from leaderboard.regression import ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE

P = TypeVar("P", bound=Plugin)

SCHEMAS = {1: ASSETS / "record.schema.json", records.SCHEMA: ASSETS / "record-2.schema.json"}
BUILTIN = "builtin"  # the photographs that everyone has
MAX_LENGTH = 160  # characters of a complaint about what is in a line
ROUNDING = 1e-9  # relative, between computers, of what follows from the configuration alone


@dataclass(frozen=True, order=True)
class Fault:
    """What is wrong with a line, counted from 1."""

    line: int
    message: str


@dataclass(frozen=True, eq=False)
class NumberedRecord:
    """A record that keeps the schema, and where it stands."""

    number: int
    record: Record


def check(
    path: Path, *, images: Path | None = None, files: Sequence[Path] = (), sample: int = 3, seed: int = 0
) -> tuple[int, list[Fault]]:
    """How many lines there are, and what is wrong with them.

    Parameters
    ----------
    images : the photographs that were used, if they are not the built-in ones
    files : dictionaries and networks that the records know by digest
    sample : records to make again
    seed : of the sample

    Raises
    ------
    UserError
        if there is no such file, or no such `images` or `files`.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    texts = path.read_bytes().split(b"\n")
    texts = texts[:-1] if not texts[-1] else texts
    here = _LocalInputs(images, files)
    read = list(_parse_lines(texts))
    format_faults = [one for one in read if isinstance(one, NumberedRecord)]
    found = [one for one in read if isinstance(one, Fault)]
    found += [Fault(line.number, what) for line in format_faults for what in _check_consistency(line.record)]
    found += _find_duplicates(format_faults)
    planned = [part for group in _rebuild_plans(format_faults, here) for part in group]
    found += [part for part in planned if isinstance(part, Fault)]
    cells = [part for part in planned if not isinstance(part, Fault)]
    for _, cell, members, plan in cells:
        found += _check_experiment(cell, members, plan)
    done = [(plan, cell, line) for _, cell, members, plan in cells for line in members if line.record["status"] == "ok"]
    found += _repeat_sample(done, sample, seed)
    if not texts:
        found.append(Fault(1, "there is no record"))
    return len(texts), sorted(set(found))


# ---- a line by itself


def _parse_lines(texts: Sequence[bytes]) -> Iterator[NumberedRecord | Fault]:
    from jsonschema import Draft202012Validator

    validators = {
        version: Draft202012Validator(json.loads(path.read_text(encoding="utf-8"))) for version, path in SCHEMAS.items()
    }
    for number, text in enumerate(texts, start=1):
        try:
            record = json.loads(text, parse_constant=_refuse)
        except ValueError as error:
            yield Fault(number, f"no JSON: {error}")
            continue
        version = record.get("schema") if isinstance(record, dict) else None
        validator = validators[version if version == 1 else records.SCHEMA]
        wrong = sorted(validator.iter_errors(record), key=lambda error: error.json_path)
        for fault in wrong:
            yield Fault(number, f"{fault.json_path.removeprefix('$').lstrip('.') or 'the record'}: {_shorten(fault.message)}")
        if not wrong and (unbounded := _find_non_finite(record)):
            yield Fault(number, f"{unbounded}: not finite")
        elif not wrong:
            if (fault := records.explain_invalid(record)) is not None:
                yield Fault(number, fault)
            yield NumberedRecord(number, records.upgrade(record))


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON")


def _find_non_finite(value: Any, path: str = "") -> str | None:
    """Where a number lies that JSON can write and no double can hold, such as 1e999."""
    if isinstance(value, dict):
        return next((found for name, inner in value.items() if (found := _find_non_finite(inner, f"{path}.{name}"))), None)
    return path.lstrip(".") if isinstance(value, float) and not math.isfinite(value) else None


def _check_consistency(record: Record) -> Iterator[str]:
    """Hashes that are not those of what they stand for, and metrics out of their range."""
    task = {"name": record["task"], **record["task_settings"]}
    configured = (task, record["defense"], record["attack"], record["dataset"], record["seed"], record["metric_settings"])
    if (right := records.experiment_id(*configured)) != record["experiment_id"]:
        yield f"experiment_id: is {record['experiment_id']}, but that of this configuration is {right}"
    if (right := records.run_hash(record["experiment_id"], record["environment"])) != record["run_hash"]:
        yield f"run_hash: is {record['run_hash']}, but that of this experiment and environment is {right}"
    known = {metric.name(): metric for metric in discovery.load_plugins(discovery.METRIC)}
    for name, value in record["metrics"].items():
        if name in known and value is not None and not known[name].range[0] <= value <= known[name].range[1]:
            low, high = known[name].range
            yield f"metrics.{name}: {value:g} is not from {low:g} to {high:g}"
    if record["status"] == "ok" and record["privacy"]["keypoints"] != record["metrics"]["keypoints"]:
        yield "privacy.keypoints: not the keypoints of metrics"


def _find_duplicates(format_faults: Sequence[NumberedRecord]) -> Iterator[Fault]:
    """A unit of a cell that stands there twice; one that had failed may have been done again."""
    seen: dict[tuple[str, str], NumberedRecord] = {}
    for line in format_faults:
        key = line.record["experiment_id"], line.record["sample"]
        if key in seen and seen[key].record["status"] != "failed":
            yield Fault(line.number, f"the same unit of the same cell as line {seen[key].number}")
        seen[key] = line


# ---- cells, planned again from their configurations


class _LocalInputs:
    """What there is on this machine to plan with."""

    def __init__(self, images: Path | None, files: Sequence[Path]) -> None:
        self.images = None if images is None else list_photographs(images)
        shipped = {_read_digest(ASSETS / file): Asset(name) for name, file in SHIPPED.items() if (ASSETS / file).is_file()}
        self.assets = shipped | {_read_digest(file): Asset(file) for file in files}  # what fields call the content of a digest

    def photographs(self, record: Record) -> Images:
        """The photographs of a record.

        Raises
        ------
        UserError
            if they are not here.
        """
        if record["dataset"]["spec"] is not None or record["dataset"]["name"] == BUILTIN:
            return None
        if self.images is None:
            raise UserError(f"cannot be checked without the photographs of {record['dataset']['name']}: give --images")
        return self.images

    def plugin(self, kind: Kind[P], configuration: Mapping[str, Any]) -> P:
        """The plugin of a configuration. Files that are not here are taken to be its default ones.

        Raises
        ------
        UserError
            if it is not installed, or refuses a field.
        """
        plugin = discovery.load_plugin(kind, configuration["name"])
        types = fields.resolve_types(plugin)
        given = {}
        for name in types.keys() & configuration.keys():
            value = configuration[name]
            if types[name] is Asset and str(value).startswith("sha256:"):
                if value in self.assets:
                    given[name] = self.assets[value]
            else:
                text = str(value).lower() if value is None or isinstance(value, bool) else str(value)
                try:
                    given[name] = fields.parse_value(types[name], text)
                except ValueError:
                    raise UserError(f"{plugin.name()}: {name} must be {fields.describe_type(types[name])}, not {text!r}") from None
        return spec.build(plugin, given)


Planned = tuple[int, Experiment, list[NumberedRecord], Plan]


def _rebuild_plans(format_faults: Sequence[NumberedRecord], here: _LocalInputs) -> Iterator[list[Planned | Fault]]:
    """Each cell with its lines, and the plan that it is of; or why there is none."""
    groups: dict[str, list[NumberedRecord]] = {}
    for line in format_faults:
        groups.setdefault(line.record["experiment_id"], []).append(line)
    for members in groups.values():
        first = members[0]
        try:
            plan = build_plan(_build_configuration(first.record, here))
            yield [(first.number, plan.experiments[0], members, plan)]
        except (UserError, SampleError) as error:
            yield [Fault(first.number, " ".join(str(error).split()))]


def _build_configuration(record: Record, here: _LocalInputs) -> RunConfiguration:
    task: Task = here.plugin(discovery.TASK, {"name": record["task"], **record["task_settings"]})
    dataset = record["dataset"]["spec"]
    defense = here.plugin(discovery.DEFENSE, record["defense"])
    quantised = defense.dictionary_field
    if dataset is not None and quantised is not None and record["defense"][quantised] not in here.assets:
        defense = dataclasses.replace(defense, **{quantised: Asset(REFERENCES)})  # type: ignore[type-var]
    return RunConfiguration(
        pairs=((defense, None if record["attack"] is None else here.plugin(discovery.ATTACK, record["attack"])),),
        images=here.photographs(record),
        task=task,
        extractor=here.plugin(discovery.EXTRACTOR, record["dataset"]["extractor"]),
        dataset=None if dataset is None else here.plugin(discovery.DATASET, dataset),
        seed=record["seed"],
    )


def _check_experiment(cell: Experiment, members: Sequence[NumberedRecord], plan: Plan) -> Iterator[Fault]:
    """What cannot be so in a cell: other inputs than those here, a pair that does not apply, other promises, units left out."""
    first = members[0]
    if cell.metadata["experiment_id"] != first.record["experiment_id"]:
        yield Fault(first.number, f"another cell than can be made here: {_find_difference(first.record, cell.metadata)}")
        return
    names = {unit.name for unit in plan.samples}
    for line in members:
        record = line.record
        if (cell.reason is None) == (record["status"] == "n/a"):
            told = f"does not apply ({cell.reason})" if cell.reason else "applies, but the record says n/a"
            yield Fault(line.number, f"status: the pair {told}")
        if record["sample"] not in (names if cell.reason is None else {EVERY_SAMPLE}):
            yield Fault(line.number, f"sample: the dataset has no {record['sample']!r}")
        right = build_privacy(cell, record["privacy"]["keypoints"])
        for name, value in right.items():
            told = record["privacy"].get(name)
            if not _is_close(told, value):
                yield Fault(line.number, f"privacy.{name}: is {_shorten(told)}, should be {_shorten(value)}")
    missing = sorted(names - {line.record["sample"] for line in members}) if cell.reason is None else []
    if missing:
        yield Fault(first.number, f"its cell lacks {len(missing)} of {len(names)} units, such as {missing[0]!r}")


def _find_difference(record: Record, here: Record) -> str:
    """The first part of the configuration that is another here."""
    for part in ("defense", "attack", "dataset", "metric_settings", "task_settings"):
        theirs, ours = record[part] or {}, here[part] or {}
        for name in (*theirs, *ours):
            if theirs.get(name) != ours.get(name) and (part != "dataset" or name not in ("name", "spec")):
                return f"{part}.{name} is {_shorten(theirs.get(name))}, here {_shorten(ours.get(name))} (give its file by --file?)"
    return "its configuration is the same"


# ---- a sample, made again


def _repeat_sample(done: Sequence[tuple[Plan, Experiment, NumberedRecord]], sample: int, seed: int) -> Iterator[Fault]:
    """What of the sample comes out differently where the attack's process does not hold the secret."""
    usable = [one for one in done if one[1].metadata["experiment_id"] == one[2].record["experiment_id"]]
    chosen = np.sort(np.random.default_rng(seed).permutation(len(usable))[:sample])
    with Progress("made again", len(chosen)) as progress:
        for plan, cell, line in (usable[place] for place in chosen):
            yield from _compare(line, _repeat(plan, cell, line.record["sample"]))
            progress.advance(note=line.record["sample"])


def _repeat(plan: Plan, cell: Experiment, name: str) -> Record | None:
    unit = next((unit for unit in plan.samples if unit.name == name), None)
    apart = dataclasses.replace(plan, execute=execute_in_attack_process)
    return None if unit is None or cell.reason else TrialRunner(apart).execute(cell, unit).record


def _compare(line: NumberedRecord, again: Record | None) -> Iterator[Fault]:
    if again is None:
        return  # that it cannot be is told already
    if again["status"] != "ok":
        yield Fault(line.number, f"made again, it failed: {_shorten(again['reason'])}")
        return
    told = line.record["metrics"]
    for name in sorted({*told, *again["metrics"]}):
        theirs, ours = told.get(name), again["metrics"].get(name)
        if theirs is None or ours is None:
            right = theirs is ours
        else:
            right = abs(theirs - ours) <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(ours)
        if not right:
            yield Fault(line.number, f"metrics.{name}: is {_format_number(theirs)}, and {_format_number(ours)} when it is made again")


def _is_close(one: Any, other: Any) -> bool:
    numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (one, other))
    return math.isclose(one, other, rel_tol=ROUNDING) if numbers else bool(one == other)


def _format_number(value: float | None) -> str:
    return "missing" if value is None else f"{value:.6g}"


def _shorten(value: Any) -> str:
    """Of one line, and not too long, whatever somebody wrote."""
    text = " ".join(str(value).split())
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= MAX_LENGTH else text[: MAX_LENGTH - 3] + "..."


def _read_digest(path: Path) -> str:
    """What records know a file by, from its header.

    Raises
    ------
    UserError
        if it is no safetensors file of this program's.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as opened:
            return str((opened.metadata() or {})["digest"])
    except (OSError, SafetensorError, KeyError) as error:
        raise UserError(f"--file {path}: no dictionary and no network of this program's ({error})") from None


def format_faults(faults: Iterable[Fault]) -> Iterator[str]:
    """One line each."""
    return (f"line {fault.line}: {fault.message}" for fault in faults)
