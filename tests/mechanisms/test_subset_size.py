"""Choice of the subset size: the model against enumeration and simulation; and the command `bench subset-size`."""

import json
import math
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from bench import cli
from bench.core.errors import UserError
from bench.mechanisms.subset import draw_word_subsets, most_informative_size
from bench.mechanisms.subset_size import (
    SAMPLE,
    Workload,
    collect_recalls,
    compute_sample_chance,
    compute_selection_chance,
    estimate_sizes,
    estimate_success,
)


def test_matches_against_enumeration() -> None:
    """Of a dictionary of 6 words and one keypoint, over all sets and all words of the other points."""
    domain, size, epsilon, points = 6, 2, 1.5, 3
    total = size * math.exp(epsilon) + domain - size
    right = wrong = 0.0
    for Z in combinations(range(domain), size):
        chance = domain * (math.exp(epsilon) if 0 in Z else 1.0) / total / math.comb(domain, size)  # word 0 is the true one
        right += chance * (0 in Z)
        wrong += chance * points * len(Z) / domain  # a point is equally likely to have any word
    (found,) = estimate_sizes(epsilon, domain, [size], Workload(keypoints=1, repeatability=[1.0], points=points))
    assert found.right == pytest.approx(right, rel=1e-12) == pytest.approx(found.inclusion, rel=1e-12)
    assert found.wrong == pytest.approx(wrong, rel=1e-12)


def test_information_is_that_of_the_enumeration() -> None:
    """Σ_Z,v Pr(v) Pr(Z | v) ln(Pr(Z | v) / Pr(Z)), all Z being equally likely."""
    domain, epsilon = 6, 1.5
    information = []
    for size in range(1, domain):
        total = size * math.exp(epsilon) + domain - size
        bits = 0.0
        for Z in combinations(range(domain), size):
            for v in range(domain):
                relative = domain * (math.exp(epsilon) if v in Z else 1.0) / total  # Pr(Z | v) / Pr(Z)
                bits += relative * math.log2(relative) / domain / math.comb(domain, size)
        information.append(bits)
    found = estimate_sizes(epsilon, domain, range(1, domain), Workload())
    assert [row.bits for row in found] == pytest.approx(information, rel=1e-9)
    assert max(found, key=lambda row: row.bits).size == most_informative_size(epsilon, domain)


def test_samples_against_enumeration() -> None:
    for right, wrong in ((3, 2), (5, 4), (2, 6), (4, 0)):
        samples = list(combinations(range(right + wrong), SAMPLE))
        fraction = np.mean([max(sample) < right for sample in samples])  # matches are numbered, the right ones first
        expected = 1 - (1 - fraction) ** 7
        assert compute_sample_chance(np.array([right]), wrong, 7)[0] == pytest.approx(expected, abs=1e-12)


def simulate_success(n: int, inclusion: float, wrong: int, trials: int, agreement: float, runs: int = 4000) -> float:
    """Return the success rate of RANSAC on matches that are right or wrong, simulated trial by trial."""
    rng = np.random.default_rng([n, wrong, trials])
    found = 0
    for _ in range(runs):
        right = rng.binomial(n, inclusion)
        if right + wrong < SAMPLE:
            continue
        samples = np.array([rng.choice(right + wrong, SAMPLE, replace=False) for _ in range(trials)])
        best_wrong = SAMPLE + rng.poisson(wrong * agreement, trials).max()
        found += bool((samples < right).all(axis=1).any()) and right > best_wrong
    return found / runs


@pytest.mark.parametrize(
    ("n", "inclusion", "wrong", "trials", "agreement"), [(20, 0.3, 10, 8, 0.02), (12, 0.5, 3, 5, 0.1), (30, 0.2, 25, 20, 0.0)]
)
def test_success_against_simulation(n: int, inclusion: float, wrong: int, trials: int, agreement: float) -> None:
    runs = 1500
    expected = estimate_success(n, inclusion, wrong, trials, agreement)
    fraction = simulate_success(n, inclusion, wrong, trials, agreement, runs)
    assert 0.05 < expected < 0.95
    assert stats.binomtest(round(fraction * runs), runs, expected).pvalue > 1e-3


@pytest.mark.slow
def test_control_half_of_the_model_fails() -> None:
    n, inclusion, wrong, trials, agreement, runs = 20, 0.5, 30, 25, 0.1, 1500
    hits = round(simulate_success(n, inclusion, wrong, trials, agreement, runs) * runs)
    assert stats.binomtest(hits, runs, estimate_success(n, inclusion, wrong, trials, agreement)).pvalue > 1e-3
    right = np.arange(n + 1)
    for half in (compute_sample_chance(right, wrong, trials), compute_selection_chance(right, wrong, trials, agreement)):
        assert stats.binomtest(hits, runs, float(stats.binom.pmf(right, n, inclusion) @ half)).pvalue < 1e-9


def test_inclusion_is_that_of_the_mechanism() -> None:
    rng = np.random.default_rng(0)
    true = rng.integers(500, size=50_000)
    for row in estimate_sizes(3.0, 500, [1, 3, 20], Workload()):
        fraction = (draw_word_subsets(true, 500, 3.0, row.size, rng) == true[:, None]).any(axis=1).mean()
        assert row.inclusion == pytest.approx(fraction, abs=0.01)


def test_criteria_disagree() -> None:
    """At the paper's scaled |K|, one criterion selects few words and the other many."""
    rows = estimate_sizes(6.534, 8000, [1, 2, 4, 8, 16, 65], Workload())
    assert max(rows, key=lambda row: row.bits).size == 65
    assert max(rows, key=lambda row: row.success).size <= 2
    # With few keypoints, one word each gives too few right matches to stand out from chance.
    few = estimate_sizes(6.534, 8000, [1, 2, 4, 8, 16], Workload(keypoints=150))
    assert max(few, key=lambda row: row.success).size > 2
    several = estimate_sizes(6.534, 8000, [2], Workload(repeatability=[0.1, 0.5]))[0]
    each = [estimate_sizes(6.534, 8000, [2], Workload(repeatability=[fraction]))[0].success for fraction in (0.1, 0.5)]
    assert several.success == pytest.approx(np.mean(each))


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ((math.inf, 10, [1]), "--epsilon: must be at least 0 and finite"),
        ((1.0, 1, [1]), "--words: must be at least 2, got 1"),
        ((1.0, 10, [10]), "less than the dictionary's 10"),
        ((1.0, 10, []), "--sizes"),
    ],
)
def test_invalid_arguments_are_refused(given: Any, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        estimate_sizes(*given, Workload())
    with pytest.raises(UserError, match="must be from 0 to 1"):
        estimate_sizes(1.0, 10, [1], Workload(repeatability=[2.0]))


def record(size: int, epsilon: float | str, **changed: Any) -> dict[str, Any]:
    return {
        "task": "localization",
        "status": "ok",
        "condition": "day",
        "defense": {"name": "ldp", "words": 100, "subset_size": size, "epsilon": epsilon},
        "task_settings": {"matcher": "auto", "retrieval": "raw", "trials": 30_000},
        "metrics": {"recall_0.25m_2deg": float(size > 1), "inliers": 30.0, "keypoints": 120},
    } | changed


def test_collected_recalls() -> None:
    records = [record(1, 2.0), record(2, 2.0004), record(2, 2.0), record(1, "inf"), record(2, "inf"), record(4, 3.0)]
    records += [record(2, 2.0, condition="night"), record(2, 2.0, status="failed"), record(2, 2.0, task_settings={"trials": 5})]
    assert collect_recalls(records, 2.0, 100, 30_000, "day") == ({1: [0.0], 2: [1.0, 1.0]}, [0.25])
    thirds = [record(2, "1/3"), record(2, "much"), {**record(2, "1/3"), "metrics": {}}, record(1, "inf", metrics={"inliers": 3})]
    assert collect_recalls([*thirds], 1 / 3, 100, 30_000, "day") == ({2: [1.0]}, [])
    with pytest.raises(UserError, match="no localization with ldp:epsilon=2 or inf, words=99"):
        collect_recalls(records, 2.0, 99, 30_000, "day")


def run(capfd: pytest.CaptureFixture[str], *arguments: Any) -> tuple[int, str, str]:
    status = cli.main(["subset-size", *map(str, arguments)])
    return status, *capfd.readouterr()


def test_the_command(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    status, shown, _ = run(capfd, "--epsilon", "6.534", "--words", 8000)
    assert status == 0
    assert [line.split()[1] for line in shown.splitlines() if line.startswith("│")] == ["1", "2", "4", "8", "12", "16", "65"]
    assert "most information about its word: m = 65" in " ".join(shown.split())
    assert "most accurate word frequencies: m = 12" in " ".join(shown.split())
    from record_lines import record as whole

    lines = [whole(**record(size, 2.0), run_hash=f"{size}") for size in (1, 2)] + [whole(**record(1, "inf"), run_hash="i")]
    (tmp_path / "records.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    status, shown, _ = run(capfd, "--epsilon", 2, "--words", 100, "--sizes", "1,2,3", "--results", tmp_path)
    assert status == 0
    assert "1.000 of 1" in shown
    assert shown.count("n/a") == 1
    assert run(capfd)[2] == "bench: --epsilon is missing (see bench subset-size --help)\n"
    assert run(capfd, "--epsilon", "x")[0] == 2
