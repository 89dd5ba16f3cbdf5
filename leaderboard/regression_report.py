"""What a regression check found, as a table and as annotations of GitHub's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from leaderboard.regression import Finding, Verdict
from leaderboard.tables import number

if TYPE_CHECKING:
    from rich.table import Table

LEVEL: dict[Verdict, str] = {
    "worse": "error",
    "weaker": "error",
    "missing": "warning",
    "better": "notice",
    "new": "notice",
    "same": "notice",
}
COLUMNS = ("verdict", "defense", "attack", "metric", "before", "after", "tolerance")


def summary(found: Sequence[Finding]) -> str:
    """One line: how many of each verdict."""
    counts = Counter(finding.verdict for finding in found)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in LEVEL if counts[verdict]) or "nothing to compare"


def to_rich(found: Sequence[Finding]) -> Table:
    """A row a finding."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Against the baseline", title_justify="left")
    for column in (*COLUMNS, "note"):
        table.add_column(column, overflow="fold", justify="right" if column in COLUMNS[4:] else "left")
    for finding in found:
        table.add_row(*(Text(cell) for cell in (*_cells(finding), finding.told)))
    return table


def to_github(finding: Finding) -> str:
    """A workflow command (GitHub's documentation, "Workflow commands"), which shows as an annotation."""
    title = f"{finding.verdict}: {finding.defense} against {finding.attack}"
    metric = f"{finding.metric} was {number(finding.before)}, is {number(finding.after)}, may move by {number(finding.tolerance)}"
    message = "; ".join(part for part in (metric if finding.metric else "", finding.told) if part)
    return f"::{LEVEL[finding.verdict]} title={_property(title)}::{_data(message or finding.verdict)}"


def _cells(finding: Finding) -> tuple[str, ...]:
    numbers = (finding.before, finding.after, finding.tolerance)
    shown = map(number, numbers) if finding.metric else ("", "", "")
    return finding.verdict, finding.defense, finding.attack, finding.metric, *shown


def _data(text: str) -> str:
    """As actions/toolkit's `escapeData`."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    """As actions/toolkit's `escapeProperty`."""
    return _data(text).replace(":", "%3A").replace(",", "%2C")
