"""Claims of the paper, what they say of cells, and whether they hold here.

A claim is a list of statements. A statement says that a linear combination of cells lies in an open interval, where a cell is
the mean over units, such as photographs, of a measure in a row; "A > B" says so of A − B and (0, ∞). It is judged by the
bootstrap, paired by unit, of that combination: it holds if the interval lies inside, does not hold if it lies outside, and cannot
be told if it lies astride.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import pandas as pd

from leaderboard.intervals import Interval, independent, interval

Cell = tuple[str, str]  # a row's name, a measure

# Of fewer units even a sign that all share is no evidence at 95%: of five, p = 2 · 2^-5.
FEWEST = 6


class Verdict(Enum):
    """How a claim fares here."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "cannot tell"


@dataclass(frozen=True, kw_only=True)
class Statement:
    """Σ weight · cell lies above `above` and below `below`."""

    text: str
    weights: Mapping[Cell, float]
    above: float = -math.inf
    below: float = math.inf
    paired: bool = True  # whether its cells are of the same units; if not, each is resampled by itself


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Something that the paper says, or shows, and what it means in cells."""

    text: str
    statements: tuple[Statement, ...]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A statement with the paper's value, ours over the units that have all its cells, and the verdict."""

    statement: Statement
    paper: float | None
    ours: Interval | None  # None where no photograph has all cells
    verdict: Verdict
    reason: str = ""  # why it cannot be told, where that is not for the interval


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A claim and its evidence."""

    claim: Claim
    evidence: tuple[Evidence, ...]

    @property
    def verdict(self) -> Verdict:
        """It holds if all of its statements do, and does not if one does not."""
        verdicts = {evidence.verdict for evidence in self.evidence}
        if Verdict.FAILS in verdicts:
            return Verdict.FAILS
        return Verdict.HOLDS if verdicts == {Verdict.HOLDS} else Verdict.OPEN


def greater(one: Cell, other: Cell) -> Statement:
    """one > other."""
    return Statement(text=f"{_name(one)} > {_name(other)}", weights={one: 1.0, other: -1.0}, above=0.0)


def at_least(one: Cell, other: Cell, slack: float) -> Statement:
    """one ≥ other, but for less than `slack`."""
    return Statement(text=f"{_name(one)} ≥ {_name(other)} - {slack:g}", weights={one: 1.0, other: -1.0}, above=-slack)


def about_equal(one: Cell, other: Cell, within: float) -> Statement:
    """|one − other| < within."""
    text = f"|{_name(one)} - {_name(other)}| < {within:g}"
    return Statement(text=text, weights={one: 1.0, other: -1.0}, above=-within, below=within)


def falling(cells: Sequence[Cell]) -> tuple[Statement, ...]:
    """Each cell is greater than the next."""
    return tuple(greater(one, other) for one, other in itertools.pairwise(cells))


def same_order(paper: Mapping[Cell, float], apart: float, what: str) -> Claim:
    """Every pair of cells that differ by more than `apart` in the paper has the same order here."""
    pairs = [pair for pair in itertools.combinations(paper, 2) if abs(paper[pair[0]] - paper[pair[1]]) > apart]
    ordered = [sorted(pair, key=lambda cell: -paper[cell]) for pair in pairs]
    return Claim(
        text=f"Every pair of cells that differs by more than {apart:g} {what} in the paper has the same order here.",
        statements=tuple(greater(one, other) for one, other in ordered),
    )


def judge(
    claims: Iterable[Claim], values: pd.DataFrame, paper: Mapping[Cell, float], reasons: Mapping[str, str]
) -> tuple[Finding, ...]:
    """Weigh each claim.

    Parameters
    ----------
    values : a column for each cell, a row for each unit; missing where there is none
    paper : the paper's value of each cell that it prints
    reasons : why rows have no values, by name, for those that have none
    """
    return tuple(
        Finding(claim=claim, evidence=tuple(_weigh(statement, values, paper, reasons) for statement in claim.statements))
        for claim in claims
    )


def _weigh(statement: Statement, values: pd.DataFrame, paper: Mapping[Cell, float], reasons: Mapping[str, str]) -> Evidence:
    weights = statement.weights
    printed = sum(weight * paper[cell] for cell, weight in weights.items()) if weights.keys() <= paper.keys() else None
    if not statement.paired:
        columns = [values[cell].dropna() if cell in values else pd.Series(dtype=float) for cell in weights]
        if all(map(len, columns)):
            return _evidence(statement, printed, independent(columns, list(weights.values())))
    complete = values.reindex(columns=pd.MultiIndex.from_tuples(weights)).dropna()  # (units, cells)
    if complete.empty:
        missing = dict.fromkeys(row for row, _ in weights if row in reasons)
        reason = "; ".join(f"{row}: {reasons[row]}" for row in missing) or "no unit has all of these cells"
        return Evidence(statement=statement, paper=printed, ours=None, verdict=Verdict.OPEN, reason=reason)
    return _evidence(statement, printed, interval(complete.to_numpy() @ list(weights.values())))


def _evidence(statement: Statement, printed: float | None, ours: Interval) -> Evidence:
    if ours.count < FEWEST:
        reason = f"{ours.count} units; at least {FEWEST} are needed"
        return Evidence(statement=statement, paper=printed, ours=ours, verdict=Verdict.OPEN, reason=reason)
    return Evidence(statement=statement, paper=printed, ours=ours, verdict=_verdict(statement, ours))


def _verdict(statement: Statement, ours: Interval) -> Verdict:
    if ours.low > statement.above and ours.high < statement.below:
        return Verdict.HOLDS
    if ours.high < statement.above or ours.low > statement.below:
        return Verdict.FAILS
    return Verdict.OPEN


def _name(cell: Cell) -> str:
    return f"[{cell[0]}] {cell[1]}"
