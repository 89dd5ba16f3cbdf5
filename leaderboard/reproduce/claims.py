"""Claims of the paper as statements about table entries, and whether our records confirm them.

A claim is a list of statements. A table entry is the mean over samples, such as photographs, of a measure in a row. A
statement says that a linear combination of entries lies in an open interval. For example, "A > B" says that A − B lies in (0,
∞). The verdict depends on the bootstrap interval of that combination, paired by sample. The statement holds if this interval
lies inside the open interval, and fails if it lies outside. Otherwise the verdict is "cannot tell".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import pandas as pd

from leaderboard.intervals import Interval, combine_independent, interval

TableEntry = tuple[str, str]  # a row's name, a measure

# With fewer samples, even equal signs of all differences are no evidence at 95%: five have p = 2 · 2^-5.
MIN_SAMPLES = 6


class Verdict(Enum):
    """Whether our records confirm a statement or a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    OPEN = "cannot tell"


@dataclass(frozen=True, kw_only=True)
class Statement:
    """Σ weight · entry lies above `above` and below `below`."""

    text: str
    weights: Mapping[TableEntry, float]
    above: float = -math.inf
    below: float = math.inf
    paired: bool = True  # whether its entries have the same samples; otherwise each entry is resampled by itself


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the paper, and the statements about table entries that it implies."""

    text: str
    statements: tuple[Statement, ...]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """A statement with the paper's value, our value over the samples that have all its entries, and the verdict."""

    statement: Statement
    paper: float | None
    ours: Interval | None  # None if no sample has all entries
    verdict: Verdict
    reason: str = ""  # for `OPEN`, if there is another reason than the interval


@dataclass(frozen=True, kw_only=True)
class ClaimResult:
    """A claim and its evidence."""

    claim: Claim
    evidence: tuple[Evidence, ...]

    @property
    def verdict(self) -> Verdict:
        """A claim fails if one of its statements fails, and holds if all of them hold."""
        verdicts = {evidence.verdict for evidence in self.evidence}
        if Verdict.FAILS in verdicts:
            return Verdict.FAILS
        return Verdict.HOLDS if verdicts == {Verdict.HOLDS} else Verdict.OPEN


def greater(one: TableEntry, other: TableEntry) -> Statement:
    """Return the statement one > other."""
    return Statement(text=f"{_format_entry(one)} > {_format_entry(other)}", weights={one: 1.0, other: -1.0}, above=0.0)


def at_least(one: TableEntry, other: TableEntry, slack: float) -> Statement:
    """Return the statement one > other − slack."""
    return Statement(
        text=f"{_format_entry(one)} ≥ {_format_entry(other)} - {slack:g}", weights={one: 1.0, other: -1.0}, above=-slack
    )


def about_equal(one: TableEntry, other: TableEntry, within: float) -> Statement:
    """Return the statement |one − other| < within."""
    text = f"|{_format_entry(one)} - {_format_entry(other)}| < {within:g}"
    return Statement(text=text, weights={one: 1.0, other: -1.0}, above=-within, below=within)


def falling(entries: Sequence[TableEntry]) -> tuple[Statement, ...]:
    """Return the statements that each entry is greater than the next."""
    return tuple(greater(one, other) for one, other in itertools.pairwise(entries))


def same_order(paper: Mapping[TableEntry, float], min_difference: float, measure: str) -> Claim:
    """Return the claim that all entries that differ by more than `min_difference` in the paper have the same order here."""
    pairs = [pair for pair in itertools.combinations(paper, 2) if abs(paper[pair[0]] - paper[pair[1]]) > min_difference]
    ordered = [sorted(pair, key=lambda entry: -paper[entry]) for pair in pairs]
    return Claim(
        text=f"Every pair of entries that differs by more than {min_difference:g} {measure} in the paper has the same order "
        "here.",
        statements=tuple(greater(one, other) for one, other in ordered),
    )


def judge_claims(
    claims: Iterable[Claim], values: pd.DataFrame, paper: Mapping[TableEntry, float], reasons: Mapping[str, str]
) -> tuple[ClaimResult, ...]:
    """Return each claim with its evidence.

    Parameters
    ----------
    values : a column for each entry, a row for each sample; missing values are NaN
    paper : the printed value of each entry
    reasons : name of a row without values -> the reason
    """
    return tuple(
        ClaimResult(
            claim=claim, evidence=tuple(_evaluate_statement(statement, values, paper, reasons) for statement in claim.statements)
        )
        for claim in claims
    )


def _evaluate_statement(
    statement: Statement, values: pd.DataFrame, paper: Mapping[TableEntry, float], reasons: Mapping[str, str]
) -> Evidence:
    weights = statement.weights
    printed = sum(weight * paper[entry] for entry, weight in weights.items()) if weights.keys() <= paper.keys() else None
    if not statement.paired:
        columns = [values[entry].dropna() if entry in values else pd.Series(dtype=float) for entry in weights]
        if all(map(len, columns)):
            return _make_evidence(statement, printed, combine_independent(columns, list(weights.values())))
    complete = values.reindex(columns=pd.MultiIndex.from_tuples(weights)).dropna()  # (samples, entries)
    if complete.empty:
        missing = dict.fromkeys(row for row, _ in weights if row in reasons)
        reason = "; ".join(f"{row}: {reasons[row]}" for row in missing) or "no sample has all of these entries"
        return Evidence(statement=statement, paper=printed, ours=None, verdict=Verdict.OPEN, reason=reason)
    return _make_evidence(statement, printed, interval(complete.to_numpy() @ list(weights.values())))


def _make_evidence(statement: Statement, printed: float | None, ours: Interval) -> Evidence:
    if ours.count < MIN_SAMPLES:
        reason = f"{ours.count} samples; at least {MIN_SAMPLES} are needed"
        return Evidence(statement=statement, paper=printed, ours=ours, verdict=Verdict.OPEN, reason=reason)
    return Evidence(statement=statement, paper=printed, ours=ours, verdict=_decide_verdict(statement, ours))


def _decide_verdict(statement: Statement, ours: Interval) -> Verdict:
    if ours.low > statement.above and ours.high < statement.below:
        return Verdict.HOLDS
    if ours.high < statement.above or ours.low > statement.below:
        return Verdict.FAILS
    return Verdict.OPEN


def _format_entry(entry: TableEntry) -> str:
    return f"[{entry[0]}] {entry[1]}"
