"""Finds plugins by their files' names and by entry points, and refuses the wrong ones with what would be right.

Nothing is imported before it is looked up, so that `bench --help` costs no heavy import.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.abc import InspectLoader
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from bench.api import Dataset, Defense, DescriptorAttack, Extractor, ImageAttack, Metric, Plugin, SelectiveAttack, Task
from bench.core.errors import UserError, unknown_name
from bench.registry import fields

P = TypeVar("P", bound=Plugin)


@dataclass(frozen=True)
class Kind(Generic[P]):
    """One kind of plugin: where its files lie, its entry-point group, and the classes to subclass."""

    word: str
    package: str
    group: str
    bases: tuple[type[P], ...]


DEFENSE = Kind("defense", "defenses", "feature_privacy.defenses", (Defense,))
ATTACK = Kind[DescriptorAttack | SelectiveAttack | ImageAttack](
    "attack", "attacks", "feature_privacy.attacks", (DescriptorAttack, SelectiveAttack, ImageAttack)
)
METRIC = Kind("metric", "metrics", "feature_privacy.metrics", (Metric,))
TASK = Kind("task", "bench.tasks", "feature_privacy.tasks", (Task,))
DATASET = Kind("dataset", "bench.datasets", "feature_privacy.datasets", (Dataset,))
EXTRACTOR = Kind("extractor", "bench.extractors", "feature_privacy.extractors", (Extractor,))


@dataclass(frozen=True)
class Entry:
    """A plugin that has been found and not yet imported."""

    name: str
    origin: str  # for people: where it comes from
    load: Callable[[], Any]


def discover(kind: Kind[P]) -> dict[str, Entry]:
    """All plugins of a kind by name, none of them imported.

    Raises
    ------
    UserError
        if two have one name.
    """
    found: dict[str, Entry] = {}
    for entry in [*_built_in(kind.package), *_external(kind.group)]:
        if entry.name in found:
            raise UserError(f"two {kind.word} plugins are called {entry.name!r}: {found[entry.name].origin} and {entry.origin}")
        found[entry.name] = entry
    return dict(sorted(found.items()))


def lookup(kind: Kind[P], name: str) -> type[P]:
    """The plugin of that name.

    Raises
    ------
    UserError
        if there is none, or it is refused.
    """
    found = discover(kind)
    if name not in found:
        raise unknown_name(kind.word, name, found)
    return _register(kind, found[name])


def everything(kind: Kind[P]) -> list[type[P]]:
    """All plugins of a kind, by name.

    Raises
    ------
    UserError
        if one of them is refused.
    """
    return [_register(kind, entry) for entry in discover(kind).values()]


def check(kind: Kind[P], plugin: Any) -> type[P]:
    """Return `plugin` if it keeps the contract of its kind.

    Raises
    ------
    UserError
        that says what is wrong and what would be right.
    """
    for fault in _faults(kind, plugin):
        raise UserError(f"{kind.word} plugin {_title(plugin)}: {fault}")
    return plugin


def _register(kind: Kind[P], entry: Entry) -> type[P]:
    try:
        plugin = entry.load()
    except Exception as error:  # whatever a stranger's module raises while it is imported
        raise UserError(f"{entry.origin} cannot be imported: {type(error).__name__}: {error}") from error
    checked = check(kind, plugin)
    if checked.name() != entry.name:
        raise UserError(f"{entry.origin}: registered as {entry.name!r}, but its file's name makes it {checked.name()!r}")
    return checked


def _built_in(package: str) -> list[Entry]:
    """The modules of a package that assign PLUGIN; sub-packages are no plugins."""
    modules = [info for info in pkgutil.iter_modules(importlib.import_module(package).__path__) if not info.ispkg]
    return [
        Entry(info.name.replace("_", "-"), f"{package}.{info.name}", _loader(f"{package}.{info.name}"))
        for info in modules
        if _assigns_plugin(f"{package}.{info.name}")
    ]


def _assigns_plugin(module: str) -> bool:
    """Decided from the source, so that nothing is imported."""
    spec = importlib.util.find_spec(module)
    source = spec.loader.get_source(module) if spec and isinstance(spec.loader, InspectLoader) else None
    return re.search(r"^PLUGIN\b", source or "", re.MULTILINE) is not None


def _loader(module: str) -> Callable[[], Any]:
    return lambda: importlib.import_module(module).PLUGIN


def _external(group: str) -> list[Entry]:
    return [
        Entry(point.name, f"{point.value} (of {point.dist.name if point.dist else 'an unknown distribution'})", point.load)
        for point in entry_points(group=group)
    ]


def _title(plugin: Any) -> str:
    return f"{plugin.__module__}.{plugin.__qualname__}" if isinstance(plugin, type) else repr(plugin)


def _faults(kind: Kind[P], plugin: Any) -> list[str]:
    """What is wrong with a plugin; later checks rely on earlier ones."""
    if not isinstance(plugin, type) or not issubclass(plugin, kind.bases):
        return [f"must be a subclass of {' or '.join(base.__name__ for base in kind.bases)}"]
    return _class_faults(plugin) or _field_faults(plugin) or _method_faults(plugin) or _declaration_faults(plugin)


def _class_faults(plugin: type[Plugin]) -> list[str]:
    right = "must be decorated @dataclass(frozen=True, kw_only=True)"
    if "__dataclass_params__" not in vars(plugin):
        return [right]
    frozen = vars(plugin)["__dataclass_params__"].frozen
    named = all(field.kw_only for field in dataclasses.fields(plugin))  # type: ignore[arg-type]
    return [] if frozen and named else [right]


def _field_faults(plugin: type[Plugin]) -> list[str]:
    known = {name for base in _contracts(plugin) for name in (*vars(base), *inspect.get_annotations(base))}
    untyped = [
        f"`{name} = {value!r}` is a field without a type: write `{name}: {type(value).__name__} = {value!r}`"
        for name, value in vars(plugin).items()
        if not name.startswith("_")
        and name not in known
        and name not in inspect.get_annotations(plugin)
        and not isinstance(value, type)
        and not inspect.isroutine(value)
        and not hasattr(value, "__get__")  # properties and other descriptors
    ]
    if untyped:
        return untyped
    try:
        types = fields.field_types(plugin)
    except NameError as error:
        return [f"the type of a field cannot be resolved ({error}); import it outside TYPE_CHECKING"]
    return [
        f"field `{name}` has type {kind}; a field is bool, int, float, str, Path, Asset, a Literal, or one of them | None"
        for name, kind in types.items()
        if fields.expected(kind) is None
    ]


def _method_faults(plugin: type[Plugin]) -> list[str]:
    faults = []
    for base in _contracts(plugin):
        for name, method in vars(base).items():
            if not inspect.isfunction(method):
                continue
            right = f"{name}{inspect.signature(method)}".replace("'", "")
            if name in plugin.__abstractmethods__:  # type: ignore[attr-defined]
                faults.append(f"lacks {right}")
                continue
            own = getattr(plugin, name)
            if own is not method and getattr(method, "__final__", False):
                faults.append(f"must not override {name}")
            elif not inspect.isfunction(own) or list(inspect.signature(own).parameters) != list(
                inspect.signature(method).parameters
            ):
                faults.append(f"{name} has the wrong signature; it should be {right}")
    return faults


def _declaration_faults(plugin: type[Plugin]) -> list[str]:
    """Class variables that the base class announces without a value."""
    return [
        f"lacks the class variable `{name}: {annotation.removeprefix('ClassVar[').removesuffix(']')}`"
        for base in _contracts(plugin)
        for name, annotation in inspect.get_annotations(base).items()
        if str(annotation).startswith("ClassVar") and not any(name in vars(ancestor) for ancestor in plugin.__mro__)
    ]


def _contracts(plugin: type[Plugin]) -> list[type]:
    """The base classes of bench.api that it must satisfy."""
    return [base for base in plugin.__mro__ if base.__module__ == Plugin.__module__]
