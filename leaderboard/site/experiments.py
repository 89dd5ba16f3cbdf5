"""What the page shows of one cell: numbers, pictures, budget, configuration, environment, and the command that makes it again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from bench.mechanisms.composition import DELTA
from leaderboard.comparison import Board, Cell
from leaderboard.group_tables import Column, Row, Sheet, Value, guarantee, middle, shown
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY
from leaderboard.recipe import Lookup, Recipe, recipe
from leaderboard.site import pictures
from leaderboard.site.pictures import Pair
from leaderboard.tables import LEFT_TO_FILES, number, spaced
from leaderboard.tradeoff import Tradeoff

UNTOLD = ("log10_true", *(name.lower() for name in LEFT_TO_FILES))  # columns that the page's table has no room for
FAILURES = 5  # that are told of a cell


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One unit of a cell, to be compared with the photograph."""

    unit: str
    score: str
    files: Pair


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One cell as the page shows it."""

    row: Row
    label: tuple[str, str]  # the defense's name, and its settings
    texts: dict[str, tuple[str, str]]  # column -> the number and its interval
    values: dict[str, str]  # column -> what it is sorted by; nothing where there is no value
    best: frozenset[str]  # columns in which it is the best
    pictures: tuple[Picture, ...]
    budget: tuple[tuple[str, str], ...]
    uncovered: tuple[str, ...]
    recipe: Recipe
    settings: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]  # heading, and names with values
    failures: tuple[str, ...]
    beside: tuple[tuple[str, str], ...]  # what a server can do with the same release: text, and the key of that cell

    @property
    def cell(self) -> Cell:
        return self.row.cell


def columns(sheet: Sheet) -> list[Column]:
    """Those that the page's table shows: what is judged, and what says of what it is."""
    head = ("rank", "defense", "guarantee", "epsilon_descriptor", "epsilon_image", "attack")
    return [
        column for column in sheet.columns if column.name in (*head, "units") or (column.better and column.name not in UNTOLD)
    ]


def view(board: Board, sheet: Sheet, row: Row, found: Sequence[Tradeoff], out: Path, lookup: Lookup) -> View:
    """Gather what there is to show of a row of the board, and copy its pictures into `out`."""
    cell = row.cell
    name, _, fields = cell.defense.partition(":")
    return View(
        row=row,
        label=(name, spaced(fields)),
        texts={column.name: _parts(column, row) for column in sheet.columns} | {"attack": (spaced(cell.attack), "")},
        values={column.name: _sorted_by(row.values[column.name]) for column in sheet.columns},
        best=frozenset(column.name for column in sheet.columns if sheet.is_best(column, row)),
        pictures=tuple(_pictures(board, cell, out)),
        budget=tuple(_budget(cell)),
        uncovered=tuple(map(str, cell.head["privacy"].get("uncovered", ()))),
        recipe=recipe(cell, lookup),
        settings=tuple(_settings(cell)),
        failures=tuple(_failures(cell)),
        beside=tuple(_beside(cell, found)),
    )


def _parts(column: Column, row: Row) -> tuple[str, str]:
    """The number, and its interval if it has one."""
    text = shown(column, row)
    if not isinstance(row.values[column.name], Interval):
        return text, ""
    mean, _, ends = text.partition(" ")
    return mean, ends.replace(", ", ",\N{NO-BREAK SPACE}").replace(" = ", "\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")


def _sorted_by(value: Value) -> str:
    """What a column is sorted by; nothing where there is no value."""
    number = middle(value)
    return ("" if value is None else str(value)) if number is None else repr(number)


def _pictures(board: Board, cell: Cell, out: Path) -> Iterator[Picture]:
    for record, files in pictures.pairs(cell.found, out):
        score = record["metrics"].get(PRIVACY)
        unit = record["unit"] if len(board.seeds) == 1 else f"{record['unit']}, seed {record['seed']}"
        yield Picture(unit=unit, score="" if score is None else f"SSIM {number(score)}", files=files)


def _budget(cell: Cell) -> Iterator[tuple[str, str]]:
    """What the photographs spend: by both compositions, the median and the range over the photographs."""
    privacy = cell.head["privacy"]
    yield "guarantee", guarantee(cell.head)
    if privacy["epsilon_descriptor"] is None:
        return
    yield "ε of a descriptor", number(float(privacy["epsilon_descriptor"]))
    kinds = {"epsilon_image": "basic composition", "epsilon_image_optimal": f"optimal composition at δ = {DELTA:g}"}
    for name, words in kinds.items():
        spent = [float(value) for record in cell.done if (value := record["privacy"].get(name)) is not None]
        if spent:
            yield f"ε of an image, {words}", f"{number(median(spent))} ({number(min(spent))} to {number(max(spent))})"
    keypoints = [record["privacy"]["keypoints"] for record in cell.done if record["privacy"].get("keypoints") is not None]
    if keypoints:
        yield "descriptors of an image", f"{median(keypoints):g} ({min(keypoints)} to {max(keypoints)})"
    yield "releases of an image that the attacker sees", str(privacy.get("releases", 1))


def _settings(cell: Cell) -> Iterator[tuple[str, tuple[tuple[str, str], ...]]]:
    head = cell.head
    dataset = {name: value for name, value in head["dataset"].items() if name != "extractor"}
    parts = {
        "Defense": head["defense"],
        "Attack": head["attack"] or {},
        "Task": {"name": head["task"], **(head.get("task_settings") or {})},
        "Data": dataset,
        "Extractor": head["dataset"]["extractor"],
        "Metrics": head["metric_settings"],
        "Run": {name: sorted({str(one.record[name]) for one in cell.found}) for name in ("cell_id", "run_hash", "seed")},
        "Environment": head["environment"],
    }
    for heading, content in parts.items():
        if lines := tuple(_flat(content)):
            yield heading, lines


def _flat(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Nested names with points between them."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", ", ".join(map(_plain, value)) if isinstance(value, list) else _plain(value)


def _plain(value: Any) -> str:
    """As records hold it."""
    return value if isinstance(value, str) else json.dumps(value)


def _failures(cell: Cell) -> Iterator[str]:
    failed = [one.record for one in cell.found if one.record["status"] == "failed"]
    yield from (f"{record['unit']}: {record['reason']}" for record in failed[:FAILURES])
    if len(failed) > FAILURES:
        yield f"and {len(failed) - FAILURES} more"


def _beside(cell: Cell, found: Sequence[Tradeoff]) -> Iterator[tuple[str, str]]:
    """What a server can do with the same defense."""
    for one in found:
        for point in one.points:
            if point.cell is cell:
                condition = f", {one.condition}" if one.condition else ""
                yield f"{one.utility.label}{condition}: {number(point.utility.mean)}", point.served.key
