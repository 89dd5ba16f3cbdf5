"""`bench reproduce NAME`: one table, or the figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.text import Text

from bench import engines, threads
from bench.engines import Engine
from bench.errors import UserError, unknown
from bench.plugin import Asset, Dataset, Extractor
from leaderboard.reproduce import figures, report, run, tables
from leaderboard.reproduce.drawing import Drawing, Scene, save
from leaderboard.reproduce.profiles import Materials, Setting, profile
from leaderboard.reproduce.run import Judged

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
    extractor: Extractor,
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
        raise unknown("table", name, [*known, *drawings])
    sizes = profile(size)
    of_place = name in of_places()
    if of_place and images is not None:
        raise UserError(f"{name} is about a place: name it with --dataset, and give no --images")
    if not of_place and dataset is not None:
        raise UserError(f"{name} is about photographs: name them with --images, and give no --dataset")
    if of_place:
        judged = run.queries(dataset or (sizes.place if name in known else sizes.pictured))
    else:
        judged = run.choose(images, sizes, sizes.pictures if name == FIGURES else sizes.photographs)
    setting = Setting(
        profile=sizes,
        materials=Materials(**{field: Asset(file) for field, file in materials.items()}),
        extractor=extractor,
        photographs=len(judged.chosen),
        seed=seed,
    )
    folder = out or Path("runs") / f"reproduce-{sizes.name}-{_named(images, judged)}"
    engine = engines.choose(workers or (threads.cores() if of_place else 1))
    if name in drawings:
        return _figures(name, drawings[name], setting, judged, folder, engine)
    rebuilt = run.rebuild(known[name], setting, judged, folder, engine)
    report.write(rebuilt, folder)
    return Done(out=folder, shown=tuple(report.to_rich(rebuilt)), failed=run.failures(rebuilt.ran))


def drawn_by() -> dict[str, tuple[Drawing, ...]]:
    """The figures that each name of the command stands for: all of photographs for one, and each of a place for itself."""
    everything = figures.everything()
    of_place = {f"figure-{drawing.name}": (drawing,) for drawing in everything if drawing.place}
    return {FIGURES: tuple(drawing for drawing in everything if not drawing.place), **of_place}


def of_places() -> set[str]:
    """What of the command is about the queries of a place."""
    drawings = {name for name, drawn in drawn_by().items() if any(drawing.place for drawing in drawn)}
    return drawings | {name for name, table in tables.everything().items() if table.place}


def _named(images: Path | None, judged: Judged) -> str:
    if judged.dataset is not None:
        return judged.dataset.name()
    return "builtin" if images is None else images.resolve().name


def _figures(name: str, drawings: tuple[Drawing, ...], setting: Setting, judged: Judged, out: Path, engine: Engine) -> Done:
    """Run the rows of these figures, and draw them into `out`/figures."""
    rows = {row.name: row for drawing in drawings for row in drawing.rows(setting)}
    ran = run.execute(list(rows.values()), setting, judged, out, name, engine)
    scene = Scene(setting=setting, judged=judged, ran=ran, out=out)
    shown = []
    for drawing in drawings:
        for kind, figure in drawing.draw(scene):
            files = save(figure, out / FIGURES / f"{drawing.name}-{kind}".removesuffix("-").replace("/", "-"))
            shown += [Text(str(file)) for file in files]
    return Done(out=out, shown=tuple(shown), failed=run.failures(ran))


def materials() -> tuple[str, ...]:
    """The names of the files that a user may give."""
    return tuple(field.name for field in dataclasses.fields(Materials))
