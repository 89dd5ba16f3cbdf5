"""Writes the report of a run: report.md, report.csv, and a figure for each sample with a reconstruction."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from bench.core.table import Table, to_csv, to_markdown
from bench.runner import attack_suite
from bench.runner.directory import figure_path, photograph_path, reconstruction_path
from bench.runner.records import Record
from leaderboard import figures, tables
from leaderboard.provenance import CHUNK, format_provenance


def write(records: Sequence[Record], out: Path, command: str) -> None:
    """Write the report of `records` into the folder `out`, which holds their photographs and reconstructions.

    The figures hold `command`, the command line that ran them, in their provenance.

    Raises
    ------
    OSError
        if a file cannot be written.
    """
    report = tables.build_tables(records)
    markdown = "\n".join([*(to_markdown(table, plain=True) for table in report), *map(to_markdown, build_suite_tables(records))])
    (out / "report.md").write_text(markdown, encoding="utf-8", errors="replace")
    (out / "report.csv").write_text(to_csv(*report), encoding="utf-8", errors="replace")
    provenance = format_provenance(command, records)
    by_sample: dict[str, list[Record]] = {}
    for record in records:
        by_sample.setdefault(record["sample"], []).append(record)
    for sample, sample_records in by_sample.items():
        if any(os.path.isfile(reconstruction_path(out, record)) for record in sample_records):
            _write_figure(sample, sample_records, out, provenance)


def build_suite_tables(records: Sequence[Record], *, brief: bool = False) -> list[Table]:
    """Return the worst cases over the suites of attacks that were run, one table for each comparison group."""
    names = {record["attack"]["name"] for record in records if record["attack"]}
    if not any(attack_suite.find(suite).names <= names for suite in attack_suite.list_attack_suites()):
        return []
    from leaderboard.suite_table import build_run_tables  # expensive: imports scipy

    return build_run_tables(records, brief=brief)


def _write_figure(sample: str, records: Sequence[Record], out: Path, provenance: str) -> None:
    photograph, figure = photograph_path(out, records[0]), figure_path(out, sample)
    if not os.path.isfile(photograph):
        return  # it was removed since, or the system refused its path
    figure.parent.mkdir(parents=True, exist_ok=True)
    original = np.asarray(Image.open(photograph))
    panels = figures.build_panels(original, records, [reconstruction_path(out, record) for record in records])
    metadata = PngInfo()
    metadata.add_text(CHUNK, provenance)
    figures.draw_picture(panels, f"{sample}. {tables.SEED_REMARK}").save(figure, pnginfo=metadata, compress_level=2)
