"""Plugins written as text, `name:field=value,field=value`, and their configuration as records hold it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from bench.api import Plugin
from bench.core.errors import UserError, unknown_name
from bench.core.exact import Exact
from bench.registry import discovery, fields
from bench.registry.discovery import Kind

if TYPE_CHECKING:
    from bench.codebook.public import Public

P = TypeVar("P", bound=Plugin)


def parse(text: str, kind: Kind[P]) -> tuple[type[P], dict[str, Any]]:
    """Return the plugin that `name:field=value,...` names, and the fields that it sets.

    Raises
    ------
    UserError
        if the name or a field is misspelt, or a value has the wrong type.
    """
    name, _, rest = text.partition(":")
    plugin = discovery.lookup(kind, name.strip())
    types = fields.field_types(plugin)
    given: dict[str, Any] = {}
    for part in rest.split(",") if rest else []:
        field, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise UserError(f"{text!r}: {part!r} is not field=value (a plugin is written name:field=value,field=value)")
        if field not in types:
            raise unknown_name(f"field of {plugin.name()}", field, types)
        if field in given:
            raise UserError(f"{text!r}: {field} is given twice")
        given[field] = _value(plugin, field, types[field], value)
    return plugin, given


def build(plugin: type[P], given: Mapping[str, Any]) -> P:
    """Make the plugin, with defaults for the fields not given.

    Raises
    ------
    UserError
        if a field without default is not given, or the plugin refuses a value.
    """
    missing = [name for name in fields.without_default(plugin) if name not in given]
    if missing:
        types = fields.field_types(plugin)
        wanted = ", ".join(f"{name} ({fields.expected(types[name])})" for name in missing)
        raise UserError(f"{plugin.name()} needs {wanted}: write {plugin.name()}:{missing[0]}=...")
    return plugin(**given)


def read(text: str, kind: Kind[P]) -> P:
    """`parse`, then `build`."""
    return build(*parse(text, kind))


def configuration(plugin: Plugin, public: Public, resolved: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The plugin's name and fields as JSON, with files replaced by their content's digest.

    `resolved` stands in the place of the fields that it names. Other assets are dictionaries.

    Raises
    ------
    UserError
        if a dictionary is missing or damaged.
    """
    known = dict(resolved or {})
    digests = {name: public.digest(asset) for name, asset in fields.asset_fields(plugin).items() if name not in known}
    return written(plugin) | digests | known


def written(plugin: Plugin) -> dict[str, Any]:
    """The plugin's name and fields as JSON, with assets by name."""
    types = fields.field_types(type(plugin))
    return {"name": plugin.name()} | {name: _plain(kind, getattr(plugin, name)) for name, kind in types.items()}


def finite(value: float | None) -> float | str | None:
    """A number as records hold it: they know no infinity."""
    return str(value) if value is not None and math.isinf(value) else value


def _plain(kind: Any, value: Any) -> Any:
    if kind is float or isinstance(value, float):
        text = str(Exact(value))
        return text if "/" in text else finite(float(value))  # so that 10 and 10.0 are one configuration
    if isinstance(value, Path):
        return "sha256:" + hashlib.sha256(value.read_bytes()).hexdigest() if value.is_file() else value.as_posix()
    return value


def _value(plugin: type[Plugin], field: str, kind: Any, text: str) -> Any:
    try:
        return fields.convert(kind, text)
    except ValueError:
        raise UserError(f"{plugin.name()}: {field} must be {fields.expected(kind)}, not {text!r}") from None
