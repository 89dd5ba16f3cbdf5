"""Conversion of plugins from text, `name:field=value,field=value`, and to the JSON of records."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from bench.api import Plugin
from bench.core.errors import UserError, unknown_name
from bench.core.exact import Exact
from bench.registry import discovery, fields
from bench.registry.composed import Composed, compose
from bench.registry.discovery import Kind

if TYPE_CHECKING:
    from bench.codebook.public import Public

P = TypeVar("P", bound=Plugin)


def parse(text: str, kind: Kind[P]) -> tuple[type[P], dict[str, Any]]:
    """Parse `name:field=value,...`, and return the plugin and the given fields.

    Raises
    ------
    UserError
        if the name or a field is misspelt, or a value has the wrong type.
    """
    name, _, rest = text.partition(":")
    if kind is discovery.DEFENSE and "+" in name:  # `split_parts` leaves a `+` beside a misspelt name
        for part in name.split("+"):
            discovery.load_plugin(kind, part.strip())
    plugin = discovery.load_plugin(kind, name.strip())
    types = fields.resolve_types(plugin)
    given: dict[str, Any] = {}
    for part in rest.split(",") if rest else []:
        field, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise UserError(f"{text!r}: {part!r} is not field=value (write name:field=value,field=value)")
        if field not in types:
            raise unknown_name(f"field of {plugin.name()}", field, types)
        if field in given:
            raise UserError(f"{text!r}: {field} is given twice")
        given[field] = _parse_field(plugin, field, types[field], value)
    return plugin, given


def build(plugin: type[P], given: Mapping[str, Any]) -> P:
    """Return the plugin with the given fields. Other fields have their defaults.

    Raises
    ------
    UserError
        if a required field is missing, or the plugin rejects a value.
    """
    missing = [name for name in fields.list_required(plugin) if name not in given]
    if missing:
        types = fields.resolve_types(plugin)
        required = ", ".join(f"{name} ({fields.describe_type(types[name])})" for name in missing)
        raise UserError(f"{plugin.name()} needs {required}: write {plugin.name()}:{missing[0]}=...")
    return plugin(**given)


def read(text: str, kind: Kind[P], defaults: Callable[[type[P]], Mapping[str, Any]] = lambda plugin: {}) -> P:
    """Return the plugin that a text specifies: `parse`, then `build`. Defenses joined by `+` are composed.

    `defaults` returns the values of fields that the text does not give, in place of the plugin's own defaults.

    Raises
    ------
    UserError
        as `parse` and `build`, or if two defenses of the text cannot be composed.
    """
    built = []
    for part in split_parts(text) if kind is discovery.DEFENSE else [text]:
        plugin, given = parse(part, kind)
        built.append(build(plugin, {**defaults(plugin), **given}))
    return built[0] if len(built) == 1 else cast(P, compose(built))  # type: ignore[arg-type]  # parts are defenses


def split_parts(text: str) -> list[str]:
    """Return the parts of a text at each `+` that the name of a defense follows: `epsilon=1e+1` is a number."""
    names = "|".join(map(re.escape, discovery.discover(discovery.DEFENSE)))
    return re.split(rf"\+(?=\s*(?:{names})\s*(?:[:+]|$))", text)


def to_json_with_digests(plugin: Plugin, public: Public, resolved: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return name and fields of a plugin as JSON, with each file replaced by the digest of its content.

    The values of `resolved` override fields. All other assets must be dictionaries.

    Raises
    ------
    UserError
        if a dictionary is missing or damaged.
    """
    if isinstance(plugin, Composed):
        return {"name": plugin.name(), "parts": [to_json_with_digests(part, public) for part in plugin.parts]}
    overrides = dict(resolved or {})
    digests = {name: public.digest(asset) for name, asset in fields.list_assets(plugin).items() if name not in overrides}
    return to_json(plugin) | digests | overrides


def to_json(plugin: Plugin) -> dict[str, Any]:
    """Return name and fields of a plugin as JSON, with assets by name; of a composed defense, its name and its parts."""
    if isinstance(plugin, Composed):
        return {"name": plugin.name(), "parts": [to_json(part) for part in plugin.parts]}
    types = fields.resolve_types(type(plugin))
    return {"name": plugin.name()} | {name: _encode(kind, getattr(plugin, name)) for name, kind in types.items()}


def to_text(plugin: Plugin) -> str:
    """Return the specification that `read` turns into that plugin: its name, and the fields that differ from their defaults.

    >>> from defenses.ldp import LDP
    >>> to_text(LDP(epsilon=20, memoize=True))
    'ldp:epsilon=20,memoize=true'
    """
    if isinstance(plugin, Composed):
        return "+".join(map(to_text, plugin.parts))
    changed = [name for name in fields.resolve_types(type(plugin)) if not _is_default(plugin, name)]
    given = ",".join(f"{name}={format_value(getattr(plugin, name))}" for name in changed)
    return f"{plugin.name()}:{given}" if given else plugin.name()


def _is_default(plugin: Plugin, name: str) -> bool:
    """Return whether the plugin with the default of that field is the same. Plugins replace `installed` by a path."""
    defaults = fields.list_defaults(type(plugin))
    try:
        return name in defaults and bool(dataclasses.replace(plugin, **{name: defaults[name]}) == plugin)  # type: ignore[type-var]
    except UserError:  # the default does not suit the other fields
        return False


def format_value(value: Any) -> str:
    """Return the value of a field as `read` takes it."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(value)).removesuffix(".0")
    return str(value)


def encode_infinity(value: float | None) -> float | str | None:
    """Return infinity as text and other numbers unchanged: JSON has no infinity."""
    return str(value) if value is not None and math.isinf(value) else value


def _encode(kind: Any, value: Any) -> Any:
    if kind is float or isinstance(value, float):
        text = str(Exact(value))
        return text if "/" in text else encode_infinity(float(value))  # 10 and 10.0 are the same configuration
    if isinstance(value, Path):
        return "sha256:" + hashlib.sha256(value.read_bytes()).hexdigest() if value.is_file() else value.as_posix()
    return value


def _parse_field(plugin: type[Plugin], field: str, kind: Any, text: str) -> Any:
    try:
        return fields.parse_value(kind, text)
    except ValueError:
        raise UserError(f"{plugin.name()}: {field} must be {fields.describe_type(kind)}, not {text!r}") from None
