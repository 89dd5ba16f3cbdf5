"""Bisection for the noise of equal utility, and the page."""

import math
from collections.abc import Callable
from pathlib import Path

import match_noise
import pytest
import result_page
from fakes import write_album
from match_noise import EVALUATIONS, LARGEST, Utility, find_sigma, format_matches, measure

from bench.cache import store
from bench.extractors.sift import Sift
from leaderboard.noise_control import get_tolerance
from leaderboard.provenance import list_stale


def reach(score: float) -> Utility:
    return Utility(score=score, precision=0.5)


def count(calls: list[float]) -> Callable[[float], Utility]:
    """Return a function with a score that falls with sigma. It appends its calls."""

    def match(sigma: float) -> Utility:
        calls.append(sigma)
        return reach(0.8 / (1 + math.exp(4 * (sigma - 1.3))))

    return match


@pytest.mark.parametrize("target", [0.7, 0.4, 0.1, 0.003])
def test_bisection_finds_the_score_in_few_evaluations(target: float) -> None:
    calls: list[float] = []
    found = find_sigma(reach(target), count(calls))
    assert found.is_close
    assert abs(found.noise.score - target) <= get_tolerance(target) / 2
    assert len(calls) <= EVALUATIONS
    assert find_sigma(reach(target), count([])) == found


def test_a_utility_out_of_range_has_the_nearest_end() -> None:
    assert (find_sigma(reach(0.9), count([])).sigma, find_sigma(reach(0.9), count([])).is_close) == (0.0, False)
    assert find_sigma(reach(0.0), count([])).sigma == LARGEST


@pytest.mark.slow
def test_the_page_shows_the_noise_beside_the_defense(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(result_page, "RESULTS", tmp_path)
    words = [
        "--defense",
        "affine:dim=2",
        "--attack",
        "keypoints",
        "--attack",
        "blank",
        "--noise-attack",
        "denoise:estimate=released",
    ]
    album = write_album(tmp_path / "album", 1)
    command = ["tools/match_noise.py", *words, "--images", str(album), "--each", "1", "--work", str(tmp_path / "work")]
    monkeypatch.setattr("sys.argv", command)
    match_noise.main()
    page = (tmp_path / "matched-noise.md").read_text(encoding="utf-8")
    assert list_stale(page) == []
    matched, *worst = [line for line in page.splitlines() if line.startswith(("| `affine", "| affine"))]
    assert matched.split(" | ")[1] != "n/a"
    assert all("noise:sigma=" in line for line in worst)
    assert len(worst) == 2  # SSIM and identified
    match_noise.main()
    assert (tmp_path / "matched-noise.md").read_text(encoding="utf-8") == page  # all is reused


def test_a_defense_without_a_matching_score_has_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`lines` hides positions, which the task `matching` needs."""
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    album = write_album(tmp_path / "album", 1)
    matches, _ = measure(["lines"], ["blank"], album, Sift(), 1, tmp_path / "work")
    (row,) = list(format_matches(matches))[2:]
    assert row.startswith("| `lines` | n/a: ")
    assert "matching" in row
