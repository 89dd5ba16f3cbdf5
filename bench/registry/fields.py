"""A plugin's typed fields: which types they may have, and how each is written as text."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from bench.api import Asset, Plugin
from bench.core.exact import Exact


def field_types(plugin: type[Plugin]) -> dict[str, Any]:
    """Field name -> its type, in the order of the fields."""
    hints = get_type_hints(plugin)
    return {field.name: hints[field.name] for field in dataclasses.fields(plugin)}  # type: ignore[arg-type]


def asset_fields(plugin: Plugin) -> dict[str, str]:
    """The fields that name an asset, with the names."""
    return {name: getattr(plugin, name) for name, kind in field_types(type(plugin)).items() if kind is Asset}


def without_default(plugin: type[Plugin]) -> list[str]:
    """The fields that must be given."""
    fields = dataclasses.fields(plugin)  # type: ignore[arg-type]
    return [field.name for field in fields if field.default is dataclasses.MISSING]


def defaults(plugin: type[Plugin]) -> dict[str, Any]:
    """Field name -> default, of the fields that have one."""
    fields = dataclasses.fields(plugin)  # type: ignore[arg-type]
    return {field.name: field.default for field in fields if field.default is not dataclasses.MISSING}


def expected(kind: Any) -> str | None:
    """What is to be written for a field of this type, in words; None if no field may have it."""
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(str, get_args(kind)))
    if get_origin(kind) in (Union, UnionType):
        inner = [expected(part) for part in get_args(kind) if part is not NoneType]
        return f"{inner[0]} or none" if len(inner) == 1 and inner[0] and NoneType in get_args(kind) else None
    return _EXPECTED.get(kind)


def convert(kind: Any, text: str) -> Any:
    """Read a field's value from text.

    Raises
    ------
    ValueError
        if the text is not what `expected(kind)` says.
    """
    if get_origin(kind) is Literal:
        return _choice(get_args(kind), text)
    if get_origin(kind) in (Union, UnionType):
        (inner,) = (part for part in get_args(kind) if part is not NoneType)
        return None if text == "none" else convert(inner, text)
    return _READ[kind](text)


def _choice(choices: tuple[Any, ...], text: str) -> Any:
    for choice in choices:
        if text == str(choice):
            return choice
    raise ValueError(text)


def _truth(text: str) -> bool:
    return bool(_choice(("false", "true"), text.lower()) == "true")


def _named(kind: Callable[[str], Any]) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        if not text:
            raise ValueError(text)
        return kind(text)

    return read


_EXPECTED = {
    bool: "true or false",
    int: "a whole number",
    float: "a number or a fraction (inf is one)",
    str: "text",
    Path: "a path",
    Asset: "'shipped' or the path of a file",
}
_READ: dict[Any, Callable[[str], Any]] = {
    bool: _truth,
    int: int,
    float: Exact,
    str: str,
    Path: _named(Path),
    Asset: _named(Asset),
}
