"""Builds the command that repeats an experiment, from its records."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from bench.api import Defense, Metric, Plugin
from bench.codebook.public import SHIPPED
from bench.core.errors import UserError
from bench.formats.pretrained import INSTALLED
from bench.registry import discovery, fields, spec
from bench.registry.discovery import Kind
from bench.task_api import Task
from leaderboard import provenance
from leaderboard.comparison import GroupedExperiment

BUILTIN = "builtin"  # the photographs that need no --images
Lookup = Callable[[Kind, str], type[Plugin] | None]
DEFAULT = {"--task": "reconstruction", "--extractor": "sift"}  # options that may be omitted


@dataclass(frozen=True)
class Recipe:
    """Shell commands, and descriptions of the files that they need."""

    command: str
    needs: tuple[str, ...]


def find_plugin(kind: Kind, name: str) -> type[Plugin] | None:
    """Return the plugin of that name, or None if it is not installed."""
    try:
        plugin: type[Plugin] = discovery.load_plugin(kind, name)
    except UserError:
        return None
    return plugin


def build_recipe(experiment: GroupedExperiment, lookup: Lookup = find_plugin) -> Recipe:
    """Return the `bench run` commands of an experiment, one per seed.

    The user's own files appear as FILE, and `needs` states their digests. The specification of a plugin that is not installed has
    all recorded fields. Many experiments can share a cached `lookup`.
    """
    metadata, write = experiment.metadata, functools.partial(_write_spec, lookup)
    needs: dict[str, None] = {}
    task = {"name": metadata["task"], **(metadata.get("task_settings") or {})}
    options = [
        ("--task", write(discovery.TASK, task, needs)),
        (
            "--defense",
            "+".join(
                write(discovery.DEFENSE, part, needs, _find_scene_field(lookup, metadata["task"], part))
                for part in metadata["defense"].get("parts", [metadata["defense"]])
            ),
        ),
    ]
    if metadata["attack"] is not None:
        options.append(("--attack", write(discovery.ATTACK, metadata["attack"], needs)))
    options.append(("--extractor", write(discovery.EXTRACTOR, metadata["dataset"]["extractor"], needs)))
    if metadata["dataset"].get("spec"):
        options.append(("--dataset", write(discovery.DATASET, metadata["dataset"]["spec"], needs)))
    elif metadata["dataset"]["name"] != BUILTIN:
        options.append(("--images", str(metadata["dataset"]["name"])))
        needs[f"{metadata['dataset']['name']}: a folder of the photographs with the content {metadata['dataset']['hash']}"] = None
    options += [("--metric", text) for text in _list_metrics(lookup, metadata["metric_settings"], needs)]
    seeds = sorted({located.record["seed"] for located in experiment.records})
    words = ["bench run", *(_format_option(option, text) for option, text in options if DEFAULT.get(option) != text)]
    return Recipe("\n".join(" ".join([*words, f"--seed {seed}"]) for seed in seeds), tuple(needs))


def _format_option(name: str, text: str) -> str:
    """Return an option, quoted for a shell."""
    return f"{name}{'=' if text.startswith('-') else ' '}{shlex.quote(text)}"


def _find_scene_field(lookup: Lookup, task_name: str, configuration: Mapping[str, Any]) -> str | None:
    """Return the field of the defense that a task with a scene fills with a dictionary of that scene."""
    task, defense = lookup(discovery.TASK, task_name), lookup(discovery.DEFENSE, configuration["name"])
    has_scene = task is not None and issubclass(task, Task) and task.needs_scene
    return defense.dictionary_field if has_scene and defense is not None and issubclass(defense, Defense) else None


def _list_metrics(lookup: Lookup, settings: Mapping[str, Mapping[str, Any]], needs: dict[str, None]) -> Iterator[str]:
    """Yield the metrics that are measured only on request."""
    for name, content in settings.items():
        plugin = lookup(discovery.METRIC, name)
        if plugin is not None and issubclass(plugin, Metric) and fields.is_optional(plugin):
            yield _write_spec(lookup, discovery.METRIC, {"name": name, **content}, needs)


def _write_spec(
    lookup: Lookup, kind: Kind, configuration: Mapping[str, Any], needs: dict[str, None], scene_field: str | None = None
) -> str:
    """Return a plugin's specification without fields at their defaults. `bench run` itself fills `scene_field`."""
    plugin = lookup(kind, configuration["name"])
    defaults = _list_defaults(plugin) if plugin else {}  # type: ignore[arg-type]  # a class is hashable
    given = []
    for field, value in configuration.items():
        if field == "name" or isinstance(value, dict) or (plugin and field not in fields.resolve_types(plugin)):
            continue  # settings of nested plugins are not fields
        text = _format_value(value)
        if field == scene_field and text == "FILE":
            needs[f"{field} of {configuration['name']} is made from the references of the scene, or was the file {value}"] = None
        elif field not in defaults or text != _format_value(defaults[field]):
            given.append(f"{field}={text}")
            if text == "FILE":
                needs[f"FILE for {field} of {configuration['name']}: {value}"] = None
    return configuration["name"] + (":" + ",".join(given) if given else "")


@functools.cache
def _list_defaults(plugin: type[Plugin]) -> dict[str, Any]:
    """Return the defaults of a plugin's fields. Those that are files of an installed package are digests, as in records."""
    defaults = fields.list_defaults(plugin)
    if INSTALLED not in defaults.values():
        return defaults
    try:
        return spec.to_json(plugin())
    except (TypeError, UserError):  # a field is required, or the package is not installed
        return defaults


def _format_value(value: Any) -> str:
    """Return the value of a field in a record as an option of a command takes it: the name of a shipped file, or FILE."""
    text = spec.format_value(value)
    return _index_shipped().get(text, "FILE") if text.startswith("sha256:") else text


@functools.cache
def _index_shipped() -> dict[str, str]:
    """Return a mapping from the digest of each installed file to the field value that selects it."""
    names = {file: name for name, file in SHIPPED.items()}
    return {digest: names.get(file, "shipped") for file, digest in provenance.read_digests().items()}
