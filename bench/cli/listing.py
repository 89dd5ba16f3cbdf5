"""The output of `bench list`: plugins with their fields, and the applicability of attacks to defenses."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from rich.table import Table as RichTable
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


def build_listing(section: str | None) -> Iterator[Table | RichTable | Text]:
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


def _describe(plugin: type[Plugin]) -> Iterator[RichTable | Text]:
    yield Text.assemble("  ", (plugin.name(), "bold"), f"  {plugin.description()}")
    if not dataclasses.fields(plugin):  # type: ignore[arg-type]
        return
    table = RichTable(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    types = fields.resolve_types(plugin)
    for field in dataclasses.fields(plugin):  # type: ignore[arg-type]
        default = "required" if field.default is dataclasses.MISSING else f"default {_format(field.default)}"
        table.add_row("     ", Text(field.name), Text(fields.describe_type(types[field.name]) or ""), Text(default))
    yield table


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
