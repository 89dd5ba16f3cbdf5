"""`bench reproduce NAME`: reproduces one table, or the figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from bench.api import Dataset, Extractor
from bench.core import threads
from bench.core.errors import UserError, unknown_name
from bench.extractors.sift import Sift
from bench.images.photographs import name_images
from bench.runner import engines
from bench.runner.engines import Engine
from bench.settings import Asset
from leaderboard import localization_results
from leaderboard.provenance import format_provenance
from leaderboard.reproduce import figures, page, paper_data, run, tables
from leaderboard.reproduce.drawing import Drawing, FigureData, save
from leaderboard.reproduce.profiles import Materials, Setting, find_profile
from leaderboard.reproduce.run import EvaluationSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = "figures"


@dataclass(frozen=True, kw_only=True, eq=False)
class Reproduction:
    """The folder of the results, the output for the terminal, and the number of failed records."""

    out: Path
    output: tuple[object, ...]  # for rich
    failed: int


def reproduce(
    name: str,
    profile_name: str,
    *,
    images: Path | None,
    dataset: Dataset | None,
    extractor: Extractor | None,
    seed: int,
    out: Path | None,
    workers: int | None,
    materials: Mapping[str, str],
    command: str,
) -> Reproduction:
    """Reproduce the table or figures `name` with the profile `profile_name`, and write the result.

    Tables with the same `out` share their records. `command` is the command line, which the results name.

    Raises
    ------
    UserError
        if a name is misspelt, or a file is missing or does not fit; nothing is written then.
    """
    definitions, drawings = tables.load_tables(), group_drawings()
    if name not in {**definitions, **drawings}:
        raise unknown_name("table", name, [*definitions, *drawings])
    profile, table = find_profile(profile_name), definitions.get(name)
    needs_dataset = takes_dataset(name)
    if needs_dataset and images is not None:
        raise UserError(f"{name} uses a dataset: pass it with --dataset, not --images")
    if not needs_dataset and dataset is not None:
        raise UserError(f"{name} uses photographs: pass them with --images, not --dataset")
    if needs_dataset:
        evaluation_set = run.select_queries(
            dataset or (table.dataset(profile) if table and table.dataset else profile.figure_gallery)
        )
    else:
        evaluation_set = run.select_photographs(
            images, profile, profile.figure_photographs if name == FIGURES else profile.photographs
        )
    setting = Setting(
        profile=profile,
        materials=Materials(**{field: Asset(file) for field, file in materials.items()}),
        extractor=extractor or (table.extractor(profile) if table else Sift()),
        photographs=len(evaluation_set.photographs),
        seed=seed,
    )
    folder = out or Path("runs") / f"reproduce-{profile.name}-{_name_folder(images, evaluation_set)}"
    engine = engines.choose_engine(workers or (threads.count_cores() if needs_dataset else 1))
    if table is None:
        return _reproduce_figures(name, drawings[name], setting, evaluation_set, folder, engine, command)
    reproduced = run.reproduce_table(table, setting, evaluation_set, folder, engine)
    records = run.list_records(reproduced.result)
    provenance = format_provenance(command, records)
    page.write(reproduced, folder, provenance)
    data = FigureData(setting=setting, evaluation_set=evaluation_set, result=reproduced.result, out=folder)
    files = [Text(line) for line in localization_results.write(records, folder)]
    files += [] if table.draw is None else _save_figures(name, table.draw(data), folder, provenance)
    return Reproduction(out=folder, output=(*page.to_terminal(reproduced), *files), failed=run.count_failures(reproduced.result))


def group_drawings() -> dict[str, tuple[Drawing, ...]]:
    """Return the figures by target: one target for all figures of photographs, one for each figure of queries."""
    drawings = figures.load_figures()
    of_queries = {f"figure-{drawing.name}": (drawing,) for drawing in drawings if drawing.uses_queries}
    return {FIGURES: tuple(drawing for drawing in drawings if not drawing.uses_queries), **of_queries}


def list_missing(name: str, given: Collection[str]) -> tuple[str, ...]:
    """Return a line on each part of the paper's data that the table or figures `name` replace by our own.

    `given` are the names of the user's inputs. An unknown name has no lines: `reproduce` raises its error.
    """
    known = name in {**tables.load_tables(), **group_drawings()}
    return tuple(paper_data.list_missing(name, given, takes_dataset(name))) if known else ()


def takes_dataset(name: str) -> bool:
    """Return whether the table or figure uses a dataset instead of photographs."""
    table = tables.load_tables().get(name)
    return any(drawing.uses_queries for drawing in group_drawings()[name]) if table is None else table.dataset is not None


def _name_folder(images: Path | None, evaluation_set: EvaluationSet) -> str:
    if evaluation_set.dataset is not None:
        return evaluation_set.dataset.name()
    return "builtin" if images is None else name_images(images)


def _reproduce_figures(
    name: str,
    drawings: tuple[Drawing, ...],
    setting: Setting,
    evaluation_set: EvaluationSet,
    out: Path,
    engine: Engine,
    command: str,
) -> Reproduction:
    """Run the rows of the figures, and draw them into `out`/figures."""
    rows = {row.name: row for drawing in drawings for row in drawing.build_rows(setting)}
    result = run.run_rows(list(rows.values()), setting, evaluation_set, out, name, engine)
    data = FigureData(setting=setting, evaluation_set=evaluation_set, result=result, out=out)
    provenance = format_provenance(command, run.list_records(result))
    files = [file for drawing in drawings for file in _save_figures(drawing.name, drawing.draw(data), out, provenance)]
    return Reproduction(out=out, output=tuple(files), failed=run.count_failures(result))


def _save_figures(name: str, figures: Iterator[tuple[str, Figure]], out: Path, provenance: str) -> list[Text]:
    """Save figures in `out`/figures and return the paths of their files."""
    stems = ((out / FIGURES / f"{name}-{kind}".removesuffix("-").replace("/", "-"), figure) for kind, figure in figures)
    return [Text(str(file)) for stem, figure in stems for file in save(figure, stem, provenance)]


def list_materials() -> tuple[str, ...]:
    """Return the names of the files that a user can pass."""
    return tuple(field.name for field in dataclasses.fields(Materials))
