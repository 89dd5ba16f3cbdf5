"""Writes what people read of a run: report.md, report.csv, and a figure for each unit of which an image was made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from bench.core.errors import SampleError
from bench.images import samples
from bench.images.samples import Sample
from bench.runner.directory import reconstruction_path
from bench.runner.records import Record
from leaderboard import figures, tables


def write(records: Sequence[Record], judged: Sequence[Sample], out: Path) -> None:
    """Write the report of `records` into the folder `out`, which keeps their reconstructions and then the photographs, too.

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
        if any(reconstruction_path(out, record).is_file() for record in of_it):
            _figure(unit, of_it, out)


def photograph(out: Path, record: Record) -> Path:
    """Where the photograph of a record is kept, as the attacked features saw it; by content, as datasets may share names."""
    content = record["dataset"]["hash"].removeprefix("sha256:")[:16]
    return out / "photographs" / content / f"{record['unit']}.png"


def _figure(unit: Sample, records: Sequence[Record], out: Path) -> None:
    try:
        original = samples.read_pixels(unit.images[0])[0]
    except SampleError:
        return  # it has gone since
    kept, path = photograph(out, records[0]), out / "figures" / f"{unit.name}.png"
    for folder in (kept.parent, path.parent):
        folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(original).save(kept)
    shown = figures.panels(original, records, [reconstruction_path(out, record) for record in records])
    # Without the software's version, the same run gives the same file.
    figures.draw(shown, f"{unit.name}. {tables.SEEDED}").savefig(path, metadata={"Software": None})
