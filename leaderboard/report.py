"""Writes what people read of a run: report.md, report.csv, and a figure for each unit of which an image was made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench import units
from bench.errors import UnitError
from bench.records import Record
from bench.rundir import picture
from bench.units import Unit
from leaderboard import figures, tables


def write(records: Sequence[Record], judged: Sequence[Unit], out: Path) -> None:
    """Write the report of `records` into the folder `out`, which keeps their reconstructions.

    Raises
    ------
    OSError
        if it cannot be written.
    """
    found = tables.tables(records)
    (out / "report.md").write_text("\n".join(map(tables.to_markdown, found)), encoding="utf-8", errors="replace")
    (out / "report.csv").write_text(tables.to_csv(found), encoding="utf-8", errors="replace")
    for unit in judged:
        of_it = [record for record in records if record["unit"] == unit.name]
        if any(picture(out, record).is_file() for record in of_it):
            _figure(unit, of_it, out)


def _figure(unit: Unit, records: Sequence[Record], out: Path) -> None:
    try:
        original = units.read(unit.images[0])[0]
    except UnitError:
        return  # it has gone since
    path = out / "figures" / f"{unit.name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    shown = figures.panels(original, records, [picture(out, record) for record in records])
    # Without the software's version, the same run gives the same file.
    figures.draw(shown, f"{unit.name}. {tables.SEEDED}").savefig(path, metadata={"Software": None})
