"""The tables that the paper prints (Pittaluga and Zhuang, ICCV 2023, with its supplement), read from CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

FOLDER = Path(__file__).parent / "paper"


def read_rows(name: str) -> list[dict[str, str]]:
    """Return the rows of the table in the file `name`.csv, as text by column."""
    with (FOLDER / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def parse_numbers(row: Mapping[str, str], columns: Iterable[str]) -> dict[str, float]:
    """Return these columns of a row as numbers."""
    return {column: float(row[column]) for column in columns}
