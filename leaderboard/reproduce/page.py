"""What people read of a rebuilt table: Markdown, CSV and JSON in a folder, and tables for a terminal."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Container, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from bench.registry import spec
from leaderboard.intervals import LEVEL, Interval
from leaderboard.reproduce import run
from leaderboard.reproduce.claims import Evidence, Finding, Verdict
from leaderboard.reproduce.run import Rebuilt
from leaderboard.reproduce.study import Row
from leaderboard.tables import SEEDED, extractor_label, markdown_row

if TYPE_CHECKING:
    from rich.table import Table as RichTable

DIGITS = 4  # of the numbers that speak for a verdict
SHORT = 12  # statements of a claim that are all written out; of more, those that do not hold or cannot be told
MOST = 12  # of these that a terminal shows
INTERVALS = (
    f"In brackets: {LEVEL:.0%}, by percentile bootstrap over photographs, queries or seeds, of shares Wilson's; a verdict rests "
    "on the bootstrap of the paired combination."
)


def write(rebuilt: Rebuilt, out: Path) -> list[Path]:
    """Write NAME.md, NAME.csv, NAME-claims.csv and NAME.json into `out` and return their paths.

    Raises
    ------
    OSError
        if one cannot be written.
    """
    name = rebuilt.table.name
    texts = {
        f"{name}.md": markdown(rebuilt),
        f"{name}.csv": numbers(rebuilt).to_csv(index=False, lineterminator="\n"),
        f"{name}-claims.csv": verdicts(rebuilt).to_csv(index=False, lineterminator="\n"),
        f"{name}.json": json.dumps(plain(rebuilt), indent=1, ensure_ascii=False, allow_nan=False) + "\n",
    }
    for file, text in texts.items():
        (out / file).write_text(text, encoding="utf-8", errors="replace")
    return [out / file for file in texts]


def heading(rebuilt: Rebuilt) -> str:
    """What was measured, on what."""
    judged, setting = rebuilt.judged, rebuilt.setting
    count, features = len(judged.names), extractor_label(spec.written(setting.extractor))
    of_all = "" if count == judged.available else f" of {judged.available}"
    first, *others = run.seeds(rebuilt.table, setting)
    seeds = f"seeds {first} to {others[-1]}" if others else f"seed {first}"
    return f"{rebuilt.table.title}; profile {setting.profile.name}, {count}{of_all} {judged.name}, {features} features, {seeds}"


def markdown(rebuilt: Rebuilt) -> str:
    """The whole report."""
    shown = side_by_side(rebuilt)
    lines = [
        f"# {heading(rebuilt)}",
        "",
        markdown_row(shown.columns),
        markdown_row("---" for _ in shown.columns),
        *(markdown_row(row) for row in shown.itertuples(index=False)),
        "",
        *(f"- {line}" for line in remarks(rebuilt)),
        "",
        "## Claims of the paper",
        "",
    ]
    for number, finding in enumerate(rebuilt.findings, start=1):
        lines += [f"{number}. **{finding.verdict.value}**: {finding.claim.text} {tally(finding)}", ""]
        lines += [f"   - {line}" for line in written_out(finding)]
        lines.append("")
    return "\n".join(lines)


def to_rich(rebuilt: Rebuilt) -> Iterator[RichTable]:
    """Two tables for a terminal: the numbers, and the claims."""
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = side_by_side(rebuilt)
    numbers = RichTable(
        title=Text(heading(rebuilt)), caption=Text("\n".join(remarks(rebuilt))), title_justify="left", caption_justify="left"
    )
    for column in shown.columns:
        numbers.add_column(column, overflow="fold", justify="left" if column in ("attack", "note") else "right")
    for row in shown.itertuples(index=False):
        numbers.add_row(*map(Text, row))
    yield numbers
    claims = RichTable(title=Text("Claims of the paper"), title_justify="left")
    for column in ("verdict", "claim", "evidence"):
        claims.add_column(column, overflow="fold")
    for finding in rebuilt.findings:
        lines = written_out(finding)
        more = [f"and {len(lines) - MOST} more, in {rebuilt.table.name}.md"] if len(lines) > MOST else []
        evidence = "\n".join([tally(finding), *lines[:MOST], *more])
        claims.add_row(Text(finding.verdict.value), Text(finding.claim.text), Text(evidence))
    yield claims


def side_by_side(rebuilt: Rebuilt) -> pd.DataFrame:
    """Paper and ours as text, a row for each row; those borrowed from other tables come last."""
    printed = {measure for row in rebuilt.ran.rows for measure in row.paper}
    rows = [_shown(row, rebuilt, printed) for row in rebuilt.ran.rows]
    frame = pd.DataFrame(rows).fillna("")
    frame["note"] = [rebuilt.notes[row.name] for row in rebuilt.ran.rows]
    return frame if frame["note"].any() else frame.drop(columns="note")


def numbers(rebuilt: Rebuilt) -> pd.DataFrame:
    """A row for each cell: the paper's value and ours in full precision."""
    return pd.DataFrame(
        [
            {
                "row": row.name,
                **row.labels,
                "measure": measure,
                "paper": row.paper.get(measure),
                **_fields(rebuilt.ours.get((row.name, measure))),
                "cell_id": " ".join(rebuilt.ran.cells[row.name]),
                "note": rebuilt.notes[row.name],
            }
            for row in rebuilt.ran.rows
            for measure in rebuilt.table.measures
        ]
    )


def verdicts(rebuilt: Rebuilt) -> pd.DataFrame:
    """A row for each statement of each claim, with its evidence."""
    return pd.DataFrame(
        [
            {"claim": finding.claim.text, "claim_verdict": finding.verdict.value, **_evidence(evidence)}
            for finding in rebuilt.findings
            for evidence in finding.evidence
        ]
    )


def plain(rebuilt: Rebuilt) -> dict[str, Any]:
    """All of it as JSON."""
    setting = rebuilt.setting
    return {
        "table": rebuilt.table.name,
        "title": rebuilt.table.title,
        "profile": setting.profile.name,
        "scale": setting.profile.scale,
        "units": {"of": rebuilt.judged.name, "names": list(rebuilt.judged.names), "available": rebuilt.judged.available},
        "dataset": None if rebuilt.judged.dataset is None else spec.written(rebuilt.judged.dataset),
        "extractor": spec.written(setting.extractor),
        "seeds": list(run.seeds(rebuilt.table, setting)),
        "rows": [_row(row, rebuilt) for row in rebuilt.ran.rows],
        "spearman": None if rebuilt.correlation is None or math.isnan(rebuilt.correlation) else rebuilt.correlation,
        "claims": [
            {
                "claim": finding.claim.text,
                "verdict": finding.verdict.value,
                "statements": [_evidence(evidence) for evidence in finding.evidence],
            }
            for finding in rebuilt.findings
        ],
        "remarks": remarks(rebuilt),
    }


def remarks(rebuilt: Rebuilt) -> list[str]:
    """What a reader of the numbers should know."""
    table = rebuilt.table
    ranked = []
    if rebuilt.correlation is not None:
        ranked = [
            f"Spearman's rank correlation of the paper's and our {table.ordered}, over its rows: {rebuilt.correlation:.3f}."
        ]
    return [*ranked, *table.notes, INTERVALS, SEEDED]


def tally(finding: Finding) -> str:
    """How many of a claim's statements hold."""
    count = Counter(evidence.verdict for evidence in finding.evidence)
    found = [f"{count[verdict]} {word}" for verdict, word in _PLURAL.items() if count[verdict]]
    return f"(Of {len(finding.evidence)}: {', '.join(found)}.)"


def written_out(finding: Finding) -> list[str]:
    """Its statements with their evidence, those that do not hold first; of a long list without those that hold."""
    wanted = (Verdict.FAILS, Verdict.OPEN) if len(finding.evidence) > SHORT else (Verdict.FAILS, Verdict.OPEN, Verdict.HOLDS)
    return [_sentence(evidence) for verdict in wanted for evidence in finding.evidence if evidence.verdict is verdict]


_PLURAL = {Verdict.HOLDS: "hold", Verdict.FAILS: "do not hold", Verdict.OPEN: "cannot be told"}


def _sentence(evidence: Evidence) -> str:
    paper = "" if evidence.paper is None else f"paper {evidence.paper:.{DIGITS}g}, "
    ours = "nothing measured" if evidence.ours is None else f"ours {_written(evidence.ours, DIGITS, 'g')}"
    reason = f" ({evidence.reason})" if evidence.reason else ""
    return f"{evidence.verdict.value}: {evidence.statement.text}: {paper}{ours}{reason}"


def _shown(row: Row, rebuilt: Rebuilt, printed: Container[str]) -> dict[str, str]:
    """`printed` are the measures that the paper has of some row."""
    cells: dict[str, str] = dict(row.labels)
    counts = set()
    for measure, wanted in rebuilt.table.measures.items():
        ours = rebuilt.ours.get((row.name, measure))
        if measure in row.paper:
            cells[f"{measure}, paper"] = f"{row.paper[measure]:.{wanted.digits}f}"
        cells[f"{measure}, ours" if measure in printed else measure] = (
            "n/a" if ours is None else _written(ours, wanted.digits, "f")
        )
        counts |= set() if ours is None else {ours.count}
    return cells | {"n": "/".join(map(str, sorted(counts))) or "0"}


def _written(value: Interval, digits: int, style: str) -> str:
    mean, low, high = (
        "∞" if math.isinf(number) else f"{number:.{digits}{style}}" for number in (value.mean, value.low, value.high)
    )
    return mean if math.isinf(value.low) else f"{mean} [{low}, {high}]"  # of one unit alone, or a median


def _row(row: Row, rebuilt: Rebuilt) -> dict[str, Any]:
    return {
        "name": row.name,
        "labels": dict(row.labels),
        "paper": dict(row.paper),
        "ours": {measure: _fields(rebuilt.ours.get((row.name, measure))) for measure in rebuilt.table.measures},
        "defense": spec.written(row.defense),
        "attack": None if row.attack is None else spec.written(row.attack),
        "task": spec.written(row.task),
        "cell_ids": list(rebuilt.ran.cells[row.name]),
        "note": rebuilt.notes[row.name],
    }


def _evidence(evidence: Evidence) -> dict[str, Any]:
    statement = evidence.statement
    return {
        "statement": statement.text,
        "above": spec.finite(statement.above),
        "below": spec.finite(statement.below),
        "paper": evidence.paper,
        **_fields(evidence.ours),
        "verdict": evidence.verdict.value,
        "reason": evidence.reason,
    }


def _fields(value: Interval | None) -> dict[str, Any]:
    if value is None:
        return {"ours": None, "low": None, "high": None, "photographs": 0}
    return {
        "ours": spec.finite(value.mean),
        "low": spec.finite(value.low),
        "high": spec.finite(value.high),
        "photographs": value.count,
    }
