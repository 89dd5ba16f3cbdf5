"""Defenses ranked, each by the strongest attack on it: the one that brings back most of the photograph."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bench.core.hashing import canonical
from leaderboard.comparison import Board, Cell
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, Measure, measures

# The attack whose network is trained for the very defense. Attackers that were made for another one make a defense look safe.
ADAPTED = "dia"


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """One defense with one setting, and how it fares."""

    defense: str
    cells: tuple[Cell, ...]
    strongest: Cell | None  # None where no attack brought an image back
    score: Interval | None  # of the strongest
    unranked: str | None  # why it has no rank
    rank: int | None = None  # from 1, the most private; equal scores share one

    @property
    def configuration(self) -> dict[str, Any]:
        return dict(self.cells[0].head["defense"])


def standings(board: Board) -> list[Standing]:
    """All defenses of a board of attacks: those that are ranked by rank, and behind them the others."""
    groups: dict[str, list[Cell]] = {}
    for cell in board.cells:
        groups.setdefault(canonical(cell.head["defense"]), []).append(cell)
    (privacy,) = measures([PRIVACY])
    found = [_standing(board, cells, privacy) for cells in groups.values()]
    ranked = sorted((one for one in found if one.unranked is None), key=_score)
    better = [sum(_score(other) < _score(one) for other in ranked) for one in ranked]
    return [
        *(dataclasses.replace(one, rank=1 + above) for one, above in zip(ranked, better, strict=True)),
        *(one for one in found if one.unranked is not None),
    ]


def _standing(board: Board, cells: Sequence[Cell], privacy: Measure) -> Standing:
    scores = [(score, cell) for cell in cells if (score := board.average(cell, privacy)) is not None]
    score, strongest = max(scores, key=lambda pair: pair[0].mean, default=(None, None))
    return Standing(
        defense=cells[0].defense, cells=tuple(cells), strongest=strongest, score=score, unranked=_unranked(board, cells, score)
    )


def _unranked(board: Board, cells: Sequence[Cell], score: Interval | None) -> str | None:
    adapted = [cell for cell in cells if cell.head["attack"] is not None and cell.head["attack"]["name"] == ADAPTED]
    if not adapted:
        return f"no adapted attacker was run ({ADAPTED})"
    if all(cell.reason for cell in adapted):
        return adapted[0].reason
    for cell in cells:  # the mean over those that were done might be of easy ones
        if board.missing(cell):
            return f"{cell.attack} has done {len(board.whole(cell))} of {len(board.units)}"
    return None if score else "no attack made an image"


def _score(standing: Standing) -> float:
    assert standing.score is not None
    return standing.score.mean
