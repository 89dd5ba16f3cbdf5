"""The command that makes a cell again, from its records."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from bench.api import Defense, Plugin
from bench.codebook.public import ASSETS, SHIPPED
from bench.core.errors import UserError
from bench.registry import discovery, fields
from bench.registry.discovery import Kind
from bench.runner.records import Record
from bench.task_api import Task
from leaderboard.comparison import GroupedExperiment

BUILTIN = "builtin"  # the photographs that need no --images
Lookup = Callable[[Kind, str], type[Plugin] | None]
DEFAULT = {"--task": "reconstruction", "--extractor": "sift"}  # of the command line


@dataclass(frozen=True)
class Recipe:
    """A line for a shell, and what it takes beside this program."""

    command: str
    needs: tuple[str, ...]


def find_plugin(kind: Kind, name: str) -> type[Plugin] | None:
    """The plugin of that name, if it is here."""
    try:
        found: type[Plugin] = discovery.load_plugin(kind, name)
    except UserError:
        return None
    return found


def build_recipe(cell: GroupedExperiment, lookup: Lookup = find_plugin) -> Recipe:
    """`bench run` with all that the records say; files of the user's own stand there as FILE, and `needs` tells their digests.

    A plugin that is not installed here has all its recorded fields spelt out. Many cells share a cached `lookup`.
    """
    head, spec = cell.metadata, functools.partial(_write_spec, lookup)
    needs: dict[str, None] = {}
    task = {"name": head["task"], **(head.get("task_settings") or {})}
    options = [
        ("--task", spec(discovery.TASK, task, needs)),
        ("--defense", spec(discovery.DEFENSE, head["defense"], needs, _find_scene_field(lookup, head))),
    ]
    if head["attack"] is not None:
        options.append(("--attack", spec(discovery.ATTACK, head["attack"], needs)))
    options.append(("--extractor", spec(discovery.EXTRACTOR, head["dataset"]["extractor"], needs)))
    if head["dataset"].get("spec"):
        options.append(("--dataset", spec(discovery.DATASET, head["dataset"]["spec"], needs)))
    elif head["dataset"]["name"] != BUILTIN:
        options.append(("--images", str(head["dataset"]["name"])))
        needs[f"{head['dataset']['name']}: a folder of the photographs with the content {head['dataset']['hash']}"] = None
    options += [("--metric", text) for text in _list_metrics(lookup, head["metric_settings"], needs)]
    seeds = sorted({one.record["seed"] for one in cell.records})
    words = ["bench run", *(_format_option(option, text) for option, text in options if DEFAULT.get(option) != text)]
    return Recipe("\n".join(" ".join([*words, f"--seed {seed}"]) for seed in seeds), tuple(needs))


def _format_option(name: str, text: str) -> str:
    """An option for a shell, whatever its value is."""
    return f"{name}{'=' if text.startswith('-') else ' '}{shlex.quote(text)}"


def _find_scene_field(lookup: Lookup, head: Record) -> str | None:
    """The field of the defense that is filled in with a dictionary of the place, if the task is about one."""
    task, defense = lookup(discovery.TASK, head["task"]), lookup(discovery.DEFENSE, head["defense"]["name"])
    about_places = task is not None and issubclass(task, Task) and task.needs_scene
    return defense.dictionary_field if about_places and defense is not None and issubclass(defense, Defense) else None


def _list_metrics(lookup: Lookup, settings: Mapping[str, Mapping[str, Any]], needs: dict[str, None]) -> Iterator[str]:
    """Those that are measured only where they are asked for."""
    for name, content in settings.items():
        plugin = lookup(discovery.METRIC, name)
        if plugin and fields.list_required(plugin):
            yield _write_spec(lookup, discovery.METRIC, {"name": name, **content}, needs)


def _write_spec(lookup: Lookup, kind: Kind, configuration: Mapping[str, Any], needs: dict[str, None], made: str | None = None) -> str:
    """A plugin as the command line takes it, without the fields that are as by default; `made` is one that it fills in."""
    plugin = lookup(kind, configuration["name"])
    defaults = fields.list_defaults(plugin) if plugin else {}
    given = []
    for field, value in configuration.items():
        if field == "name" or isinstance(value, dict) or (plugin and field not in fields.resolve_types(plugin)):
            continue  # what other plugins do in its stead is no field
        text = _format_value(value)
        if field == made and text == "FILE":
            needs[f"{field} of {configuration['name']} is made from the references of the place, or was a file: {value}"] = None
        elif field not in defaults or text != _format_value(defaults[field]):
            given.append(f"{field}={text}")
            if text == "FILE":
                needs[f"FILE for {field} of {configuration['name']}: {value}"] = None
    return configuration["name"] + (":" + ",".join(given) if given else "")


def _format_value(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(value)).removesuffix(".0")
    if str(value).startswith("sha256:"):
        return _index_shipped().get(str(value), "FILE")
    return str(value)


@functools.cache
def _index_shipped() -> dict[str, str]:
    """Digest of each file that is part of this installation -> the name that a field gives it."""
    names = {file: name for name, file in SHIPPED.items()}
    return {digest: names.get(file, "shipped") for file, digest in _read_digests()}


def _read_digests() -> Iterator[tuple[str, str]]:
    """From the files' headers, without the rest of them."""
    from safetensors import safe_open

    for path in sorted(ASSETS.glob("*.safetensors")):
        with safe_open(path, framework="numpy") as opened:
            yield path.name, (opened.metadata() or {}).get("digest", "")
