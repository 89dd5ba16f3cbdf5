"""Privacy against utility: what the strongest attack sees of a defense, beside what a server can do with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.core.hashing import canonical
from leaderboard.comparison import Board, Cell
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, UTILITY, Measure, measures
from leaderboard.ranking import Standing, standings


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """One defense with one setting."""

    standing: Standing
    cell: Cell  # of the strongest attack
    served: Cell  # what tells the utility
    privacy: Interval  # the less the better
    utility: Interval  # the more the better
    best: bool  # on the Pareto front
    own_words: bool  # whether the two were measured with other dictionaries


@dataclass(frozen=True, kw_only=True, eq=False)
class Tradeoff:
    """The points of one board of attacks and one board of utility, under one condition such as day or night."""

    attacked: Board
    served: Board
    condition: str | None
    privacy: Measure
    utility: Measure
    points: tuple[Point, ...]

    @property
    def caption(self) -> str:
        """What was measured on what."""
        here, there = self.attacked.head["dataset"], self.served.head["dataset"]
        condition = f"{self.condition.capitalize()}: " if self.condition else ""
        how = f" ({self.served.settings})" if self.served.settings else ""
        if here["hash"] == there["hash"]:
            return f"{condition}{self.privacy.label} and {self.utility.label} on {here['name']}{how}"
        words = "; words of a dictionary are those of each" if any(point.own_words for point in self.points) else ""
        return f"{condition}{self.privacy.label} on {here['name']}, {self.utility.label} on {there['name']}{how}{words}"

    @property
    def front(self) -> list[Point]:
        """Its Pareto front, from the most private to the most useful."""
        return sorted((point for point in self.points if point.best), key=lambda point: point.utility.mean)


def tradeoffs(attacked: Board, boards: Sequence[Board]) -> list[Tradeoff]:
    """One for each condition of each board of utility that shares extractor, seeds and source with a board of attacks.

    Boards of the same photographs come before others, which are only looked at where there is none; and localization before
    matching.
    """
    for utility in measures(UTILITY):
        having = [board for board in boards if utility in board.measures and _alike(board) == _alike(attacked)]
        same = [board for board in having if board.head["dataset"]["hash"] == attacked.head["dataset"]["hash"]]
        made = [_tradeoff(attacked, board, utility, condition) for board in same or having for condition in board.conditions]
        if found := [one for one in made if one.points]:
            return found
    return []


def pareto(cost: ArrayLike, gain: ArrayLike) -> NDArray[np.bool_]:
    """Which of (n,) points no other one dominates: costs no more and gains no less, and is better in one of the two. -> (n,)"""
    costs, gains = np.asarray(cost, dtype=np.float64), np.asarray(gain, dtype=np.float64)
    no_worse = (costs[None] <= costs[:, None]) & (gains[None] >= gains[:, None])
    better = (costs[None] < costs[:, None]) | (gains[None] > gains[:, None])
    return np.logical_not(np.logical_and(no_worse, better).any(axis=1))


def _tradeoff(attacked: Board, served: Board, utility: Measure, condition: str | None) -> Tradeoff:
    (privacy,) = measures([PRIVACY])
    whole = [cell for cell in served.cells if not cell.reason and not served.missing(cell)]
    pairs = []
    for standing in standings(attacked):
        cell, strongest = _same_defense(standing, whole), standing.strongest
        gained = served.average(cell, utility, condition) if cell else None
        seen = (
            attacked.average(strongest, privacy, condition if condition in attacked.conditions else None) if strongest else None
        )
        if cell and strongest and gained and seen:
            pairs.append((standing, strongest, cell, seen, gained))
    ranked = [pair for pair in pairs if pair[0].rank is not None]  # an unranked one may look more private than it is
    front = pareto([pair[3].mean for pair in ranked], [pair[4].mean for pair in ranked])
    best = {pair[1].key for pair, on_it in zip(ranked, front, strict=True) if on_it}
    points = tuple(
        Point(
            standing=standing,
            cell=cell,
            served=other,
            privacy=seen,
            utility=gained,
            best=cell.key in best,
            own_words=cell.head["defense"] != other.head["defense"],
        )
        for standing, cell, other, seen, gained in pairs
    )
    return Tradeoff(attacked=attacked, served=served, condition=condition, privacy=privacy, utility=utility, points=points)


def _same_defense(standing: Standing, served: Sequence[Cell]) -> Cell | None:
    """The cell of a server's board with the same defense and setting.

    On other data a defense may have other files, such as the dictionary of the place that is served: there it is the same if all
    else is, and no second one is so, too.
    """
    equal = [cell for cell in served if cell.head["defense"] == standing.configuration]
    if equal or any(cell.head["dataset"]["hash"] == standing.cells[0].head["dataset"]["hash"] for cell in served):
        return equal[0] if equal else None
    alike = [cell for cell in served if _without_files(cell.head["defense"]) == _without_files(standing.configuration)]
    return alike[0] if len(alike) == 1 else None


def _without_files(configuration: Mapping[str, Any]) -> dict[str, Any]:
    return {name: None if str(value).startswith("sha256:") else value for name, value in configuration.items()}


def _alike(board: Board) -> str:
    return canonical([board.head["dataset"]["extractor"], board.seeds, board.head["environment"]["source"]])
