"""The entries of a record that readers rely on, and their types.

`bench/assets/record-2.schema.json` is the complete schema, by which `bench submit-check` judges. Records of other people and of
earlier versions may lack some of its entries. This check takes 20 microseconds a record, that of the schema a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Check = Callable[[Any], bool]

STATUSES = ("ok", "n/a", "failed")


def explain_misshapen(record: Mapping[str, Any]) -> str | None:
    """Return the reason why an entry of a record (with the names of schema 2) has another form; None if all are right."""
    for name, check in REQUIRED.items():
        if name not in record:
            return f"{name} is missing"
        if not check(record[name]):
            return f"{name} is {_describe(record[name])}, which no record has there"
    for name, check in OPTIONAL.items():
        if name in record and not check(record[name]):
            return f"{name} is {_describe(record[name])}, which no record has there"
    if record["status"] != "ok" and not record["reason"]:
        return f"reason is missing for the status {record['status']}"
    return None


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_bound(value: Any) -> bool:
    """Return whether a value is an ε or a logarithm."""
    return value is None or value in ("inf", "-inf") or _is_number(value)


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, str | int | float)


def is_plugin(value: Any) -> bool:
    """Return whether a value is the configuration of a plugin: its name, and its fields."""
    return _is_object(value, {"name": _is_text}, lambda inner: _is_scalar(inner) or is_plugin(inner))


def _is_defense(value: Any) -> bool:
    """Return whether a value is the configuration of a defense, or of a composed one: its name, and its parts."""
    if isinstance(value, dict) and isinstance(value.get("parts"), list):
        return value.keys() == {"name", "parts"} and _is_text(value["name"]) and _is_list(value["parts"], is_plugin)
    return is_plugin(value)


def _is_object(value: Any, required: Mapping[str, Check], others: Check, optional: Mapping[str, Check] | None = None) -> bool:
    """Return whether a value is an object with the required entries; `others` checks those that no name is given for."""
    if not isinstance(value, dict) or not required.keys() <= value.keys():
        return False
    checks = {**(optional or {}), **required}
    return all(checks.get(name, others)(inner) for name, inner in value.items())


def _is_list(value: Any, check: Check) -> bool:
    return isinstance(value, list) and all(map(check, value))


def _optional(check: Check) -> Check:
    return lambda value: value is None or check(value)


def _anything(value: Any) -> bool:
    return True


_DATASET = {"name": _is_text, "hash": _is_text, "extractor": is_plugin}
_PRIVACY = {"guarantee": _is_text, "epsilon_descriptor": _is_bound, "log10_true": _is_bound}
_COMPOSITION = {
    "epsilon_per_distance": _is_number,
    "keypoints": _optional(_is_whole),
    "releases": _is_whole,
    "epsilon_image": _is_bound,
    "epsilon_image_optimal": _is_bound,
    "delta": _is_number,
    "uncovered": lambda value: _is_list(value, _is_text),
}
_ESTIMATES = {
    "pose": _optional(lambda value: _is_list(value, _is_number) and len(value) == 7),
    "retrieved": lambda value: _is_list(value, _is_text),
}
REQUIRED: Mapping[str, Check] = {
    "task": _is_text,
    "defense": _is_defense,
    "attack": _optional(is_plugin),
    "dataset": lambda value: _is_object(value, _DATASET, _anything, {"spec": _optional(is_plugin)}),
    "metric_settings": lambda value: _is_object(value, {}, lambda inner: isinstance(inner, dict)),
    "seed": _is_whole,
    "experiment_id": _is_text,
    "run_hash": _is_text,
    "environment": lambda value: _is_object(value, {"source": _is_text}, _is_scalar),
    "sample": _is_text,
    "status": lambda value: value in STATUSES,
    "reason": _optional(_is_text),
    "metrics": lambda value: _is_object(value, {}, _optional(_is_number)),
    "privacy": lambda value: _is_object(value, _PRIVACY, _anything, _COMPOSITION),
    "notes": lambda value: _is_list(value, _is_text),
}
OPTIONAL: Mapping[str, Check] = {
    "task_settings": _optional(lambda value: _is_object(value, {}, _is_scalar)),
    "condition": _optional(_is_text),
    "cell_id": _is_text,
    "sources": lambda value: _is_object(value, {}, _optional(_is_text)),
    "seconds": _optional(_is_number),
    "estimates": lambda value: _is_object(value, {}, _anything, _ESTIMATES),
}


def _describe(value: Any) -> str:
    kinds = {dict: "an object", list: "a list", bool: "true or false", type(None): "null"}
    text = str(value)
    shown = repr(value) if isinstance(value, str) else text
    return kinds.get(type(value), shown if len(text) <= 40 else f"{shown[:37]}...")
