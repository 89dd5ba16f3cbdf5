"""The output of `bench list`: plugins with their fields, and the applicability of attacks to defenses."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from rich.text import Text

from bench.api import Plugin
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.table import Table, build_table
from bench.registry import discovery, fields, spec
from bench.registry.discovery import Kind

SECTIONS: dict[str, Kind] = {
    "defenses": discovery.DEFENSE,
    "attacks": discovery.ATTACK,
    "metrics": discovery.METRIC,
    "tasks": discovery.TASK,
    "datasets": discovery.DATASET,
    "extractors": discovery.EXTRACTOR,
}


def build_listing(section: str | None) -> Iterator[Table | Text]:
    """Yield one section, or all sections. With defenses or attacks, the table of applicability follows.

    Raises
    ------
    UserError
        if a plugin violates its contract.
    """
    for name in [section] if section else SECTIONS:
        yield Text(f"\n{name}", style="bold")
        for plugin in discovery.load_plugins(SECTIONS[name]):
            yield from _describe(plugin)
    if section in (None, "defenses", "attacks"):
        yield _build_matrix()


def _describe(plugin: type[Plugin]) -> Iterator[Text]:
    yield Text.assemble("  ", (plugin.name(), "bold"), f"  {plugin.description()}")
    types = fields.resolve_types(plugin)
    rows = []
    for field in dataclasses.fields(plugin):  # type: ignore[arg-type]
        default = "required" if field.default is dataclasses.MISSING else f"default {_format(field.default)}"
        rows.append((field.name, fields.describe_type(types[field.name]) or "", default))
    name, kind = (max((len(row[index]) for row in rows), default=0) for index in (0, 1))
    yield from (Text(f"       {row[0]:{name}}  {row[1]:{kind}}  {row[2]}") for row in rows)  # a table of rich is slow


def _format(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)


def _build_matrix() -> Table:
    """Return the table of the applicability of each attack to each defense, with default fields."""
    public = Public()
    task, extractor = spec.read("reconstruction", discovery.TASK), spec.read("sift", discovery.EXTRACTOR)
    defenses, attacks = discovery.load_plugins(discovery.DEFENSE), discovery.load_plugins(discovery.ATTACK)
    rows = []
    for defense in defenses:
        for attack in attacks:
            try:
                reason = task.explain_not_applicable(spec.build(defense, {}), spec.build(attack, {}), extractor, public)
            except UserError as error:  # a required field or a file is missing
                reason = str(error)
            rows.append((defense.name(), attack.name(), "no" if reason else "yes", reason or ""))
    columns = ("defense", "attack", "applies", "reason")
    return build_table(columns, rows, text=columns, heading="which attack applies to which defense (with default fields)")
