"""Writes the report of a run: report.md, report.csv, and a figure for each sample with a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from bench.core.errors import SampleError
from bench.core.table import to_csv, to_markdown
from bench.images import samples
from bench.images.samples import Sample
from bench.runner.directory import reconstruction_path
from bench.runner.records import Record
from leaderboard import figures, tables


def write(records: Sequence[Record], run_samples: Sequence[Sample], out: Path) -> None:
    """Write the report of `records` into the folder `out`, which holds their reconstructions, and the photographs beside them.

    Raises
    ------
    OSError
        if it cannot be written.
    """
    report = tables.build_tables(records)
    markdown = "\n".join(to_markdown(table, plain=True) for table in report)
    (out / "report.md").write_text(markdown, encoding="utf-8", errors="replace")
    (out / "report.csv").write_text(to_csv(*report), encoding="utf-8", errors="replace")
    for sample in run_samples:
        sample_records = [record for record in records if record["sample"] == sample.name]
        if any(reconstruction_path(out, record).is_file() for record in sample_records):
            _write_figure(sample, sample_records, out)


def photograph_path(out: Path, record: Record) -> Path:
    """Return the path of a record's photograph as the attacked features saw it; by content, as datasets may share names."""
    content = record["dataset"]["hash"].removeprefix("sha256:")[:16]
    return out / "photographs" / content / f"{record['sample']}.png"


def _write_figure(sample: Sample, records: Sequence[Record], out: Path) -> None:
    try:
        original = samples.read_pixels(sample.images[0])[0]
    except SampleError:
        return  # the file was removed since
    photograph, figure = photograph_path(out, records[0]), out / "figures" / f"{sample.name}.png"
    for path in (photograph, figure):
        path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(original).save(photograph)
    panels = figures.build_panels(original, records, [reconstruction_path(out, record) for record in records])
    # Without the software's version, the same run gives the same file.
    figures.draw(panels, f"{sample.name}. {tables.SEED_REMARK}").savefig(figure, metadata={"Software": None})
