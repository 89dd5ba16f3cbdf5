"""The commands of docs/guarantee.md run, and its numbers are right."""

import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import bench
from bench import cli
from bench.audit.bounds import log_ratio
from bench.codebook.dictionary import Dictionary
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.mechanisms.composition import solve_epsilon
from bench.mechanisms.subset import log10_chance, most_accurate_size, most_informative_size, mutual_information
from defenses.ldp import LDP

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "guarantee.md").read_text(encoding="utf-8")
PROSE = " ".join(PAGE.split())  # without line breaks
COMMANDS = re.findall(r"^bench (.+)$", PAGE, re.MULTILINE)
MILLION = "audit --defense ldp:epsilon=2,subset_size=2 --words 64 --trials 1000000"


def test_all_commands_are_found() -> None:
    assert MILLION in COMMANDS
    assert len(COMMANDS) == PAGE.count("```\nbench ") == 6


@pytest.mark.parametrize(
    "command",
    [pytest.param(command, marks=pytest.mark.exhaustive if command == MILLION else pytest.mark.slow) for command in COMMANDS],
)
def test_commands_run(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    """The audit of a million trials takes some seconds, and finds ε between 1.94 and 2."""
    assert cli.main(shlex.split(command)) == 0
    shown = capfd.readouterr().out
    if command == MILLION:
        bound = float(re.search(r"ε is at least ([0-9.]+) with confidence 95%", shown)[1])  # type: ignore[index]
        assert 1.94 <= bound <= 2.00
        assert "tight" in shown


@pytest.mark.slow
def test_python_line_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = re.findall(r"```python\n(.*?)\n```", PAGE, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"bench": bench, "LDP": LDP, "features": draw_features(20)}
    exec(line, names)
    assert len(names["release"]) == 20  # type: ignore[arg-type]
    assert (tmp_path / "device.key").is_file()


def test_numbers() -> None:
    shipped: Dictionary = Public().dictionary("shipped")
    words = len(shipped)
    assert words == 256_000
    assert f"{math.exp(10):,.0f} times" in PROSE
    descriptor_epsilon = solve_epsilon(10.0, 1000)
    assert f"about {descriptor_epsilon:.3f} for each descriptor" in PROSE
    one_in = 2 / 10 ** log10_chance(descriptor_epsilon, words, 2)
    assert f"one released word in {round(one_in, -3):,.0f} is the true one" in PROSE
    assert f"**{most_informative_size(10.0, words)}** of 256,000 words" in PROSE
    assert f"**{most_accurate_size(10.0, words)}** words at the same point" in PROSE


def test_table_of_subset_sizes() -> None:
    """Checks the columns that do not rest on measurements."""
    rows = re.findall(r"^\| (\d+)[^|]*\| ([\d.]+) \| ([\d.]+) \|", PAGE, re.MULTILINE)
    assert [int(size) for size, _, _ in rows] == [
        1,
        2,
        4,
        8,
        most_accurate_size(6.534, 8000),
        16,
        most_informative_size(6.534, 8000),
    ]
    for size, chance, bits in rows:
        assert f"{10 ** log10_chance(6.534, 8000, int(size)):.3f}" == chance
        assert f"{mutual_information(6.534, 8000, np.array([int(size)]))[0] / math.log(2):.2f}" == bits


def test_measured_recalls_are_those_of_table_s1() -> None:
    header, _, *rows = re.findall(r"^\| .*", (DOCS / "results" / "tableS1.md").read_text(encoding="utf-8"), re.MULTILINE)
    names, *entries = ([entry.strip() for entry in re.split(r"(?<!\\)\|", row)[1:-1]] for row in (header, *rows))
    table = [dict(zip(names, row, strict=True)) for row in entries]
    recalls = {
        row["m"]: float(row["day_0.25m_2deg, ours"].split()[0]) / 100
        for row in table
        if row["our \\|K\\|"] == "8,000" and row["our ε"] == "6.534"
    }
    shown = re.findall(r"^\| (\d+)[^|]*\|(?: [\d.]+ \|){3} \**(0\.\d+)", PAGE, re.MULTILINE)
    assert {size: float(recall) for size, recall in shown} == pytest.approx(recalls)


def test_largest_bound_of_a_number_of_trials() -> None:
    """For a defense that always releases its word and never another; half of the trials are measured."""

    def compute_bound(trials: int) -> float:
        return float(log_ratio(trials // 2, trials // 2, 0, trials // 2, 0.95))

    for trials in (10**4, 10**6, 10**8):
        assert compute_bound(trials) == pytest.approx(math.log(trials) - 2, abs=0.01)
    assert compute_bound(160_000) == pytest.approx(10, abs=0.02)
    assert f"a million trials can show {compute_bound(10**6):.1f}" in PROSE
