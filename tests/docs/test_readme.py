"""The table of the README is the one that `make demo` prints, and its defense releases what the text says."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from sessions import list_blocks

from bench import cli
from bench.codebook import examples
from bench.codebook.public import Public
from bench.registry import discovery
from leaderboard.signal import BASELINES

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TOLERANCE = {"SSIM": 0.005, "PSNR": 0.1, "identified (chance 0.024)": 0.05}  # between machines: float32 or bf16

Row = dict[str, str]


def read_table(text: str) -> list[Row]:
    """Return the rows of the first Markdown table by column. Defenses are without their settings' defaults."""
    lines = [[text.strip() for text in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    rows = [dict(zip(lines[0], line, strict=True)) for line in lines[2:]]
    return [row | {"defense": row["defense"].removesuffix(":sends=positions")} for row in rows]


def list_differences(printed: list[Row], reported: list[Row]) -> list[str]:
    """Return the entries of the README that are not those of the report."""
    differences = []
    rows = {(row["defense"], row["attack"]): row for row in reported}
    for row in printed:
        other = rows.get((row["defense"], row["attack"]), {})
        for column, text in row.items():
            expected, tolerance = other.get(column, "nothing"), TOLERANCE.get(column)
            same = text == expected if tolerance is None or not other else abs(float(text) - float(expected)) <= tolerance
            differences += [] if same else [f"{row['defense']}, {row['attack']}: {column} {text}, reported {expected}"]
    return differences


@pytest.mark.exhaustive
def test_results_are_those_of_the_demo(tmp_path: Path) -> None:
    options = re.search(r"^DEMO \?= (.+)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert options is not None
    assert cli.main(["run", *shlex.split(options[1]), "--out", str(tmp_path / "run")]) == 0
    reported = read_table((tmp_path / "run" / "report.md").read_text(encoding="utf-8"))
    printed = read_table(README[README.index("## Results") :])
    assert list_differences(printed, reported) == []
    assert len(printed) == 7


def list_options(page: str) -> set[tuple[str, str]]:
    """Return the options of the first command of a page that runs XFeat, without those for its folders."""
    command = re.search(r"^bench run (.*--extractor xfeat(?:.*\\\n)*.*)$", page, re.MULTILINE)
    assert command is not None
    words = shlex.split(command[1].replace("\\\n", ""))
    return {(option, value) for option, value in zip(words[::2], words[1::2], strict=True) if option not in ("--images", "--out")}


def test_the_command_of_xfeat_has_the_baselines() -> None:
    """So that its report tests for a signal. It is also that of the page of learned features."""
    options = list_options(README)
    assert options == list_options((ROOT / "docs" / "features.md").read_text(encoding="utf-8"))
    assert {("--attack", baseline) for baseline in BASELINES} < options
    assert list_options(README.replace("--attack blank --images photos/ --out runs/xfeat", "--out x")) < options  # control


def test_other_results_are_found() -> None:
    printed = read_table(README[README.index("## Results") :])
    assert list_differences(printed, printed) == []
    for column, text in {"SSIM": "0.6", "note": "no signal"}.items():
        (difference,) = list_differences([printed[0] | {column: text}], printed)
        assert difference == f"none, dia: {column} {text}, reported {printed[0][column]}"
    assert len(list_differences(printed[:1], printed[1:])) == len(printed[0])


def test_the_defense_of_the_readme_rounds_components(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = next(block.text for block in list_blocks(README) if "class Rounding" in block.text)
    (tmp_path / "rounding.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    import rounding

    plugin = discovery.check(discovery.DEFENSE, rounding.PLUGIN)
    secret = examples.draw_features(20, 0)
    release = plugin(levels=4).protect(secret, Public(), np.random.default_rng(0))
    assert set(np.unique(release.descriptors * 4)) <= {0, 1, 2, 3, 4}
