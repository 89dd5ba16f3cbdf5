"""`bench reproduce NAME`: one table, or the figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from bench.api import Asset, Dataset, Extractor
from bench.core import threads
from bench.core.errors import UserError, unknown_name
from bench.extractors.sift import Sift
from bench.runner import engines
from bench.runner.engines import Engine
from leaderboard import localization_results
from leaderboard.reproduce import figures, page, run, tables
from leaderboard.reproduce.drawing import Drawing, Scene, save
from leaderboard.reproduce.profiles import Materials, Setting, profile
from leaderboard.reproduce.run import Judged

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = "figures"


@dataclass(frozen=True, kw_only=True, eq=False)
class Done:
    """What was written, what a terminal shows of it, and how many photographs failed."""

    out: Path
    shown: tuple[object, ...]  # for rich
    failed: int


def reproduce(
    name: str,
    size: str,
    *,
    images: Path | None,
    dataset: Dataset | None,
    extractor: Extractor | None,
    seed: int,
    out: Path | None,
    workers: int | None,
    materials: Mapping[str, str],
) -> Done:
    """Rebuild the table `name` at the profile `size`, and write it.

    Tables that share `out` share their records.

    Raises
    ------
    UserError
        if a name is misspelt, or a file is missing or does not fit; nothing has been written then.
    """
    known, drawings = tables.everything(), drawn_by()
    if name not in {**known, **drawings}:
        raise unknown_name("table", name, [*known, *drawings])
    sizes, table = profile(size), known.get(name)
    of_place = name in of_places()
    if of_place and images is not None:
        raise UserError(f"{name} is about a place: name it with --dataset, and give no --images")
    if not of_place and dataset is not None:
        raise UserError(f"{name} is about photographs: name them with --images, and give no --dataset")
    if of_place:
        judged = run.queries(dataset or (table.place(sizes) if table and table.place else sizes.pictured))
    else:
        judged = run.choose(images, sizes, sizes.pictures if name == FIGURES else sizes.photographs)
    setting = Setting(
        profile=sizes,
        materials=Materials(**{field: Asset(file) for field, file in materials.items()}),
        extractor=extractor or (table.extractor(sizes) if table else Sift()),
        photographs=len(judged.chosen),
        seed=seed,
    )
    folder = out or Path("runs") / f"reproduce-{sizes.name}-{_named(images, judged)}"
    engine = engines.choose_engine(workers or (threads.cores() if of_place else 1))
    if table is None:
        return _figures(name, drawings[name], setting, judged, folder, engine)
    rebuilt = run.rebuild(table, setting, judged, folder, engine)
    page.write(rebuilt, folder)
    scene = Scene(setting=setting, judged=judged, ran=rebuilt.ran, out=folder)
    every = (record for records in rebuilt.ran.records.values() for record in records)
    files = [Text(line) for line in localization_results.write(every, folder)]
    files += [] if table.draw is None else _drawn(name, table.draw(scene), folder)
    return Done(out=folder, shown=(*page.to_rich(rebuilt), *files), failed=run.failures(rebuilt.ran))


def drawn_by() -> dict[str, tuple[Drawing, ...]]:
    """The figures that each name of the command stands for: all of photographs for one, and each of a place for itself."""
    everything = figures.everything()
    of_place = {f"figure-{drawing.name}": (drawing,) for drawing in everything if drawing.place}
    return {FIGURES: tuple(drawing for drawing in everything if not drawing.place), **of_place}


def of_places() -> set[str]:
    """What of the command is about the queries of a place."""
    drawings = {name for name, drawn in drawn_by().items() if any(drawing.place for drawing in drawn)}
    return drawings | {name for name, table in tables.everything().items() if table.place is not None}


def _named(images: Path | None, judged: Judged) -> str:
    if judged.dataset is not None:
        return judged.dataset.name()
    return "builtin" if images is None else images.resolve().name


def _figures(name: str, drawings: tuple[Drawing, ...], setting: Setting, judged: Judged, out: Path, engine: Engine) -> Done:
    """Run the rows of these figures, and draw them into `out`/figures."""
    rows = {row.name: row for drawing in drawings for row in drawing.rows(setting)}
    ran = run.execute(list(rows.values()), setting, judged, out, name, engine)
    scene = Scene(setting=setting, judged=judged, ran=ran, out=out)
    shown = [file for drawing in drawings for file in _drawn(drawing.name, drawing.draw(scene), out)]
    return Done(out=out, shown=tuple(shown), failed=run.failures(ran))


def _drawn(name: str, drawn: Iterator[tuple[str, Figure]], out: Path) -> list[Text]:
    """Save figures in `out`/figures. -> the paths of their files"""
    stems = ((out / FIGURES / f"{name}-{kind}".removesuffix("-").replace("/", "-"), figure) for kind, figure in drawn)
    return [Text(str(file)) for stem, figure in stems for file in save(figure, stem)]


def materials() -> tuple[str, ...]:
    """The names of the files that a user may give."""
    return tuple(field.name for field in dataclasses.fields(Materials))
