"""Writes tables, plots and the page."""

from __future__ import annotations

import base64
import functools
import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.core.environment import DISTRIBUTION
from bench.core.errors import UserError
from bench.core.progress import Progress
from leaderboard import comparison, group_tables, plots, recipe
from leaderboard.comparison import Board
from leaderboard.group_tables import Sheet
from leaderboard.recipe import Lookup
from leaderboard.reproduce.drawing import save
from leaderboard.site import experiments
from leaderboard.site.chart import charts
from leaderboard.tradeoff import tradeoffs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "index.html"
WRITERS: dict[str, Callable[[Sheet], str]] = {
    "md": group_tables.to_markdown,
    "csv": group_tables.to_csv,
    "tex": group_tables.to_latex,
}


@dataclass(frozen=True, kw_only=True)
class Done:
    """What was written."""

    page: Path
    boards: int
    cells: int
    records: int


def write(results: Path, out: Path) -> Done:
    """Write the leaderboard of all records below `results` into the folder `out`, over what it wrote there before.

    Raises
    ------
    UserError
        if there is no record, or a damaged one, or `out` is no folder; nothing has been written then.
    OSError
        if it cannot be written.
    """
    found = comparison.find(results)
    made = comparison.boards(found)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: cannot write {out}: {error.strerror}") from error
    count = sum(len(board.cells) for board in made)
    with Progress(f"{len(made)} boards, {count} cells", count) as progress:
        lookup = functools.cache(recipe.installed)
        shown = [_board(board, made, out, progress, lookup) for board in made]
    page = out / PAGE
    page.write_text(_page(shown, len(found)), encoding="utf-8", errors="replace")
    return Done(page=page, boards=len(made), cells=count, records=len(found))


def _board(board: Board, every: Sequence[Board], out: Path, progress: Progress, lookup: Lookup) -> dict[str, Any]:
    """All that the page shows of a board; its tables, plots and pictures are written."""
    found = tradeoffs(board, every) if board.attacked else []
    name = _file_name(board)
    sheet = group_tables.pairs(board)
    tables = {"pairs": sheet} | ({"ranking": group_tables.ranking(board)} if board.attacked else {})
    shown = []
    for row in sheet.rows:
        shown.append(experiments.view(board, sheet, row, found, out, lookup))
        progress.advance(note=board.title)
    return {
        "board": board,
        "sheet": sheet,
        "columns": experiments.columns(sheet),
        "cells": shown,
        "charts": charts(found),
        "tables": [_tables(table, f"{name}-{kind}", out) for kind, table in tables.items()],
        "plots": [_plot(name, kind, figure, out) for kind, figure in (plots.plots(board, found) if board.attacked else ())],
    }


def _tables(sheet: Sheet, name: str, out: Path) -> dict[str, str]:
    folder = out / "tables"
    folder.mkdir(exist_ok=True)
    for suffix, writer in WRITERS.items():
        (folder / f"{name}.{suffix}").write_text(writer(sheet), encoding="utf-8", errors="replace")
    return {suffix: f"tables/{name}.{suffix}" for suffix in WRITERS}


def _plot(name: str, kind: str, figure: Figure, out: Path) -> dict[str, Any]:
    files = {path.suffix[1:]: path.relative_to(out).as_posix() for path in save(figure, out / "plots" / f"{name}-{_plain(kind)}")}
    return files | {"name": kind.replace("-", ", "), "interactive": kind.startswith(plots.TRADEOFF)}


def _page(shown: Sequence[dict[str, Any]], records: int) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    source = files("leaderboard.site") / "page"
    style, script = ((source / file).read_text(encoding="utf-8") for file in ("style.css", "script.js"))
    environment = Environment(
        loader=PackageLoader("leaderboard.site", "page"),
        autoescape=True,  # every string of a user is text, whatever is in it
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("index.html.j2").render(
        boards=shown,
        records=records,
        version=version(DISTRIBUTION),
        style=style,
        script=script,
        # No other script or style runs, wherever it may have got in.
        script_hash=_hash(script),
        style_hash=_hash(style),
    )


def _hash(text: str) -> str:
    """As a content security policy names what it allows."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _file_name(board: Board) -> str:
    """Of letters that every system takes, and told apart by the key."""
    return "-".join([_plain(board.head["task"]), _plain(board.head["dataset"]["name"]), board.key[:8]])


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:30]
