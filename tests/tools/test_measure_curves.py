"""Leakage curves: the fit and its conclusion, with random scores as a negative control, and a small run."""

from collections.abc import Sequence
from pathlib import Path

import measure_curves
import numpy as np
import pytest
import result_page
from fakes import write_album
from measure_curves import Curve, Doubles, Study, build_schedule, describe_trend, draw_curves, fit_line, judge_fit, write_results
from PIL import Image

from bench.cache import store
from leaderboard.intervals import estimate_mean
from leaderboard.provenance import CHUNK, list_stale

EFFORTS = (2_000, 8_000, 24_000, 64_000)
DOUBLINGS = np.log2(np.array(EFFORTS) / EFFORTS[-1])
NOTHING = "nothing: the slope may be zero"


def draw_scores(means: Sequence[float], count: int = 100, seed: int = 0) -> Doubles:
    """Return scores of photographs that differ more from each other than attackers do. -> (attackers, photographs)"""
    rng = np.random.default_rng(seed)
    return np.array(means)[:, None] + rng.normal(0, 0.1, count) + rng.normal(0, 0.01, (len(means), count))


def build_curve(scores: Doubles, baseline: float = 0.1) -> Curve:
    def name(values: Doubles) -> dict[str, dict[str, float]]:
        return {"ssim": {f"{number}.png": float(value) for number, value in enumerate(values)}, "identified": {}}

    low = np.full(scores.shape[1], baseline)
    return Curve(efforts=EFFORTS, values=tuple(map(name, scores)), baselines={one: name(low) for one in ("blank", "keypoints")})


def test_the_fit_is_that_of_least_squares() -> None:
    scores = draw_scores([0.4, 0.5, 0.52, 0.6])
    fit = fit_line(EFFORTS, scores)
    slope, level = np.polyfit(DOUBLINGS, scores.mean(axis=1), 1)
    assert (fit.slope.mean, fit.level) == (pytest.approx(slope), pytest.approx(level))
    assert fit.last.mean == pytest.approx((scores[3] - scores[2]).mean() / np.log2(64 / 24))


def test_the_interval_covers_the_slope_of_noisy_trainings() -> None:
    """Trainings differ by chance. The interval over photographs alone does not cover the slope: negative control."""
    rng = np.random.default_rng(1)
    covered, covered_by_photographs = [], []
    weights = (DOUBLINGS - DOUBLINGS.mean()) / np.square(DOUBLINGS - DOUBLINGS.mean()).sum()
    for seed in range(300):
        scores = draw_scores(0.6 + 0.02 * DOUBLINGS + rng.normal(0, 0.03, 4), seed=seed)
        slopes = fit_line(EFFORTS, scores).slope.interval(), estimate_mean(weights @ scores).interval()
        both, one = (slope.low <= 0.02 <= slope.high for slope in slopes)
        covered.append(both)
        covered_by_photographs.append(one)
    assert np.mean(covered) > 0.94
    assert np.mean(covered_by_photographs) < 0.3


@pytest.mark.parametrize("common", [0.0, 0.03])
def test_nothing_can_be_concluded_from_random_scores(common: float) -> None:
    """Negative control, with scores that are random by photograph, and by training as well."""
    rng = np.random.default_rng(2)
    fits = [fit_line(EFFORTS, draw_scores(0.5 + rng.normal(0, common, 4), seed=seed)) for seed in range(2000)]
    assert sum(judge_fit(fit) == NOTHING for fit in fits) >= 0.94 * len(fits)


@pytest.mark.parametrize(
    ("means", "trend"),
    [
        ([0.30, 0.40, 0.481, 0.55], "still rises"),
        ([0.3, 0.55, 0.6, 0.6], NOTHING),  # far from a line: four points cannot say how it goes on
        ([0.45, 0.5, 0.53, 0.53], "rises, but not shown to rise at the end"),
        ([0.55, 0.481, 0.40, 0.30], "scores fall: the trainings failed"),
        ([0.05, 0.06, 0.07, 0.08], "nothing: the attacker of the greatest effort is at the baselines"),
    ],
)
def test_trends(means: list[float], trend: str) -> None:
    assert describe_trend(build_curve(draw_scores(means)), "ssim") == trend


def test_few_photographs_are_not_judged() -> None:
    curve = build_curve(draw_scores([0.3, 0.4, 0.5, 0.6], count=5))
    assert describe_trend(curve, "ssim").startswith("nothing")


def test_small_budgets_have_a_whole_schedule() -> None:
    assert (build_schedule(80).steps, build_schedule(80).warmup) == (10, 1)
    assert (build_schedule(64_000).steps, build_schedule(64_000).warmup) == (8000, 100)


def test_a_curve_without_a_metric_is_drawn() -> None:
    figure = draw_curves({("none", "samples"): build_curve(draw_scores([0.3, 0.4, 0.5, 0.6]))})
    assert [len(axes.lines) > 0 for axes in figure.axes] == [True, False, False, False]


@pytest.mark.slow
def test_the_page_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(result_page, "RESULTS", tmp_path)
    monkeypatch.setattr(measure_curves, "PICTURE", tmp_path / "curves.png")
    monkeypatch.setattr(measure_curves, "RELEASES", {"none": ("none", "sift"), "ldp-10": ("ldp:epsilon=10", "sift")})
    for name, value in {"SAMPLES": (8, 16, 24), "PHOTOGRAPHS": (1, 2, 4), "FIXED": 8}.items():
        monkeypatch.setattr(measure_curves, name, value)
    monkeypatch.setattr("sys.argv", ["tools/measure_curves.py", "--data", "data", "--work", "work"])
    album = write_album(tmp_path / "data" / "train", 6)
    names = sorted(path.name for path in album.iterdir())
    for number, file in enumerate(("tune.txt", "test.txt")):
        (tmp_path / "data" / file).write_text(f"{names[number]}\n", encoding="utf-8")

    def run() -> str:
        write_results(Study(tmp_path / "data", tmp_path / "work"), ["none"], ["samples", "photographs"])
        return (tmp_path / "curves.md").read_text(encoding="utf-8")

    page = run()
    assert list_stale(page) == []
    assert page.count("| `none` | training ") == 4  # fits of two measures against two efforts
    assert "| `none` | 24 training samples |" in page
    assert "Not measured: `ldp-10` against training samples, `ldp-10` against training photographs." in page
    assert list_stale(Image.open(tmp_path / "curves.png").info[CHUNK]) == []
    networks = {path: path.stat().st_mtime_ns for path in (tmp_path / "work").glob("*.safetensors")}
    assert len(networks) == 5  # the network of 8 samples from 4 photographs is part of both curves
    assert run() == page
    assert {path: path.stat().st_mtime_ns for path in networks} == networks  # nothing was trained again
