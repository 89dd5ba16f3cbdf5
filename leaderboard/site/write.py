"""Writes the tables, the plots and the page of a leaderboard."""

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
from bench.core.table import Table, to_csv, to_latex, to_markdown
from leaderboard import group_tables, plots, recipe, suite_table
from leaderboard.comparison import ComparisonGroup, build_groups, load_records
from leaderboard.provenance import format_provenance
from leaderboard.recipe import Lookup
from leaderboard.reproduce.drawing import save
from leaderboard.site import experiments
from leaderboard.site.chart import build_charts
from leaderboard.site.overview import build_overview
from leaderboard.tradeoff import build_tradeoffs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "index.html"
COMMAND = "bench leaderboard --results RESULTS --out SITE"  # in the plots' provenance, without the paths of a machine
WRITERS: dict[str, Callable[[Table], str]] = {"md": to_markdown, "csv": to_csv, "tex": to_latex}


@dataclass(frozen=True, kw_only=True)
class WrittenSite:
    """The page, and the numbers of groups, experiments and records on it."""

    page: Path
    groups: int
    experiments: int
    records: int


def write(results: Sequence[Path], out: Path) -> WrittenSite:
    """Write the leaderboard of all records in `results` (files or folders) into the folder `out`, over what it wrote before.

    Raises
    ------
    UserError
        if there is no record, or a damaged one, or `out` is no folder; nothing has been written then.
    OSError
        if it cannot be written.
    """
    located = load_records(*results)
    groups = build_groups(located)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: cannot write {out}: {error.strerror}") from error
    count = sum(len(group.experiments) for group in groups)
    with Progress(f"{len(groups)} groups, {count} experiments", count) as progress:
        lookup = functools.cache(recipe.find_plugin)
        views = [_write_group(group, groups, out, progress, lookup) for group in groups]
    page = out / PAGE
    page.write_text(_render_page(views, len(located)), encoding="utf-8", errors="replace")
    return WrittenSite(page=page, groups=len(groups), experiments=count, records=len(located))


def _write_group(
    group: ComparisonGroup, groups: Sequence[ComparisonGroup], out: Path, progress: Progress, lookup: Lookup
) -> dict[str, Any]:
    """Write the tables, plots and images of a group, and return what the page shows of it."""
    tradeoffs = build_tradeoffs(group, groups) if group.has_attacks else []
    name = _build_file_name(group)
    table = group_tables.build_pairs_table(group)
    tables: dict[str, Table] = {"pairs": table}
    tables |= {"ranking": group_tables.build_ranking_table(group)} if group.has_attacks else {}
    suite = suite_table.build_group_tables(group, groups)
    tables |= suite
    views = []
    for row in table.rows:
        views.append(experiments.build_view(group, table, row, tradeoffs, out, lookup))
        progress.advance(note=group.title)
    figures = plots.draw_plots(group, tradeoffs) if group.has_attacks else ()
    provenance = format_provenance(COMMAND, [experiment.metadata for experiment in group.experiments])
    return {
        "group": group,
        "table": table,
        "suite": suite,
        "columns": experiments.select_columns(table),
        "experiments": views,
        "overview": build_overview(group, views),
        "charts": build_charts(tradeoffs),
        "tables": {kind: _write_tables(table, f"{name}-{kind}", out) for kind, table in tables.items()},
        "plots": [_write_plot(f"{name}-{_slugify(kind)}", kind, figure, provenance, out) for kind, figure in figures],
    }


def _write_tables(table: Table, name: str, out: Path) -> dict[str, str]:
    folder = out / "tables"
    folder.mkdir(exist_ok=True)
    for suffix, writer in WRITERS.items():
        (folder / f"{name}.{suffix}").write_text(writer(table), encoding="utf-8", errors="replace")
    return {suffix: f"tables/{name}.{suffix}" for suffix in WRITERS}


def _write_plot(name: str, kind: str, figure: Figure, provenance: str, out: Path) -> dict[str, Any]:
    paths = save(figure, out / "plots" / name, provenance)
    files = {path.suffix[1:]: path.relative_to(out).as_posix() for path in paths}
    return files | {"name": kind.replace("-", ", "), "interactive": kind.startswith(plots.TRADEOFF)}


def _render_page(groups: Sequence[dict[str, Any]], records: int) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    source = files("leaderboard.site") / "page"
    style, script = ((source / file).read_text(encoding="utf-8") for file in ("style.css", "script.js"))
    environment = Environment(
        loader=PackageLoader("leaderboard.site", "page"),
        autoescape=True,  # every string of a user is text
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("index.html.j2").render(
        groups=groups,
        records=records,
        version=version(DISTRIBUTION),
        style=style,
        script=script,
        # No other script or style runs.
        script_hash=_hash_source(script),
        style_hash=_hash_source(style),
    )


def _hash_source(text: str) -> str:
    """Return the hash of a script or style for the content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _build_file_name(group: ComparisonGroup) -> str:
    """Return a name of letters that every system accepts, which the key makes unique."""
    return "-".join([_slugify(group.metadata["task"]), _slugify(group.metadata["dataset"]["name"]), group.key[:8]])


def _slugify(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:30]
