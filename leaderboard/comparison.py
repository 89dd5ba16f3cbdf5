"""Records made into boards. What stands on one board may be compared, and nothing else.

All of a board has one schema, task with its settings, dataset (by its content, so that another split is another dataset),
extractor, metric settings and source of this program. Where there are several seeds, each has a board, and the cells that have
them all share one more, where each unit counts with its mean over the seeds. Runs of one cell in several environments stay apart.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from bench.core.errors import UserError
from bench.core.hashing import canonical, short_hash
from bench.runner import records as files
from bench.runner.records import FILE, Record
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, Measure, measures, summary
from leaderboard.tables import FIRST, extractor_label, labels, setting, units_of

T = TypeVar("T")


@dataclass(frozen=True)
class Found:
    """A record, and the folder that it lies in beside the pictures."""

    record: Record
    folder: Path


@dataclass(frozen=True, kw_only=True, eq=False)
class Cell:
    """One defense against one attack, or alone where the task takes no attack, with the records of all its units and seeds."""

    defense: str  # labels
    attack: str
    found: tuple[Found, ...]

    @property
    def head(self) -> Record:
        """The first record, for what all of them share."""
        return self.found[0].record

    @property
    def key(self) -> str:
        """Tells cells apart, on all boards together."""
        return short_hash(sorted({one.record["run_hash"] for one in self.found}))

    @property
    def reason(self) -> str | None:
        """Why it does not apply, if it does not."""
        return self.head["reason"] if self.head["status"] == "n/a" else None

    @functools.cached_property
    def done(self) -> list[Record]:
        return [one.record for one in self.found if one.record["status"] == "ok"]

    @functools.cached_property
    def by_unit(self) -> list[list[Record]]:
        """What is done, together for each unit."""
        units: dict[str, list[Record]] = {}
        for record in self.done:
            units.setdefault(record["unit"], []).append(record)
        return list(units.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """Cells that may be compared."""

    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    units: tuple[str, ...]  # what at least one cell has done, in the order of the records
    conditions: tuple[str | None, ...]  # such as day and night; (None,) where units have none
    measures: tuple[Measure, ...]  # those that some record has a value of

    @property
    def head(self) -> Record:
        return self.cells[0].head

    @property
    def key(self) -> str:
        """Tells boards apart."""
        return short_hash([_comparable(self.head), self.seeds])

    @property
    def title(self) -> str:
        return f"{self.head['task'].capitalize()} on {self.head['dataset']['name']}"

    @property
    def settings(self) -> str:
        """Those of its task."""
        told = {name: value for name, value in (self.head.get("task_settings") or {}).items() if value is not None}
        return ", ".join(f"{name} {setting(value)}" for name, value in told.items())

    @property
    def facts(self) -> list[str]:
        """What all its numbers share."""
        seeds = ", ".join(map(str, self.seeds))
        return [
            f"{len(self.units)} {units_of(self.head['task'], len(self.units))}",
            f"{extractor_label(self.head['dataset']['extractor'])} features",
            *([self.settings] if self.settings else []),
            f"seed {seeds}" if len(self.seeds) == 1 else f"mean over seeds {seeds}",
            f"source {_digits(self.head['environment']['source'])}",
            f"content {_digits(self.head['dataset']['hash'])}",
        ]

    @property
    def attacked(self) -> bool:
        """Whether it judges what attacks make of a release, and not the release itself."""
        return any(cell.head["attack"] is not None for cell in self.cells)

    def whole(self, cell: Cell) -> list[list[Record]]:
        """The records of each unit that the cell has done with every seed."""
        return [group for group in cell.by_unit if len(group) == len(self.seeds)]

    def values(self, cell: Cell, metric: str, condition: str | None = None) -> list[float | None]:
        """The value of each such unit, averaged over the seeds; of those of one condition if it is given."""
        chosen = [group for group in self.whole(cell) if condition is None or group[0].get("condition") == condition]
        return [_mean([record["metrics"].get(metric) for record in group]) for group in chosen]

    def average(self, cell: Cell, of: Measure, condition: str | None = None) -> Interval | None:
        """Its mean over the units, or what stands for it; None where there is nothing to average."""
        return summary(of, self.values(cell, of.name, condition))

    def missing(self, cell: Cell) -> int:
        """How many of the board's units the cell has not done; none where it does not apply."""
        return 0 if cell.reason else len(self.units) - len(self.whole(cell))


def find(results: Path) -> list[Found]:
    """The latest records of all files below a folder, or of one file.

    Raises
    ------
    UserError
        if there is none, or a file is damaged; the message names the file and the line.
    """
    paths = sorted(results.rglob(FILE)) if results.is_dir() else [files.find(results)]
    latest: dict[tuple[str, str], Found] = {}
    for path in paths:
        contents = files.read(path)
        if contents.notice:
            logging.getLogger(__name__).warning(contents.notice)
        latest |= {(record["run_hash"], record["unit"]): Found(record, path.parent) for record in contents.records}
    if not latest:
        raise UserError(f"--results {results}: there is no record in it (looked for files called {FILE})")
    return list(latest.values())


def boards(found: Sequence[Found]) -> list[Board]:
    """All boards, those of attacks first; of one kind the latest records first."""
    made = []
    for group in reversed(_grouped(found, lambda one: _comparable(one.record))):
        seeds = tuple(sorted({one.record["seed"] for one in group}))
        together = _cells(group)
        if len(seeds) > 1:
            shared = [cell for cell in together if {one.record["seed"] for one in cell} == set(seeds)]
            made += [_board(shared, seeds)] if shared else []
        for seed in seeds:
            made.append(
                _board([part for cell in together if (part := [one for one in cell if one.record["seed"] == seed])], (seed,))
            )
    return sorted(made, key=lambda board: (not board.attacked, board.head["task"], board.head["dataset"]["name"]))


def _comparable(record: Record) -> list[Any]:
    dataset = [record["dataset"][key] for key in ("hash", "extractor")]
    task = [record["task"], record.get("task_settings")]  # older records don't tell them
    return [record["schema"], task, dataset, record["metric_settings"], record["environment"]["source"]]


def _cells(found: Sequence[Found]) -> list[list[Found]]:
    """Parted by defense, attack and environment."""
    return _grouped(found, lambda one: [one.record[name] for name in ("defense", "attack", "environment")])


def _board(cells: Sequence[Sequence[Found]], seeds: tuple[int, ...]) -> Board:
    heads = [cell[0].record for cell in cells]
    names = labels([(head["defense"], head["attack"]) for head in heads])
    made = tuple(
        Cell(defense=defense, attack=attack + apart, found=tuple(cell))
        for cell, (defense, attack), apart in zip(cells, names, _apart(heads), strict=True)
    )
    done = [record for cell in made for record in cell.done]
    named = {name for record in done for name, value in record["metrics"].items() if value is not None}
    conditions = tuple(sorted({str(told) for record in done if (told := record.get("condition")) is not None})) or (None,)
    return Board(
        cells=made,
        seeds=seeds,
        units=tuple(dict.fromkeys(record["unit"] for record in done)),
        conditions=conditions,
        measures=tuple(sorted(measures(_by_name(named)), key=lambda measure: (measure.name != PRIVACY, measure.kind != "share"))),
    )


def _by_name(metrics: set[str]) -> list[str]:
    """The paper's first, in its order."""
    return [*(name for name in FIRST if name in metrics), *sorted(metrics - set(FIRST))]


def _apart(heads: Sequence[Record]) -> list[str]:
    """What is to be added to a label so that runs of one cell in several environments can be told from each other."""
    pairs = [canonical([head["defense"], head["attack"]]) for head in heads]
    environments = [head["environment"] for head in heads]
    differing = sorted(name for name in environments[0] if len({canonical(one.get(name)) for one in environments}) > 1)
    return [
        f" ({', '.join(f'{name} {environment.get(name)}' for name in differing)})" if pairs.count(pair) > 1 else ""
        for environment, pair in zip(environments, pairs, strict=True)
    ]


def _mean(values: Sequence[Any]) -> float | None:
    known = [float(value) for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _grouped(items: Iterable[T], key: Callable[[T], Any]) -> list[list[T]]:
    groups: dict[str, list[T]] = {}
    for item in items:
        groups.setdefault(canonical(key(item)), []).append(item)
    return list(groups.values())


def _digits(digest: str) -> str:
    """Enough of a digest to tell it."""
    return digest.removeprefix("sha256:")[:8]
