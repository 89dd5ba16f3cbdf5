"""Discovery of plugins by file name and by entry point, and checks of their form.

A plugin is imported only when it is loaded, so `bench --help` imports no heavy library.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.abc import InspectLoader
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from bench.api import Dataset, Defense, DescriptorAttack, Extractor, ImageAttack, Metric, Plugin, PositionAttack, SelectiveAttack
from bench.core.errors import UserError, unknown_name
from bench.registry import fields
from bench.task_api import Task

P = TypeVar("P", bound=Plugin)


@dataclass(frozen=True)
class Kind(Generic[P]):
    """One kind of plugin: its package, its entry-point group, and its base classes."""

    name: str
    package: str
    group: str
    bases: tuple[type[P], ...]


DEFENSE = Kind("defense", "defenses", "feature_privacy.defenses", (Defense,))
ATTACK = Kind[DescriptorAttack | SelectiveAttack | ImageAttack | PositionAttack](
    "attack", "attacks", "feature_privacy.attacks", (DescriptorAttack, SelectiveAttack, ImageAttack, PositionAttack)
)
METRIC = Kind("metric", "metrics", "feature_privacy.metrics", (Metric,))
TASK = Kind("task", "bench.tasks", "feature_privacy.tasks", (Task,))
DATASET = Kind("dataset", "bench.datasets", "feature_privacy.datasets", (Dataset,))
EXTRACTOR = Kind("extractor", "bench.extractors", "feature_privacy.extractors", (Extractor,))


@dataclass(frozen=True)
class Entry:
    """A plugin that is not imported yet."""

    name: str
    origin: str  # shown to the user
    load: Callable[[], Any]


def discover(kind: Kind[P]) -> dict[str, Entry]:
    """Return all plugins of a kind by name, without importing them.

    Raises
    ------
    UserError
        if two plugins have the same name.
    """
    entries: dict[str, Entry] = {}
    for entry in [*_list_built_in(kind.package), *_list_external(kind.group)]:
        if entry.name in entries:
            raise UserError(f"two {kind.name} plugins are called {entry.name!r}: {entries[entry.name].origin} and {entry.origin}")
        entries[entry.name] = entry
    return dict(sorted(entries.items()))


def load_plugin(kind: Kind[P], name: str) -> type[P]:
    """Import and check one plugin.

    Raises
    ------
    UserError
        if there is no such plugin, or a check fails.
    """
    entries = discover(kind)
    if name not in entries:
        raise unknown_name(kind.name, name, entries)
    return _load(kind, entries[name])


def load_plugins(kind: Kind[P]) -> list[type[P]]:
    """Import and check all plugins of a kind, sorted by name.

    Raises
    ------
    UserError
        if a check fails.
    """
    return [_load(kind, entry) for entry in discover(kind).values()]


def check(kind: Kind[P], plugin: Any) -> type[P]:
    """Return `plugin` if it satisfies the contract of its kind.

    Raises
    ------
    UserError
        with the fault and the correct form.
    """
    for fault in _find_faults(kind, plugin):
        raise UserError(f"{kind.name} plugin {_format_name(plugin)}: {fault}")
    return plugin


def _load(kind: Kind[P], entry: Entry) -> type[P]:
    try:
        plugin = entry.load()
    except Exception as error:  # an external module may raise anything
        raise UserError(f"{entry.origin} cannot be imported: {type(error).__name__}: {error}") from error
    checked = check(kind, plugin)
    if checked.name() != entry.name:
        raise UserError(f"{entry.origin}: registered as {entry.name!r}, but its file's name makes it {checked.name()!r}")
    return checked


def _list_built_in(package: str) -> list[Entry]:
    """List the modules of a package that assign PLUGIN. Sub-packages are not plugins."""
    modules = [info for info in pkgutil.iter_modules(importlib.import_module(package).__path__) if not info.ispkg]
    return [
        Entry(info.name.replace("_", "-"), f"{package}.{info.name}", _build_loader(f"{package}.{info.name}"))
        for info in modules
        if _assigns_plugin(f"{package}.{info.name}")
    ]


def _assigns_plugin(module: str) -> bool:
    """Search the source, without importing the module."""
    spec = importlib.util.find_spec(module)
    source = spec.loader.get_source(module) if spec and isinstance(spec.loader, InspectLoader) else None
    return re.search(r"^PLUGIN\b", source or "", re.MULTILINE) is not None


def _build_loader(module: str) -> Callable[[], Any]:
    return lambda: importlib.import_module(module).PLUGIN


def _list_external(group: str) -> list[Entry]:
    return [
        Entry(point.name, f"{point.value} (of {point.dist.name if point.dist else 'an unknown distribution'})", point.load)
        for point in _read_entry_points(tuple(sys.path)).select(group=group)
    ]


@functools.lru_cache(maxsize=1)
def _read_entry_points(path: tuple[str, ...]) -> Any:
    """Read the entry points of all distributions, once for each search path."""
    return entry_points()


def _format_name(plugin: Any) -> str:
    return f"{plugin.__module__}.{plugin.__qualname__}" if isinstance(plugin, type) else repr(plugin)


def _find_faults(kind: Kind[P], plugin: Any) -> list[str]:
    """Return the faults of a plugin, from the first check that finds any. Later checks rely on earlier ones."""
    if not isinstance(plugin, type) or not issubclass(plugin, kind.bases):
        return [f"must be a subclass of {' or '.join(base.__name__ for base in kind.bases)}"]
    return _check_class(plugin) or _check_fields(plugin) or _check_methods(plugin) or _check_declarations(plugin)


def _check_class(plugin: type[Plugin]) -> list[str]:
    rule = "must be decorated @dataclass(frozen=True, kw_only=True)"
    if "__dataclass_params__" not in vars(plugin):
        return [rule]
    frozen = vars(plugin)["__dataclass_params__"].frozen
    keyword_only = all(field.kw_only for field in dataclasses.fields(plugin))  # type: ignore[arg-type]
    return [] if frozen and keyword_only else [rule]


def _check_fields(plugin: type[Plugin]) -> list[str]:
    inherited = {name for base in _list_contracts(plugin) for name in (*vars(base), *inspect.get_annotations(base))}
    untyped = [
        f"`{name} = {value!r}` is a field without a type: write `{name}: {type(value).__name__} = {value!r}`"
        for name, value in vars(plugin).items()
        if not name.startswith("_")
        and name not in inherited
        and name not in inspect.get_annotations(plugin)
        and not isinstance(value, type)
        and not inspect.isroutine(value)
        and not hasattr(value, "__get__")  # properties and other descriptors
    ]
    if untyped:
        return untyped
    try:
        types = fields.resolve_types(plugin)
    except NameError as error:
        return [f"the type of a field cannot be resolved ({error}); import it outside TYPE_CHECKING"]
    return [
        f"field `{name}` has type {kind}; a field is bool, int, float, str, Path, Asset, a Literal, or one of them | None"
        for name, kind in types.items()
        if fields.describe_type(kind) is None
    ]


def _check_methods(plugin: type[Plugin]) -> list[str]:
    faults = []
    for base in _list_contracts(plugin):
        for name, method in vars(base).items():
            if not inspect.isfunction(method):
                continue
            signature = f"{name}{inspect.signature(method)}".replace("'", "")
            if name in plugin.__abstractmethods__:  # type: ignore[attr-defined]
                faults.append(f"lacks {signature}")
                continue
            own = getattr(plugin, name)
            if own is not method and getattr(method, "__final__", False):
                faults.append(f"must not override {name}")
            elif not inspect.isfunction(own) or list(inspect.signature(own).parameters) != list(
                inspect.signature(method).parameters
            ):
                faults.append(f"{name} has the wrong signature; it should be {signature}")
    return faults


def _check_declarations(plugin: type[Plugin]) -> list[str]:
    """Find class variables that the base class declares without a value and the plugin does not set."""
    return [
        f"lacks the class variable `{name}: {annotation.removeprefix('ClassVar[').removesuffix(']')}`"
        for base in _list_contracts(plugin)
        for name, annotation in inspect.get_annotations(base).items()
        if str(annotation).startswith("ClassVar") and not any(name in vars(ancestor) for ancestor in plugin.__mro__)
    ]


def _list_contracts(plugin: type[Plugin]) -> list[type]:
    """Return the base classes of a plugin in bench.api and bench.task_api."""
    return [base for base in plugin.__mro__ if base.__module__ in (Plugin.__module__, Task.__module__)]
