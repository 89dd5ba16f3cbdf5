"""What `bench list` prints: plugins with their fields, and which attack applies to which defense."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from rich.table import Table
from rich.text import Text

from bench.api import Plugin
from bench.codebook.public import Public
from bench.core.errors import UserError
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


def listing(what: str | None) -> Iterator[Table | Text]:
    """The section `what`, or all of them and the matrix of what applies to what.

    Raises
    ------
    UserError
        if a plugin is refused.
    """
    for section in [what] if what else SECTIONS:
        yield Text(f"\n{section}", style="bold")
        for plugin in discovery.everything(SECTIONS[section]):
            yield from _entry(plugin)
    if what in (None, "defenses", "attacks"):
        yield from _matrix()


def _entry(plugin: type[Plugin]) -> Iterator[Table | Text]:
    yield Text.assemble("  ", (plugin.name(), "bold"), f"  {plugin.description()}")
    if not dataclasses.fields(plugin):  # type: ignore[arg-type]
        return
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    types = fields.field_types(plugin)
    for field in dataclasses.fields(plugin):  # type: ignore[arg-type]
        default = "must be given" if field.default is dataclasses.MISSING else f"default {_written(field.default)}"
        table.add_row("     ", Text(field.name), Text(fields.expected(types[field.name]) or ""), Text(default))
    yield table


def _written(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)


def _matrix() -> Iterator[Table | Text]:
    """Which attack applies to which defense, with the defaults of all."""
    public = Public()
    task, extractor = spec.read("reconstruction", discovery.TASK), spec.read("sift", discovery.EXTRACTOR)
    table = Table(title="which attack applies to which defense (with their defaults)", title_justify="left")
    for column in ("defense", "attack", "applies", "reason"):
        table.add_column(column, overflow="fold")
    for defense in discovery.everything(discovery.DEFENSE):
        for attack in discovery.everything(discovery.ATTACK):
            try:
                reason = task.explain_not_applicable(spec.build(defense, {}), spec.build(attack, {}), extractor, public)
            except UserError as error:  # a field must be given, or a file is missing
                reason = str(error)
            table.add_row(Text(defense.name()), Text(attack.name()), "no" if reason else "yes", Text(reason or ""))
    yield table
