"""Tables, and their writers: for a terminal, as Markdown, as CSV and as LaTeX."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table as RichTable

NOT_APPLICABLE = "n/a"


@dataclass(frozen=True, kw_only=True)
class Column:
    """Heading and kind of a column: text is aligned left and escaped, numbers are aligned right."""

    label: str
    text: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One row."""

    texts: tuple[str, ...]  # rounded, for reading; one per column
    values: Mapping[str, Any] = field(default_factory=dict)  # by name, in full precision, for programs
    note: str = ""
    best: frozenset[int] = frozenset()  # indices of the columns in bold


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Rows under columns, with a heading above and remarks below. Equal notes have one number."""

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    heading: str = ""
    remarks: tuple[str, ...] = ()
    note_column: int = 0  # index of the text column that shows the numbers of notes


def build_table(
    labels: Sequence[str],
    rows: Iterable[Iterable[str]],
    *,
    text: Collection[str] = (),
    heading: str = "",
    remarks: Iterable[str] = (),
) -> Table:
    """Return a table of texts. `text` names the columns that hold text; the others hold numbers."""
    return Table(
        columns=tuple(Column(label=label, text=label in text) for label in labels),
        rows=tuple(Row(texts=tuple(texts)) for texts in rows),
        heading=heading,
        remarks=tuple(remarks),
    )


def to_terminal(table: Table) -> RichTable:
    """Return the table for rich, with its numbered notes and its remarks below."""
    from rich.table import Table as RichTable
    from rich.text import Text

    numbers = _number_notes(table)
    caption = "\n".join((*(f"[{number}] {note}" for note, number in numbers.items()), *table.remarks))
    drawing = RichTable(title=Text(table.heading), caption=Text(caption), title_justify="left", caption_justify="left")
    for column in table.columns:
        drawing.add_column(Text(column.label), overflow="fold", justify="left" if column.text else "right")
    for row in table.rows:
        drawing.add_row(*map(Text, _annotate(table, row, numbers, str)))
    return drawing


def to_markdown(table: Table, *, plain: bool = False) -> str:
    """Return the table as Markdown, with its heading, its numbered notes and its remarks.

    Names of metrics, samples and files come from plugins and users, so all texts are escaped. `plain` is for reading the source:
    underscores within words are not escaped, no column is aligned, and notes are omitted.
    """
    escape = _escape_boundaries if plain else escape_markdown
    numbers = _number_notes(table)
    lines = [f"**{escape(table.heading)}**", ""] if table.heading else []
    lines.append(markdown_row(escape(column.label) for column in table.columns))
    lines.append(markdown_row("---" if plain or column.text else "---:" for column in table.columns))
    for row in table.rows:
        texts = enumerate(_annotate(table, row, numbers, escape))
        lines.append(markdown_row(f"**{text}**" if index in row.best else text for index, text in texts))
    if not plain:
        lines += ["", *(f"[{number}] {escape(note)}  " for note, number in numbers.items())]
    if table.remarks:
        lines += ["", *(f"- {escape(remark)}" for remark in table.remarks)]
    return "\n".join(lines) + "\n"


def to_csv(*tables: Table) -> str:
    """Return the values of all rows in full precision, or the texts of rows without values.

    A value with `mean`, `low` and `high` takes three columns. A row has n/a in the columns that its table lacks.
    """
    records: list[dict[str, str]] = []
    for table in tables:
        labels = [column.label for column in table.columns]
        rows = [row.values or dict(zip(labels, row.texts, strict=True)) for row in table.rows]
        intervals = {name for row in rows for name, value in row.items() if hasattr(value, "low")}
        for row in rows:
            record: dict[str, str] = {}
            for name, value in row.items():
                record |= _expand(name, value) if name in intervals else {name: _exact(value)}
            records.append(record)
    return write_csv(records)


def write_csv(records: Sequence[Mapping[str, Any]]) -> str:
    """Return records as CSV in full precision. None, NaN and missing names are written as n/a."""
    out = io.StringIO()
    names = dict.fromkeys(name for record in records for name in record)
    writer = csv.DictWriter(out, list(names), restval=NOT_APPLICABLE, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _exact(value) for name, value in record.items()} for record in records)
    return out.getvalue()


def to_latex(table: Table) -> str:
    """Return a booktabs table for \\input, with its notes and remarks below."""
    numbers = _number_notes(table)
    layout = "".join("l" if column.text else "r" for column in table.columns)
    lines = [
        f"% {_join_lines(table.heading)}",
        r"% \usepackage{booktabs,graphicx}",
        r"\begin{minipage}{\linewidth}",
        r"\resizebox{\linewidth}{!}{%",
        rf"\begin{{tabular}}{{{layout}}}",
        r"\toprule",
        " & ".join(escape_latex(column.label) for column in table.columns) + r" \\",
        r"\midrule",
    ]
    for row in table.rows:
        texts = enumerate(map(escape_latex, _annotate(table, row, numbers, str)))
        lines.append(" & ".join(rf"\textbf{{{text}}}" if index in row.best else text for index, text in texts) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}}", "", r"\smallskip\footnotesize"]
    notes = (f"[{number}] {note}" for note, number in numbers.items())
    lines += [rf"{escape_latex(line)}\par" for line in (*notes, *table.remarks)]
    return "\n".join([*lines, r"\end{minipage}"]) + "\n"


def markdown_row(cells: Iterable[Any]) -> str:
    """Return one line of a Markdown table; bars and line breaks in its cells are escaped."""
    return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def escape_markdown(text: str) -> str:
    """Return text that Markdown shows unchanged; `markdown_row` escapes the bars of tables."""
    return re.sub(r"([\\`*_\[\]<>#~$])", r"\\\1", _join_lines(text))


def _escape_boundaries(text: str) -> str:
    """Escape Markdown, except for underscores within words: they start no emphasis."""
    return re.sub(r"(?<=[^\W_])\\_(?=[^\W_])", "_", escape_markdown(text))


def escape_latex(text: str) -> str:
    """Return text that LaTeX prints unchanged."""
    plain = "".join(_LATEX.get(letter, letter) for letter in _join_lines(text))
    return re.sub("-(?=-)", "-{}", plain)  # two hyphens would become a dash


def _number_notes(table: Table) -> dict[str, int]:
    return {note: number for number, note in enumerate(dict.fromkeys(row.note for row in table.rows if row.note), start=1)}


def _annotate(table: Table, row: Row, numbers: Mapping[str, int], escape: Callable[[str], str]) -> list[str]:
    """Return the texts of a row, with the number of its note. Columns of numbers are not escaped."""
    texts = [escape(text) if column.text else text for column, text in zip(table.columns, row.texts, strict=True)]
    if row.note:
        texts[table.note_column] += f" [{numbers[row.note]}]"
    return texts


def _expand(name: str, value: Any) -> dict[str, str]:
    """Return the three columns of an interval. An end that is not finite is n/a."""
    ends = (value.mean, value.low, value.high) if hasattr(value, "low") else (None,) * 3
    texts = (_exact(end if end is not None and math.isfinite(end) else None) for end in ends)
    return dict(zip((name, f"{name}_low", f"{name}_high"), texts, strict=True))


def _exact(value: Any) -> str:
    return NOT_APPLICABLE if value is None or (isinstance(value, float) and math.isnan(value)) else str(value)


def _join_lines(text: str) -> str:
    return re.sub(r"\s+", " ", "".join(letter if letter.isprintable() else " " for letter in text)).strip()


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
    "[": "{[}",  # at the start of a row it would be an argument of the previous line
    "]": "{]}",
}
