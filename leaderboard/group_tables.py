"""Boards made into tables of intervals, and these written as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from statistics import median

from bench.mechanisms.composition import UNCOVERED
from bench.runner.records import Record
from leaderboard.comparison import Board, Cell
from leaderboard.intervals import LEVEL, Interval
from leaderboard.measures import Measure
from leaderboard.ranking import Standing, standings
from leaderboard.tables import COMPOSED, NOT_APPLICABLE, SEEDED, chance, markdown_row, number, spent

Value = Interval | float | int | str | None

INTERVALS = (
    f"In brackets: {LEVEL:.0%} percentile bootstrap over the units; Wilson's interval where each unit did or did not succeed. "
    "A single unit has none, nor has a median."
)
WITHOUT_NUMBER = f"{NOT_APPLICABLE} without a note: that metric does not apply to what the attack recovers."
RANKED = (
    "Rank: by the strongest attack, the one with the greatest mean SSIM; the best in bold, of the ranked ones. A defense is "
    "unranked, and stands at the end, without an attacker that was adapted to it, and if an attack has not done everything."
)


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column: its name for programs and for people, and which way is better."""

    name: str
    label: str
    better: int = 0  # 1: the greatest is the best, -1: the least
    text: bool = False
    log10: bool = False  # of a chance


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One row: its values by the columns' names, what is to be said of it, and whose it is."""

    values: dict[str, Value]
    note: str
    competes: bool  # for the best of a column
    cell: Cell
    strongest: bool  # of the attacks on its defense


@dataclass(frozen=True, kw_only=True, eq=False)
class Sheet:
    """A table, before it is written in one way or another."""

    heading: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    remarks: tuple[str, ...]

    def best(self, column: Column) -> float | None:
        """The best value of a column, of the rows that compete; None where all are equal."""
        known = [value for row in self.rows if row.competes and (value := middle(row.values[column.name])) is not None]
        return max(known, key=lambda value: column.better * value) if len(set(known)) > 1 and column.better else None

    def is_best(self, column: Column, row: Row) -> bool:
        best = self.best(column)
        return row.competes and best is not None and middle(row.values[column.name]) == best


def pairs(board: Board) -> Sheet:
    """Every cell of a board; of a board of attacks by rank of the defense, the strongest attack first."""
    columns = _columns(board)
    rows = [_row(board, columns, *one) for one in _ordered(board)]
    facts = ", ".join([board.title, *board.facts])
    told = [f"{measure.label}: {measure.explanation}" for measure in board.measures if measure.explanation]
    ranked = [RANKED] if board.attacked else []
    remarks = (*told, *ranked, INTERVALS, WITHOUT_NUMBER, COMPOSED, SEEDED)
    return Sheet(heading=facts, columns=columns, rows=tuple(rows), remarks=remarks)


def ranking(board: Board) -> Sheet:
    """Of a board of attacks each defense once, with the strongest attack on it."""
    every = pairs(board)
    rows = tuple(row for row in every.rows if row.strongest)
    return Sheet(heading=f"Ranking. {every.heading}", columns=every.columns, rows=rows, remarks=every.remarks)


def middle(value: Value) -> float | None:
    """What a value is compared by; None of text."""
    if isinstance(value, Interval):
        return value.mean
    return float(value) if isinstance(value, int | float) else None


def shown(column: Column, row: Row) -> str:
    """A value as people read it."""
    value = row.values[column.name]
    if value is None:
        return NOT_APPLICABLE
    if column.log10 and isinstance(value, float):
        return chance(value)
    if isinstance(value, Interval):
        ends = f" [{number(value.low)}, {number(value.high)}]" if math.isfinite(value.low) else ""
        of_fewer = f" (n = {value.count})" if value.count != row.values["units"] else ""
        return number(value.mean) + ends + of_fewer
    return number(value) if isinstance(value, float) else str(value)


def to_markdown(sheet: Sheet) -> str:
    """The table with its heading, its numbered notes and what the numbers are."""
    notes = _numbered(sheet)
    lines = [f"**{markdown(sheet.heading)}**", "", markdown_row(column.label for column in sheet.columns)]
    lines.append(markdown_row("---" if column.text else "---:" for column in sheet.columns))
    for row in sheet.rows:
        texts = _texts(sheet, row, notes, markdown)
        lines.append(markdown_row(f"**{text}**" if sheet.is_best(column, row) else text for column, text in texts))
    lines += ["", *(f"[{place}] {markdown(note)}  " for note, place in notes.items()), ""]
    lines += [f"- {markdown(line)}" for line in sheet.remarks]
    return "\n".join(lines) + "\n"


def to_csv(sheet: Sheet) -> str:
    """Full precision; an interval is three columns, and the note the last one."""
    intervals = {name for row in sheet.rows for name, value in row.values.items() if isinstance(value, Interval)}
    written = io.StringIO()
    out = csv.writer(written, lineterminator="\n")
    names = [column.name for column in sheet.columns]
    out.writerow([*chain(*([name, f"{name}_low", f"{name}_high"] if name in intervals else [name] for name in names)), "note"])
    for row in sheet.rows:
        out.writerow([*chain(*(_exact(row.values[name], name in intervals) for name in names)), row.note])
    return written.getvalue()


def to_latex(sheet: Sheet) -> str:
    """A booktabs table, to be read by \\input; its notes stand beneath it."""
    notes = _numbered(sheet)
    layout = "".join("l" if column.text else "r" for column in sheet.columns)
    lines = [
        f"% {_one_line(sheet.heading)}",
        r"% \usepackage{booktabs,graphicx}",
        r"\begin{minipage}{\linewidth}",
        r"\resizebox{\linewidth}{!}{%",
        rf"\begin{{tabular}}{{{layout}}}",
        r"\toprule",
        " & ".join(latex(column.label) for column in sheet.columns) + r" \\",
        r"\midrule",
    ]
    for row in sheet.rows:
        texts = ((column, latex(text)) for column, text in _texts(sheet, row, notes, str))
        cells = [rf"\textbf{{{text}}}" if sheet.is_best(column, row) else text for column, text in texts]
        lines.append(" & ".join(cells) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}}", "", r"\smallskip\footnotesize"]
    lines += [rf"{latex(line)}\par" for line in (*(f"[{place}] {note}" for note, place in notes.items()), *sheet.remarks)]
    return "\n".join([*lines, r"\end{minipage}"]) + "\n"


def markdown(text: str) -> str:
    """Text that Markdown shows as it is; the bars of tables are `markdown_row`'s."""
    return re.sub(r"([\\`*_\[\]<>#~$])", r"\\\1", _one_line(text))


def latex(text: str) -> str:
    """Text that LaTeX prints as it is, whatever it is."""
    plain = "".join(_LATEX.get(letter, letter) for letter in _one_line(text))
    return re.sub("-(?=-)", "-{}", plain)  # two of them are no dash


def guarantee(record: Record) -> str:
    """What a defense promises, in words."""
    name, by_distance = str(record["privacy"]["guarantee"]), record["privacy"].get("epsilon_per_distance")
    told = _GUARANTEES.get(name, name)
    return told if by_distance is None else f"{told}, ε = {number(by_distance)} per unit of distance"


def _columns(board: Board) -> tuple[Column, ...]:
    rank = [Column(name="rank", label="rank")] if board.attacked else []
    attack = [Column(name="attack", label="attack", text=True)] if board.attacked else []
    return (
        *rank,
        Column(name="defense", label="defense", text=True),
        Column(name="guarantee", label="guarantee", text=True),
        Column(name="epsilon_descriptor", label="ε/descriptor"),
        Column(name="epsilon_image", label="ε/image"),
        *attack,
        *(
            Column(name=_name(measure, condition), label=_label(measure, condition), better=measure.better)
            for measure, condition in _measured(board)
        ),
        Column(name="log10_true", label="Pr(true)", log10=True),
        Column(name="units", label="n"),
    )


def _measured(board: Board) -> list[tuple[Measure, str | None]]:
    """What has a column: what is judged, under each condition, and what is only counted, over all of them."""
    judged = [(measure, condition) for condition in board.conditions for measure in board.measures if measure.better]
    return [*judged, *((measure, None) for measure in board.measures if not measure.better)]


def _name(measure: Measure, condition: str | None) -> str:
    return measure.name if condition is None else f"{measure.name}_{condition}"


def _label(measure: Measure, condition: str | None) -> str:
    return measure.label if condition is None else f"{measure.label}, {condition}"


def _ordered(board: Board) -> Iterable[tuple[Cell, Standing | None]]:
    """The cells by rank, the strongest attack of each defense first; without attacks, the most useful first."""
    if board.attacked:
        for standing in standings(board):
            others = [cell for cell in standing.cells if cell is not standing.strongest]
            yield from ((cell, standing) for cell in ([standing.strongest] if standing.strongest else []) + others)
        return
    first = next((measure for measure in board.measures if measure.better), None)
    scores = [board.average(cell, first, board.conditions[0]) if first else None for cell in board.cells]
    worth = [-math.inf if score is None or first is None else first.better * score.mean for score in scores]
    order = sorted(range(len(worth)), key=lambda place: -worth[place])
    yield from ((board.cells[place], None) for place in order)


def _row(board: Board, columns: Sequence[Column], cell: Cell, standing: Standing | None) -> Row:
    privacy = cell.head["privacy"]
    per_image = [value for record in cell.done if (value := spent(record["privacy"])) is not None]
    whole = None if cell.reason else len(board.whole(cell))
    values: dict[str, Value] = {
        "rank": standing.rank if standing else None,
        "defense": cell.defense,
        "guarantee": guarantee(cell.head),
        "epsilon_descriptor": None if privacy["epsilon_descriptor"] is None else float(privacy["epsilon_descriptor"]),
        "epsilon_image": median(per_image) if per_image else None,
        "attack": cell.attack,
        "log10_true": None if privacy["log10_true"] is None else float(privacy["log10_true"]),
        "units": whole,
    } | {_name(measure, condition): board.average(cell, measure, condition) for measure, condition in _measured(board)}
    strongest = standing is not None and cell is (standing.strongest or standing.cells[0])
    return Row(
        values={column.name: values[column.name] for column in columns},
        note="; ".join(_notes(board, cell, standing)),
        competes=whole == len(board.units) and (standing is None or (strongest and standing.rank is not None)),
        cell=cell,
        strongest=strongest,
    )


def _notes(board: Board, cell: Cell, standing: Standing | None) -> list[str]:
    """Why a row has no rank or no values, what failed, and what all its records say."""
    unranked = [f"unranked: {standing.unranked}"] if standing and standing.unranked else []
    if cell.reason:
        return unranked if standing and standing.unranked == cell.reason else [*unranked, cell.reason]
    missing = board.missing(cell)
    lacking = [f"{missing} of {len(board.units)} not done"] if missing else []
    failed = [one.record for one in cell.found if one.record["status"] == "failed"]
    told = [f"{len(failed)} failed: {failed[0]['unit']}: {failed[0]['reason']}"] if failed else []
    uncovered = [part for part in cell.head["privacy"].get("uncovered", ()) if part not in UNCOVERED]
    beyond = [f"not covered either: {', '.join(uncovered)}"] if uncovered else []
    done = cell.done
    shared = [note for note in (done[0].get("notes", ()) if done else ()) if all(note in record["notes"] for record in done)]
    return [*unranked, *lacking, *told, *shared, *beyond]


def _numbered(sheet: Sheet) -> dict[str, int]:
    return {note: place for place, note in enumerate(dict.fromkeys(row.note for row in sheet.rows if row.note), start=1)}


def _texts(sheet: Sheet, row: Row, notes: dict[str, int], escape: Callable[[str], str]) -> Iterator[tuple[Column, str]]:
    """The row as text, with the number of its note behind the defense's name. What is no number is escaped."""
    for column in sheet.columns:
        value = row.values[column.name]
        text = escape(value) if isinstance(value, str) else shown(column, row)
        yield column, f"{text} [{notes[row.note]}]" if column.name == "defense" and row.note else text


def _exact(value: Value, interval: bool) -> list[str]:
    if not interval:
        return [NOT_APPLICABLE if value is None else str(value)]
    if not isinstance(value, Interval):
        return [NOT_APPLICABLE] * 3
    return [str(end) if math.isfinite(end) else NOT_APPLICABLE for end in (value.mean, value.low, value.high)]


def _one_line(text: str) -> str:
    return re.sub(r"\s+", " ", "".join(letter if letter.isprintable() else " " for letter in text)).strip()


_GUARANTEES = {
    "epsilon-ldp": "ε-LDP",
    "epsilon-ldp-by-word": "ε-LDP of each word",
    "d-chi": "d_χ privacy",
}
_LATEX = {letter: f"\\{letter}" for letter in "{}$&#_%"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "ε": r"$\varepsilon$",
    "δ": r"$\delta$",
    "χ": r"$\chi$",
    "ω": r"$\omega$",
    "τ": r"$\tau$",
    "∞": r"$\infty$",
    "°": r"$^\circ$",
    "`": r"\textasciigrave{}",
    "[": "{[}",  # so that a row which begins with it is not read as an argument of the line before
    "]": "{]}",
}
