"""Formats the results of a regression check as a table and as annotations of GitHub."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from bench.core.table import Table, build_table
from leaderboard.regression import RegressionResult, Verdict
from leaderboard.tables import format_number

LEVEL: dict[Verdict, str] = {
    "worse": "error",
    "weaker": "error",
    "missing": "warning",
    "better": "notice",
    "new": "notice",
    "same": "notice",
}
COLUMNS = ("verdict", "defense", "attack", "metric", "before", "after", "tolerance", "note")
TEXT = ("verdict", "defense", "attack", "metric", "note")  # the other columns are numbers


def summarize(results: Sequence[RegressionResult]) -> str:
    """Return one line with the number of results of each verdict."""
    counts = Counter(result.verdict for result in results)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in LEVEL if counts[verdict]) or "nothing to compare"


def build_results_table(results: Sequence[RegressionResult]) -> Table:
    """Return a table with a row for each result."""
    return build_table(COLUMNS, map(_format_row, results), text=TEXT, heading="Against the baseline")


def to_github(result: RegressionResult) -> str:
    """Return a workflow command, which GitHub shows as an annotation (GitHub's documentation, "Workflow commands")."""
    title = f"{result.verdict}: {result.defense} against {result.attack}"
    before, after, tolerance = map(format_number, (result.before, result.after, result.tolerance))
    metric = f"{result.metric} was {before}, is {after}, may move by {tolerance}" if result.metric else ""
    message = "; ".join(part for part in (metric, result.note) if part)
    return f"::{LEVEL[result.verdict]} title={_escape_property(title)}::{_escape_data(message or result.verdict)}"


def _format_row(result: RegressionResult) -> tuple[str, ...]:
    numbers = map(format_number, (result.before, result.after, result.tolerance)) if result.metric else [""] * 3
    return result.verdict, result.defense, result.attack, result.metric, *numbers, result.note


def _escape_data(text: str) -> str:
    """Return the text escaped as by `escapeData` of actions/toolkit."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _escape_property(text: str) -> str:
    """Return the text escaped as by `escapeProperty` of actions/toolkit."""
    return _escape_data(text).replace(":", "%3A").replace(",", "%2C")
