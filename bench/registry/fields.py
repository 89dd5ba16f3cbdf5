"""The typed fields of plugins: allowed types, and their values as text."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from bench.api import Attack, Metric, Plugin
from bench.core.exact import Exact
from bench.registry.composed import Composed
from bench.settings import Asset

_get_hints = functools.cache(get_type_hints)  # one list of the plugins needs them hundreds of times


def resolve_types(plugin: type[Plugin]) -> dict[str, Any]:
    """Return field name -> type, in the order of the fields."""
    hints = _get_hints(plugin)  # type: ignore[arg-type]
    return {field.name: hints[field.name] for field in dataclasses.fields(plugin)}  # type: ignore[arg-type]


def list_assets(plugin: Plugin) -> dict[str, str]:
    """Return field name -> asset, of the fields of type Asset."""
    if isinstance(plugin, Composed):
        return {name: asset for part in plugin.parts for name, asset in list_assets(part).items()}
    return {name: getattr(plugin, name) for name, kind in resolve_types(type(plugin)).items() if kind is Asset}


def list_required(plugin: type[Plugin]) -> list[str]:
    """Return the names of the fields without a default."""
    fields = dataclasses.fields(plugin)  # type: ignore[arg-type]
    return [field.name for field in fields if field.default is dataclasses.MISSING]


def name_public_database(attack: Attack) -> str:
    """Return the public database that an attack searches: that of its field `database` if it has one."""
    return list_assets(attack).get("database", "shipped-public")


def is_optional(metric: type[Metric]) -> bool:
    """Return whether a metric needs a setting, an optional extra or a program. Then only the runs that name it compute it."""
    return bool(metric.packages or metric.programs or list_required(metric))


def list_defaults(plugin: type[Plugin]) -> dict[str, Any]:
    """Return field name -> default, of the fields with a default."""
    fields = dataclasses.fields(plugin)  # type: ignore[arg-type]
    return {field.name: field.default for field in fields if field.default is not dataclasses.MISSING}


def describe_type(kind: Any) -> str | None:
    """Describe the values of a field of this type; None if the type is not allowed."""
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(str, get_args(kind)))
    if get_origin(kind) in (Union, UnionType):
        inner = [describe_type(part) for part in get_args(kind) if part is not NoneType]
        return f"{inner[0]} or none" if len(inner) == 1 and inner[0] and NoneType in get_args(kind) else None
    return _DESCRIPTIONS.get(kind)


def parse_value(kind: Any, text: str) -> Any:
    """Parse the value of a field.

    Raises
    ------
    ValueError
        if the text is no value of the type (see `describe_type`).
    """
    if get_origin(kind) is Literal:
        return _parse_choice(get_args(kind), text)
    if get_origin(kind) in (Union, UnionType):
        (inner,) = (part for part in get_args(kind) if part is not NoneType)
        return None if text == "none" else parse_value(inner, text)
    return _PARSERS[kind](text)


def _parse_choice(choices: tuple[Any, ...], text: str) -> Any:
    for choice in choices:
        if text == str(choice):
            return choice
    raise ValueError(text)


def _parse_bool(text: str) -> bool:
    return bool(_parse_choice(("false", "true"), text.lower()) == "true")


def _nonempty(kind: Callable[[str], Any]) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        if not text:
            raise ValueError(text)
        return kind(text)

    return parse


_DESCRIPTIONS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number or a fraction (inf is one)",
    str: "text",
    Path: "a path",
    Asset: "'shipped' or the path of a file",
}
_PARSERS: dict[Any, Callable[[str], Any]] = {
    bool: _parse_bool,
    int: int,
    float: Exact,
    str: str,
    Path: _nonempty(Path),
    Asset: _nonempty(Asset),
}
