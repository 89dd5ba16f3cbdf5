"""The table of results in the README is the one that `make demo` prints, and the README is short."""

import re
import shlex
from pathlib import Path

import pytest

from bench import cli

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TOLERANCE = {"MAE": 0.002, "SSIM": 0.005, "PSNR": 0.1}  # between machines: float32 or bf16

Row = dict[str, str]


def read_table(text: str) -> list[Row]:
    """Return the rows of the first Markdown table by column. Defenses are without their settings' defaults."""
    lines = [[text.strip() for text in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    rows = [dict(zip(lines[0], line, strict=True)) for line in lines[2:]]
    return [row | {"defense": row["defense"].removesuffix(":sends=positions")} for row in rows]


def list_differences(printed: list[Row], reported: list[Row]) -> list[str]:
    """Return the entries of the README that are not those of the report."""
    differences = ["another number of rows"] if len(printed) != len(reported) else []
    for row, other in zip(printed, reported, strict=False):
        for column, text in row.items():
            tolerance = TOLERANCE.get(column)
            same = text == other[column] if tolerance is None else abs(float(text) - float(other[column])) <= tolerance
            differences += [] if same else [f"{row['defense']}, {row['attack']}: {column} {text}, reported {other[column]}"]
    return differences


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 150


@pytest.mark.exhaustive
def test_results_are_those_of_the_demo(tmp_path: Path) -> None:
    options = re.search(r"^DEMO \?= (.+)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert options is not None
    assert cli.main(["run", *shlex.split(options[1]), "--out", str(tmp_path / "run")]) == 0
    reported = read_table((tmp_path / "run" / "report.md").read_text(encoding="utf-8"))
    printed = read_table(README[README.index("## Results") :])
    assert list_differences(printed, reported) == []
    assert len(printed) == 8


def test_other_results_are_found() -> None:
    printed = read_table(README[README.index("## Results") :])
    assert list_differences(printed, printed) == []
    assert list_differences(printed, [printed[0] | {"SSIM": "0.6"}, *printed[1:]]) == ["none, dia: SSIM 0.6771, reported 0.6"]
    assert list_differences(printed, [printed[0] | {"attack": "nearest"}, *printed[1:]]) == [
        "none, dia: attack dia, reported nearest"
    ]
    assert list_differences(printed, printed[1:])[0] == "another number of rows"
