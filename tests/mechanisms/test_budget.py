"""Division of a photograph's ε among its descriptors, and the command `bench budget`."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import cli
from bench.core.errors import UserError
from bench.mechanisms.budget import compute_yields, divide_budget, select_nearest_records
from bench.mechanisms.composition import compose_basic, compose_optimal
from bench.mechanisms.subset import draw_word_subsets


def test_descriptors_compose_to_the_budget() -> None:
    plan = divide_budget(10.0, 800, 3, 256_000)
    assert plan.basic_epsilon == pytest.approx(10 / 2400)
    assert compose_basic(plan.basic_epsilon, 2400) == pytest.approx(10)
    assert compose_optimal(plan.optimal_epsilon, 2400) == pytest.approx(10)
    assert plan.epsilon == plan.optimal_epsilon > plan.basic_epsilon
    # If each answer has a large ε, a small δ does not reduce the total.
    assert divide_budget(8000.0, 800, 1, 256_000).epsilon == pytest.approx(10.0, rel=1e-6)


@pytest.mark.slow
def test_yields_are_those_of_the_mechanism() -> None:
    plan = divide_budget(8000.0, 800, 1, 1000)
    assert [row.size for row in compute_yields(plan)] == [1, 2, 4]  # at ε = 10 and 1000 words, one is the best size
    plan = divide_budget(compose_optimal(3.0, 800), 800, 1, 1000)
    rows = {row.size: row for row in compute_yields(plan)}
    assert set(rows) == {1, 2, 4, 47, 113}  # 1000 / (e³ + 1), and where mutual information is greatest
    rng = np.random.default_rng(0)
    true = rng.integers(1000, size=50_000)
    for size, row in rows.items():
        rate = (draw_word_subsets(true, 1000, 3.0, size, rng) == true[:, None]).any(axis=1).mean()
        assert row.inclusion == pytest.approx(rate, abs=0.01)
        assert row.true_words == pytest.approx(800 * rate, abs=8)
    assert max(rows.values(), key=lambda row: row.bits).size == 113


def test_records_of_the_nearest_epsilon() -> None:
    def record(epsilon: float | str | None) -> dict[str, Any]:
        return {"privacy": {"epsilon_descriptor": epsilon}}

    records = [record(epsilon) for epsilon in (None, 8.0, 10.0, 8.0, "inf", 0.0)]
    assert select_nearest_records(records, 8.9) == [record(8.0)] * 2
    assert select_nearest_records(records, 0.1) == [record(0.0)]
    with pytest.raises(UserError, match="no record claims an epsilon"):
        select_nearest_records([record(None)], 1.0)


@pytest.mark.parametrize(
    ("numbers", "complaint"),
    [
        ((-1.0, 10, 1, 100), "--image-epsilon: must be at least 0"),
        ((math.nan, 10, 1, 100), "--image-epsilon: must be at least 0"),
        ((1.0, 0, 1, 100), "--keypoints and --releases must be at least 1, got 0 and 1"),
        ((1.0, 10, 0, 100), "--keypoints and --releases must be at least 1, got 10 and 0"),
        ((1.0, 10, 1, 1), "--words: must be at least 2, got 1"),
    ],
)
def test_invalid_arguments_are_refused(numbers: Any, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        divide_budget(*numbers)


def run(capfd: pytest.CaptureFixture[str], *arguments: Any) -> tuple[int, str, str]:
    status = cli.main(["budget", *map(str, arguments)])
    return status, *capfd.readouterr()


def test_the_command(capfd: pytest.CaptureFixture[str]) -> None:
    status, shown, _ = run(capfd, "--image-epsilon", "10", "--keypoints", 1000, "--words", 256_000)
    assert status == 0
    assert "basic composition leaves ε = 0.01 for a descriptor" in shown
    left = float(re.search(r"δ = 1e-06 leaves ε = ([0-9.]+)", shown)[1])  # type: ignore[index]
    assert compose_optimal(left, 1000) == pytest.approx(10, rel=1e-3)
    assert "not covered: the keypoints' positions, the number of keypoints" in shown
    assert run(capfd, "--image-epsilon", "1/0")[0] == 2
    assert run(capfd)[2] == "bench: --image-epsilon is missing (see bench budget --help)\n"
    assert run(capfd, "--image-epsilon", 0, "--words", 10)[0] == 0


def test_results_of_the_nearest_epsilon(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from record_lines import record

    privacy, metrics = record()["privacy"], record()["metrics"]
    lines = [
        record(run_hash=str(e), privacy=privacy | {"epsilon_descriptor": e}, metrics=metrics | {"ssim": ssim})
        for e, ssim in ((8.0, 0.5), (16.0, 0.777))
    ]
    (tmp_path / "records.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    arguments = ("--image-epsilon", 14_000, "--keypoints", 1000, "--words", 1000, "--results", tmp_path)
    status, shown, _ = run(capfd, *arguments)
    assert status == 0
    assert "0.777" in shown
    assert "Nearest measured setting: ε = 16" in shown
    assert "0.777" not in run(capfd, "--image-epsilon", 10, *arguments[2:])[1]
    assert run(capfd, *arguments[:-1], tmp_path / "none")[0] == 2
