"""The output of `bench list`: plugins with their fields, and the applicability of attacks to defenses."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

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


def build_listing(section: str | None) -> Iterator[Text]:
    """Yield one section, or all sections. With defenses or attacks, the applicability of attacks follows.

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
        yield from _list_applicability()


def _describe(plugin: type[Plugin]) -> Iterator[Text]:
    yield Text.assemble("  ", (plugin.name(), "bold"), f"  {plugin.description()}")
    types = fields.resolve_types(plugin)
    rows = []
    for field in dataclasses.fields(plugin):  # type: ignore[arg-type]
        default = "required" if field.default is dataclasses.MISSING else f"default {_format(field.default)}"
        rows.append((field.name, fields.describe_type(types[field.name]) or "", default))
    yield from _align(rows)


def _align(rows: Sequence[tuple[str, str, str]]) -> Iterator[Text]:
    """Yield rows of three columns. A table of rich is slow."""
    first, second = (max((len(row[index]) for row in rows), default=0) for index in (0, 1))
    yield from (Text(f"       {row[0]:{first}}  {row[1]:{second}}  {row[2]}".rstrip()) for row in rows)


def _format(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)


def _list_applicability() -> Iterator[Text]:
    """Yield for each defense the attacks, whether they apply with default fields, and the reason if not."""
    yield Text("\nwhich attack applies to which defense (with default fields)", style="bold")
    public = Public()
    task, extractor = spec.read("reconstruction", discovery.TASK), spec.read("sift", discovery.EXTRACTOR)
    attacks = discovery.load_plugins(discovery.ATTACK)
    for defense in discovery.load_plugins(discovery.DEFENSE):
        rows = []
        for attack in attacks:
            try:
                reason = task.explain_not_applicable(spec.build(defense, {}), spec.build(attack, {}), extractor, public)
            except UserError as error:  # a required field or a file is missing
                reason = str(error)
            rows.append((attack.name(), "no" if reason else "yes", reason or ""))
        yield Text.assemble("  ", (defense.name(), "bold"))
        yield from _align(rows)
