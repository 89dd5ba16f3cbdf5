"""The page's view of one experiment: numbers, images, budget, configuration, environment, and the command that repeats it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from bench.mechanisms.composition import DELTA
from bench.runner.records import Record
from leaderboard.chance import IDENTIFICATION, name_bits, name_rank_1
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.group_tables import GroupColumn, GroupRow, GroupTable, Value, comparable_number, describe_guarantee
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY
from leaderboard.recipe import Lookup, Recipe, build_recipe
from leaderboard.site import pictures
from leaderboard.site.pictures import Pair
from leaderboard.tables import FILE_ONLY_COLUMNS, add_breaks, count_hits, format_number
from leaderboard.tradeoff import Tradeoff

HIDDEN_COLUMNS = ("log10_true", *(name.lower() for name in FILE_ONLY_COLUMNS))  # the page's table has no room for them
MAX_FAILURES = 5  # that are listed of an experiment


@dataclass(frozen=True, kw_only=True)
class Picture:
    """The reconstruction of one sample, to be compared with the photograph."""

    sample: str
    score: str
    files: Pair


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One experiment as the page shows it."""

    row: GroupRow
    label: tuple[str, str]  # the defense's name, and its settings
    texts: dict[str, tuple[str, str]]  # column -> the number and its interval
    details: dict[str, tuple[tuple[str, str], ...]]  # column -> texts of other columns that it shows, such as bits
    values: dict[str, str]  # column -> its sort key; "" where there is no value
    best: frozenset[str]  # columns in which it is the best
    pictures: tuple[Picture, ...]
    budget: tuple[tuple[str, str], ...]
    uncovered: tuple[str, ...]
    recipe: Recipe
    settings: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]  # heading, and names with values
    failures: tuple[str, ...]
    utilities: tuple[tuple[str, str], ...]  # of the same release for a server: text, and the key of that experiment

    @property
    def experiment(self) -> GroupedExperiment:
        return self.row.experiment

    def find_picture(self, sample: str) -> Picture | None:
        """Return the picture of a sample, or None."""
        return next((picture for picture in self.pictures if picture.sample == sample), None)


def select_columns(table: GroupTable) -> list[GroupColumn]:
    """Return the columns of the page's table: the judged measures, and what identifies a row.

    The column of a metric of identification also shows its rank 1 and its bits.
    """
    names = ("rank", "defense", "guarantee", "epsilon_descriptor", "epsilon_image", "attack", "signal", "units")
    hidden = {*HIDDEN_COLUMNS, *(name for column in table.columns for name in _list_details(column.name))}
    return [column for column in table.columns if column.name in names or (column.better and column.name not in hidden)]


def _list_details(column: str) -> tuple[str, ...]:
    """Return the columns of rank 1 and of bits that belong to the column of a metric of identification."""
    metric, separator, condition = column.partition("_")
    if metric not in IDENTIFICATION or (separator and condition.startswith(("rank_1", "bits"))):
        return ()
    return tuple(f"{name(metric)}{separator}{condition}" for name in (name_rank_1, name_bits))


def build_view(
    group: ComparisonGroup, table: GroupTable, row: GroupRow, tradeoffs: Sequence[Tradeoff], out: Path, lookup: Lookup
) -> View:
    """Return the view of a row of the group's table, and copy its images into `out`."""
    experiment = row.experiment
    name, _, fields = experiment.defense.partition(":")
    texts = {
        column.name: _split_interval(text, row.values[column.name]) for column, text in zip(table.columns, row.texts, strict=True)
    }
    return View(
        row=row,
        label=(name, add_breaks(fields)),
        texts=texts | {"attack": (add_breaks(experiment.attack), "")},
        details={column.name: tuple(_list_detail_texts(column.name, row.values)) for column in table.columns},
        values={column.name: _sort_key(row.values[column.name]) for column in table.columns},
        best=frozenset(table.columns[index].name for index in row.best),
        pictures=tuple(_list_pictures(group, experiment, out)),
        budget=tuple(_list_budget(experiment)),
        uncovered=tuple(map(str, experiment.metadata["privacy"].get("uncovered", ()))),
        recipe=build_recipe(experiment, lookup),
        settings=tuple(_list_settings(experiment)),
        failures=tuple(_list_failures(experiment)),
        utilities=tuple(dict.fromkeys(_list_utilities(experiment, tradeoffs))),
    )


def _list_detail_texts(column: str, values: Mapping[str, Value]) -> Iterator[tuple[str, str]]:
    """Yield rank 1 as "1 of 7" and the bits, each with its interval."""
    rank_1, bits = map(values.get, _list_details(column) or (column, column))
    if isinstance(rank_1, Interval) and isinstance(bits, Interval) and rank_1 is not bits:
        yield count_hits(rank_1), _format_ends(rank_1, 2)
        yield f"{bits.mean:.1f} bits", _format_ends(bits, 1)


def _format_ends(value: Interval, digits: int) -> str:
    """Return the interval; "" if it is infinite, as for the mean of one sample over seeds."""
    return f"[{value.low:.{digits}f},\N{NO-BREAK SPACE}{value.high:.{digits}f}]" if math.isfinite(value.low) else ""


def label_sample(group: ComparisonGroup, record: Record) -> str:
    """Return the name of a record's sample, with its seed where the group has several."""
    return record["sample"] if len(group.seeds) == 1 else f"{record['sample']}, seed {record['seed']}"


def _split_interval(text: str, value: Value) -> tuple[str, str]:
    """Return the number, and its interval if it has one."""
    if not isinstance(value, Interval):
        return text, ""
    mean, _, ends = text.partition(" ")
    return mean, ends.replace(", ", ",\N{NO-BREAK SPACE}").replace(" = ", "\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")


def _sort_key(value: Value) -> str:
    """Return what a column is sorted by; "" where there is no value."""
    number = comparable_number(value)
    return ("" if value is None else str(value)) if number is None else repr(number)


def _list_pictures(group: ComparisonGroup, experiment: GroupedExperiment, out: Path) -> Iterator[Picture]:
    for record, files in pictures.write_pairs(experiment.records, out):
        score = record["metrics"].get(PRIVACY)
        yield Picture(
            sample=label_sample(group, record), score="" if score is None else f"SSIM {format_number(score)}", files=files
        )


def _list_budget(experiment: GroupedExperiment) -> Iterator[tuple[str, str]]:
    """Yield the guarantee and the budget of an image: its median and range over the photographs, by both compositions."""
    privacy = experiment.metadata["privacy"]
    yield "guarantee", describe_guarantee(experiment.metadata)
    if privacy["epsilon_descriptor"] is None:
        return
    yield "ε of a descriptor", format_number(float(privacy["epsilon_descriptor"]))
    kinds = {"epsilon_image": "basic composition", "epsilon_image_optimal": f"optimal composition at δ = {DELTA:g}"}
    for name, words in kinds.items():
        if epsilons := [float(value) for value in _list_privacy(experiment, name)]:
            middle, least, most = map(format_number, (median(epsilons), min(epsilons), max(epsilons)))
            yield f"ε of an image, {words}", f"{middle} ({least} to {most})"
    if keypoints := _list_privacy(experiment, "keypoints"):
        yield "descriptors of an image", f"{median(keypoints):g} ({min(keypoints)} to {max(keypoints)})"
    yield "releases of an image that the attacker sees", str(privacy.get("releases", 1))


def _list_privacy(experiment: GroupedExperiment, name: str) -> list[Any]:
    values = (record["privacy"].get(name) for record in experiment.completed)
    return [value for value in values if value is not None]


def _list_settings(experiment: GroupedExperiment) -> Iterator[tuple[str, tuple[tuple[str, str], ...]]]:
    metadata = experiment.metadata
    dataset = {name: value for name, value in metadata["dataset"].items() if name != "extractor"}
    parts = {
        "Defense": metadata["defense"],
        "Attack": metadata["attack"] or {},
        "Task": {"name": metadata["task"], **(metadata.get("task_settings") or {})},
        "Data": dataset,
        "Extractor": metadata["dataset"]["extractor"],
        "Metrics": metadata["metric_settings"],
        "Run": {
            name: sorted({str(located.record[name]) for located in experiment.records})
            for name in ("experiment_id", "run_hash", "seed")
        },
        "Environment": metadata["environment"],
    }
    for heading, content in parts.items():
        if lines := tuple(_flatten(content)):
            yield heading, lines


def _flatten(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Yield nested fields as `outer.inner`, with their values."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", ", ".join(map(_format_value, value)) if isinstance(value, list) else _format_value(value)


def _format_value(value: Any) -> str:
    """Return a value as records write it."""
    return value if isinstance(value, str) else json.dumps(value)


def _list_failures(experiment: GroupedExperiment) -> Iterator[str]:
    failed = experiment.failed
    yield from (f"{record['sample']}: {record['reason']}" for record in failed[:MAX_FAILURES])
    if len(failed) > MAX_FAILURES:
        yield f"and {len(failed) - MAX_FAILURES} more"


def _list_utilities(experiment: GroupedExperiment, tradeoffs: Sequence[Tradeoff]) -> Iterator[tuple[str, str]]:
    """Yield the utility of the same defense for a server, and the key of the experiment that measured it."""
    for tradeoff in tradeoffs:
        for point in tradeoff.points:
            if point.attack_experiment is experiment:
                condition = f", {tradeoff.condition}" if tradeoff.condition else ""
                text = f"{tradeoff.utility.label}{condition}: {format_number(point.utility.mean)}"
                yield text, point.utility_experiment.key
