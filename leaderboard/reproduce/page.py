"""Writes a reproduced table as Markdown, CSV and JSON, and as tables for a terminal."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.core import table as tables
from bench.registry import spec
from leaderboard import chance, signal
from leaderboard.intervals import LEVEL, Interval
from leaderboard.reproduce import run
from leaderboard.reproduce.claims import ClaimResult, Evidence, Verdict
from leaderboard.reproduce.run import ReproducedTable
from leaderboard.reproduce.study import Row
from leaderboard.tables import SEED_REMARK, count_hits, label_extractor

if TYPE_CHECKING:
    from rich.table import Table as RichTable

LEAST_P_VALUE = 0.001  # smaller ones are not written out
DIGITS = 4  # of the numbers in the evidence
FULL_LIST_LIMIT = 12  # a claim with more statements lists only those that fail or stay open
TERMINAL_LIMIT = 12  # statements per claim in a terminal
INTERVALS = (
    f"In brackets: {LEVEL:.0%} intervals of Student's t over photographs, queries or seeds; Wilson's for fractions. A verdict "
    "rests on Student's t of the combination, paired by sample. Its p-value has Holm's correction over the claim's statements."
)


def write(table: ReproducedTable, out: Path, provenance: str) -> list[Path]:
    """Write NAME.md, NAME.csv, NAME-claims.csv and NAME.json into `out` and return their paths. The page ends with `provenance`.

    Raises
    ------
    OSError
        if one cannot be written.
    """
    name = table.definition.name
    texts = {
        f"{name}.md": f"{to_markdown(table)}\n{provenance}",
        f"{name}.csv": tables.write_csv(tabulate_values(table)),
        f"{name}-claims.csv": tables.write_csv(tabulate_statements(table)),
        f"{name}.json": json.dumps(to_json(table), indent=1, ensure_ascii=False, allow_nan=False) + "\n",
    }
    for file, text in texts.items():
        (out / file).write_text(text, encoding="utf-8", errors="replace")
    return [out / file for file in texts]


def format_heading(table: ReproducedTable) -> str:
    """Return the title with profile, samples, features and seeds."""
    evaluation_set, setting = table.evaluation_set, table.setting
    count, features = len(evaluation_set.names), label_extractor(spec.to_json(setting.extractor))
    of_all = "" if count == evaluation_set.available else f" of {evaluation_set.available}"
    first, *more = run.list_seeds(table.definition, setting)
    seeds = f"seeds {first} to {more[-1]}" if more else f"seed {first}"
    samples = f"{count}{of_all} {evaluation_set.name}"
    return f"{table.definition.title}; profile {setting.profile.name}, {samples}, {features} features, {seeds}"


def to_markdown(table: ReproducedTable) -> str:
    """Return the values and the claims."""
    values = replace(compare_values(table), heading="")
    lines = [
        f"# {format_heading(table)}",
        "",
        tables.to_markdown(values, plain=True),
        "## Claims of the paper",
        "",
    ]
    for number, result in enumerate(table.claim_results, start=1):
        lines += [f"{number}. **{result.verdict.value}**: {result.claim.text} {count_verdicts(result)}", ""]
        lines += [f"   - {line}" for line in list_statements(result)]
        lines.append("")
    return "\n".join(lines)


def to_terminal(table: ReproducedTable) -> Iterator[RichTable]:
    """Yield two tables for a terminal: the values and the claims."""
    yield tables.to_terminal(compare_values(table))
    labels = ("verdict", "claim", "evidence")
    rows = []
    for result in table.claim_results:
        lines = list_statements(result)
        more = [f"and {len(lines) - TERMINAL_LIMIT} more, in {table.definition.name}.md"] if len(lines) > TERMINAL_LIMIT else []
        evidence = "\n".join([count_verdicts(result), *lines[:TERMINAL_LIMIT], *more])
        rows.append((result.verdict.value, result.claim.text, evidence))
    yield tables.to_terminal(tables.build_table(labels, rows, text=labels, heading="Claims of the paper"))


def compare_values(table: ReproducedTable) -> tables.Table:
    """Return the paper's values and ours as text, one line per row; reference rows come last."""
    printed = {measure for row in table.result.rows for measure in row.paper}
    rows = [_format_row(row, table, printed) for row in table.result.rows]
    labels = list(dict.fromkeys(label for row in rows for label in row))
    if table.signals:
        labels.append("signal")
        words = [table.signals[row.name].word if row.name in table.signals else "n/a" for row in table.result.rows]
        rows = [values | {"signal": word} for values, word in zip(rows, words, strict=True)]
    if any(table.notes.values()):
        labels.append("note")
        rows = [values | {"note": table.notes[row.name]} for values, row in zip(rows, table.result.rows, strict=True)]
    return tables.build_table(
        labels,
        [[row.get(label, "") for label in labels] for row in rows],
        text=("attack", "signal", "note"),
        heading=format_heading(table),
        remarks=list_remarks(table),
    )


def tabulate_values(table: ReproducedTable) -> list[dict[str, Any]]:
    """Return one line per entry: the paper's value and ours in full precision."""
    return [
        {
            "row": row.name,
            **row.labels,
            "measure": measure,
            "paper": row.paper.get(measure),
            **_interval_to_json(table.ours.get((row.name, measure))),
            "experiment_id": " ".join(table.result.experiment_ids[row.name]),
            "note": table.notes[row.name],
            "signal": _describe_signal(table, row),
        }
        for row in table.result.rows
        for measure in table.definition.measures
    ]


def tabulate_statements(table: ReproducedTable) -> list[dict[str, Any]]:
    """Return one line per statement of each claim, with its evidence."""
    return [
        {"claim": result.claim.text, "claim_verdict": result.verdict.value, **_evidence_to_json(evidence)}
        for result in table.claim_results
        for evidence in result.evidence
    ]


def to_json(table: ReproducedTable) -> dict[str, Any]:
    """Return the table as JSON."""
    setting = table.setting
    return {
        "table": table.definition.name,
        "title": table.definition.title,
        "profile": setting.profile.name,
        "scale": setting.profile.scale,
        "units": {
            "of": table.evaluation_set.name,
            "names": list(table.evaluation_set.names),
            "available": table.evaluation_set.available,
        },
        "dataset": None if table.evaluation_set.dataset is None else spec.to_json(table.evaluation_set.dataset),
        "extractor": spec.to_json(setting.extractor),
        "seeds": list(run.list_seeds(table.definition, setting)),
        "rows": [_row_to_json(row, table) for row in table.result.rows],
        "spearman": None if table.correlation is None or math.isnan(table.correlation) else table.correlation,
        "claims": [
            {
                "claim": result.claim.text,
                "verdict": result.verdict.value,
                "statements": [_evidence_to_json(evidence) for evidence in result.evidence],
            }
            for result in table.claim_results
        ],
        "remarks": list_remarks(table),
    }


def list_remarks(table: ReproducedTable) -> list[str]:
    """Return the remarks below the values."""
    definition, lines = table.definition, []
    if table.correlation is not None:
        measure = definition.rank_measure
        lines = [f"Spearman's rank correlation of the paper's and our {measure}, over its rows: {table.correlation:.3f}."]
    if table.signals:
        untested = signal.explain_untested(list(table.signals.values()))
        lines += [signal.REMARK, *([untested] if untested else [])]
    metrics = dict.fromkeys(measure.metric for measure in definition.measures.values())
    lines += [chance.explain_identification(metric) for metric in metrics if metric in chance.IDENTIFICATION]
    return [*lines, *definition.notes, INTERVALS, SEED_REMARK]


def count_verdicts(result: ClaimResult) -> str:
    """Return how many statements of a claim have each verdict, as text."""
    counts = Counter(evidence.verdict for evidence in result.evidence)
    parts = [f"{counts[verdict]} {word}" for verdict, word in _PLURAL.items() if counts[verdict]]
    return f"(Of {len(result.evidence)}: {', '.join(parts)}.)"


def list_statements(result: ClaimResult) -> list[str]:
    """Return the statements of a claim with their evidence, failed ones first. A long list omits those that hold."""
    listed = (
        (Verdict.FAILS, Verdict.OPEN) if len(result.evidence) > FULL_LIST_LIMIT else (Verdict.FAILS, Verdict.OPEN, Verdict.HOLDS)
    )
    return [_format_evidence(evidence) for verdict in listed for evidence in result.evidence if evidence.verdict is verdict]


_PLURAL = {Verdict.HOLDS: "hold", Verdict.FAILS: "do not hold", Verdict.OPEN: "cannot be decided"}


def _format_evidence(evidence: Evidence) -> str:
    paper = "" if evidence.paper is None else f"paper {evidence.paper:.{DIGITS}g}, "
    ours = "nothing measured" if evidence.ours is None else f"ours {_format_interval(evidence.ours, DIGITS, 'g')}"
    p_value = "" if evidence.p_value is None else f", {_format_p_value(evidence.p_value)}"
    reason = f" ({evidence.reason})" if evidence.reason else ""
    return f"{evidence.verdict.value}: {evidence.statement.text}: {paper}{ours}{p_value}{reason}"


def _format_p_value(value: float) -> str:
    return f"p < {LEAST_P_VALUE:g}" if value < LEAST_P_VALUE else f"p = {value:.2g}"


def _format_row(row: Row, table: ReproducedTable, printed: Container[str]) -> dict[str, str]:
    """Return a row as text by column. `printed` are the measures that the paper has for some row."""
    columns: dict[str, str] = dict(row.labels)
    counts = set()
    for name, measure in table.definition.measures.items():
        ours = table.ours.get((row.name, name))
        if name in row.paper:
            columns[f"{name}, paper"] = f"{row.paper[name]:.{measure.digits}f}"
        text = "n/a" if ours is None else _format_interval(ours, measure.digits, "f")
        hits = f" ({count_hits(ours)})" if ours and measure.identification == "rank 1" else ""
        columns[f"{name}, ours" if name in printed else name] = text + hits
        counts |= set() if ours is None else {ours.count}
    return columns | {"n": "/".join(map(str, sorted(counts))) or "0"}


def _format_interval(value: Interval, digits: int, style: str) -> str:
    mean, low, high = (
        "∞" if math.isinf(number) else f"{number:.{digits}{style}}" for number in (value.mean, value.low, value.high)
    )
    return mean if math.isinf(value.low) else f"{mean} [{low}, {high}]"  # of one sample, or a median


def _row_to_json(row: Row, table: ReproducedTable) -> dict[str, Any]:
    return {
        "name": row.name,
        "labels": dict(row.labels),
        "paper": dict(row.paper),
        "ours": {measure: _interval_to_json(table.ours.get((row.name, measure))) for measure in table.definition.measures},
        "defense": spec.to_json(row.defense),
        "attack": None if row.attack is None else spec.to_json(row.attack),
        "task": spec.to_json(row.task),
        "cell_ids": list(table.result.experiment_ids[row.name]),
        "note": table.notes[row.name],
        "signal": _describe_signal(table, row),
    }


def _describe_signal(table: ReproducedTable, row: Row) -> str | None:
    return table.signals[row.name].text if row.name in table.signals else None


def _evidence_to_json(evidence: Evidence) -> dict[str, Any]:
    statement = evidence.statement
    return {
        "statement": statement.text,
        "above": spec.encode_infinity(statement.above),
        "below": spec.encode_infinity(statement.below),
        "paper": evidence.paper,
        **_interval_to_json(evidence.ours),
        "p_value": evidence.p_value,
        "verdict": evidence.verdict.value,
        "reason": evidence.reason,
    }


def _interval_to_json(value: Interval | None) -> dict[str, Any]:
    if value is None:
        return {"ours": None, "low": None, "high": None, "photographs": 0}
    return {
        "ours": spec.encode_infinity(value.mean),
        "low": spec.encode_infinity(value.low),
        "high": spec.encode_infinity(value.high),
        "photographs": value.count,
    }
