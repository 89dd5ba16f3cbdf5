"""Claims of the paper as statements about table entries, and whether our records confirm them.

A claim is a list of statements. A table entry is the mean over samples, such as photographs, of a measure in a row. A
statement says that a linear combination of entries lies in an open interval. For example, "A > B" says that A − B lies in (0,
∞). Student's t of that combination, paired by sample, tests both that it lies inside and that it lies outside. The p-value is
twice the smaller one of the two, with Holm's correction over the statements of the claim. The statement holds or fails if it is
at most `SIGNIFICANCE`. Otherwise the verdict is "cannot tell". It is also "cannot tell" if a row of the statement has no signal
(`leaderboard/signal.py`), because its entries say nothing about the defense, or if a `confounder` determines its entries.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

import pandas as pd

from leaderboard.intervals import LEVEL, MIN_SAMPLES, Estimate, Interval, combine_independent, correct_holm, estimate_mean

TableEntry = tuple[str, str]  # a row's name, a measure

SIGNIFICANCE = 1 - LEVEL  # of the statements of a claim together, two-sided


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
    paired: bool = True  # whether its entries have the same samples; otherwise the entries are independent
    confounder: str = ""  # another cause that determines our entries, so that they cannot test the statement


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
    p_value: float | None = None  # corrected; None for a statement that was not tested
    reason: str = ""  # for `OPEN`, why it was not tested


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
    claims: Iterable[Claim],
    values: pd.DataFrame,
    paper: Mapping[TableEntry, float],
    reasons: Mapping[str, str],
    no_evidence: Mapping[str, str] = MappingProxyType({}),
) -> tuple[ClaimResult, ...]:
    """Return each claim with its evidence.

    Parameters
    ----------
    values : a column for each entry, a row for each sample; missing values are NaN
    paper : the printed value of each entry
    reasons : name of a row without values -> the reason
    no_evidence : name of a row whose attack has no signal, or was not tested for one -> the reason
    """
    return tuple(_judge_claim(claim, values, paper, reasons, no_evidence) for claim in claims)


def _judge_claim(
    claim: Claim,
    values: pd.DataFrame,
    paper: Mapping[TableEntry, float],
    reasons: Mapping[str, str],
    no_evidence: Mapping[str, str],
) -> ClaimResult:
    estimates = [_estimate(statement, values) for statement in claim.statements]
    obstacles = [
        _explain_untested(statement, estimate, reasons, no_evidence)
        for statement, estimate in zip(claim.statements, estimates, strict=True)
    ]
    tests = {
        index: _test(claim.statements[index], estimate)
        for index, estimate in enumerate(estimates)
        if estimate is not None and not obstacles[index]
    }
    corrected = dict(zip(tests, correct_holm([p_value for _, p_value in tests.values()]).tolist(), strict=True))
    return ClaimResult(
        claim=claim,
        evidence=tuple(
            Evidence(
                statement=statement,
                paper=_combine_printed(statement, paper),
                ours=estimate.interval() if estimate else None,
                verdict=tests[index][0] if index in tests and corrected[index] <= SIGNIFICANCE else Verdict.OPEN,
                p_value=corrected.get(index),
                reason=obstacles[index],
            )
            for index, (statement, estimate) in enumerate(zip(claim.statements, estimates, strict=True))
        ),
    )


def _combine_printed(statement: Statement, paper: Mapping[TableEntry, float]) -> float | None:
    weights = statement.weights
    return sum(weight * paper[entry] for entry, weight in weights.items()) if weights.keys() <= paper.keys() else None


def _estimate(statement: Statement, values: pd.DataFrame) -> Estimate | None:
    """Return the estimated combination; None if no sample has all of its entries."""
    weights = statement.weights
    if not statement.paired:
        columns = [values[entry].dropna() if entry in values else pd.Series(dtype=float) for entry in weights]
        if all(map(len, columns)):
            return combine_independent(columns, list(weights.values()))
    complete = values.reindex(columns=pd.MultiIndex.from_tuples(weights)).dropna()  # (samples, entries)
    return None if complete.empty else estimate_mean(complete.to_numpy() @ list(weights.values()))


def _explain_untested(
    statement: Statement, estimate: Estimate | None, reasons: Mapping[str, str], no_evidence: Mapping[str, str]
) -> str:
    """Return why a statement cannot be tested; "" if it can."""
    rows = dict.fromkeys(row for row, _ in statement.weights)
    if estimate is None:
        return "; ".join(f"{row}: {reasons[row]}" for row in rows if row in reasons) or "no sample has all of these entries"
    if estimate.count < MIN_SAMPLES:
        return f"{estimate.count} samples; at least {MIN_SAMPLES} are needed"
    if statement.confounder:
        return statement.confounder
    return "; ".join(f"{row}: {no_evidence[row]}" for row in rows if row in no_evidence)


def _test(statement: Statement, estimate: Estimate) -> tuple[Verdict, float]:
    """Return the verdict that the estimate speaks for, and its two-sided p-value before correction."""
    holds = max(estimate.p_above(statement.above), estimate.p_below(statement.below))  # both ends must be rejected
    fails = min(estimate.p_below(statement.above), estimate.p_above(statement.below))
    return (Verdict.HOLDS, min(1.0, 2 * holds)) if holds < fails else (Verdict.FAILS, min(1.0, 2 * fails))


def _format_entry(entry: TableEntry) -> str:
    return f"[{entry[0]}] {entry[1]}"
