"""Consistency of records: with the ranges that metrics declare, and with the plan of their experiment."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from typing import Any

from bench.registry import discovery
from bench.runner.plan import Experiment
from bench.runner.records import Record
from bench.runner.trial import build_privacy

MAX_LENGTH = 160  # characters of a value in a message
PARTS = ("_foreground", "_background")  # ends of the names of a metric's values for parts of an image
SLACK = 1e-6  # metrics are computed in float32, and may leave their range by rounding
ROUNDING = 1e-9  # tolerated relative difference of numbers that follow from the configuration alone


def list_contradictions(record: Record, experiment: Experiment, condition: str | None) -> Iterator[str]:
    """Yield what a record contradicts: the plan of its experiment, the condition of its sample, or a declared range.

    The name of a dataset may differ: it is no part of the configuration.
    """
    for name, planned in _normalise(experiment).items():
        held = record.get(name)
        if name == "dataset" and isinstance(held, dict):
            planned, held = ({key: part[key] for key in ("hash", "extractor")} for part in (planned, held))
        if held != planned:
            yield f"{name}: is {shorten(held)}, planned is {shorten(planned)}"
    if record["status"] != "n/a" and record.get("condition") != condition:
        yield f"condition: is {shorten(record.get('condition'))}, planned is {shorten(condition)}"
    if (record["status"] == "n/a") != (experiment.reason is not None):
        yield f"status: the pair {'does not apply' if experiment.reason else 'applies'}, but the record says {record['status']}"
    if record["status"] != "ok" and record["metrics"]:
        yield f"metrics: there are some, but the record says {record['status']}"
    yield from list_impossible_values(record)
    yield from list_other_guarantees(record, experiment)


def list_impossible_values(record: Record) -> Iterator[str]:
    """Yield the metrics that are outside of their declared range, and a number of keypoints that differs from itself."""
    for name, value in record["metrics"].items():
        low, high = _list_ranges().get(_strip_part(name), (-math.inf, math.inf))
        if value is not None and not low - SLACK <= value <= high + SLACK:
            yield f"metrics.{name}: {value:g} is outside the range from {low:g} to {high:g}"
    if record["status"] == "ok" and record["privacy"].get("keypoints") != record["metrics"].get("keypoints"):
        yield "privacy.keypoints: differs from metrics.keypoints"


def list_other_guarantees(record: Record, experiment: Experiment) -> Iterator[str]:
    """Yield the entries of `privacy` that differ from those of the experiment with that number of keypoints."""
    for name, value in build_privacy(experiment, record["privacy"].get("keypoints")).items():
        held = record["privacy"].get(name)
        if not _is_close(held, value):
            yield f"privacy.{name}: is {shorten(held)}, should be {shorten(value)}"


def shorten(value: Any) -> str:
    """Return the value as one short line of printable characters."""
    text = " ".join(str(value).split())
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= MAX_LENGTH else text[: MAX_LENGTH - 3] + "..."


@functools.lru_cache(maxsize=8)
def _normalise(experiment: Experiment) -> Record:
    """Return the entries of all records of an experiment as JSON returns them."""
    metadata: Record = json.loads(json.dumps(experiment.metadata))
    return metadata


@functools.cache
def _list_ranges() -> dict[str, tuple[float, float]]:
    return {"keypoints": (1, math.inf)} | {metric.name(): metric.range for metric in discovery.load_plugins(discovery.METRIC)}


def _strip_part(name: str) -> str:
    return next((name.removesuffix(part) for part in PARTS if name.endswith(part)), name)


def _is_close(one: Any, other: Any) -> bool:
    numbers = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (one, other))
    return math.isclose(one, other, rel_tol=ROUNDING) if numbers else bool(one == other)
