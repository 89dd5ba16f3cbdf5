"""`bench reproduce NAME`: one table, or the figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.text import Text

from bench.errors import unknown
from bench.plugin import Asset, Extractor
from leaderboard.reproduce import figures, report, run, tables
from leaderboard.reproduce.drawing import Scene, save
from leaderboard.reproduce.profiles import Materials, Setting, profile
from leaderboard.reproduce.run import Photographs

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
    extractor: Extractor,
    seed: int,
    out: Path | None,
    materials: Mapping[str, str],
) -> Done:
    """Rebuild the table `name` at the profile `size`, and write it.

    Tables that share `out` share their records.

    Raises
    ------
    UserError
        if a name is misspelt, or a file is missing or does not fit; nothing has been written then.
    """
    known = tables.everything()
    if name not in (FIGURES, *known):
        raise unknown("table", name, [FIGURES, *known])
    sizes = profile(size)
    chosen = run.choose(images, sizes, sizes.pictures if name == FIGURES else sizes.photographs)
    setting = Setting(
        profile=sizes,
        materials=Materials(**{field: Asset(file) for field, file in materials.items()}),
        extractor=extractor,
        photographs=len(chosen.chosen),
        seed=seed,
    )
    folder = out or Path("runs") / f"reproduce-{sizes.name}-{'builtin' if images is None else images.resolve().name}"
    if name == FIGURES:
        return _figures(setting, chosen, folder)
    rebuilt = run.rebuild(known[name], setting, chosen, folder)
    report.write(rebuilt, folder)
    return Done(out=folder, shown=tuple(report.to_rich(rebuilt)), failed=run.failures(rebuilt.ran))


def _figures(setting: Setting, chosen: Photographs, out: Path) -> Done:
    """Run the rows of all figures, and draw them into `out`/reproduced."""
    drawings = figures.everything()
    left_out = {drawing.name: reason for drawing in drawings if (reason := drawing.left_out())}
    rows = {row.name: row for drawing in drawings if drawing.name not in left_out for row in drawing.rows(setting)}
    ran = run.execute(list(rows.values()), setting, chosen.chosen, out, FIGURES)
    scene = Scene(setting=setting, photographs=chosen, ran=ran, out=out)
    shown = [Text(f"left out: {name}: {reason}") for name, reason in left_out.items()]
    for drawing in drawings:
        if drawing.name not in left_out:
            for kind, figure in drawing.draw(scene):
                files = save(figure, out / FIGURES / f"{drawing.name}-{kind}".removesuffix("-"))
                shown += [Text(str(file)) for file in files]
    return Done(out=out, shown=tuple(shown), failed=run.failures(ran))


def materials() -> tuple[str, ...]:
    """The names of the files that a user may give."""
    return tuple(field.name for field in dataclasses.fields(Materials))
