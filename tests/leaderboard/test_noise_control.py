"""The matched-noise control: which noise is the control, and the verdict."""

from pathlib import Path
from typing import Any

import fabricated
import numpy as np
import pytest
from fabricated import DIA, DIFFERENCES, STANDARD, baselines, ldp, reconstructions, record, run_suite

from bench.runner import attack_suite
from leaderboard import comparison, noise_control
from leaderboard.comparison import ComparisonGroup
from leaderboard.noise_control import LESS, MORE, NOT_LESS, TOLERANCE, compare_with_noise
from leaderboard.suite_table import build_group_tables
from leaderboard.worst_case import list_results

NONE = {"name": "none"}
DENOISE = {"name": "denoise", "estimate": "mean", "database": "sha256:" + "f" * 64}


def noise(sigma: float) -> dict[str, Any]:
    return {"name": "noise", "sigma": sigma}


def attack(defense: dict[str, Any], score: float, shift: int = 0, **more: Any) -> list[dict[str, Any]]:
    return reconstructions(defense, (score + np.roll(DIFFERENCES, shift)).tolist(), **more)


def match(defense: dict[str, Any], score: float, **more: Any) -> dict[str, Any]:
    """Return a record of the task `matching`."""
    return record(
        "a-b", {"recall": score}, defense=defense, task="matching", attack=None, **{"dataset": fabricated.GALLERY, **more}
    )


def build(folder: Path, *parts: list[dict[str, Any]], count: int = 6) -> tuple[ComparisonGroup, list[ComparisonGroup]]:
    records = [one for part in (*parts, baselines(NONE, count)) for one in part]
    groups = comparison.build_groups(comparison.load_records(fabricated.write(folder, records)))
    return next(group for group in groups if group.has_attacks), groups


def judge(group: ComparisonGroup, groups: list[ComparisonGroup]) -> dict[tuple[str, str], str | None]:
    """Return the verdict for each defense and measure."""
    results = list_results(group)
    compared = compare_with_noise(group, groups, results)
    return {
        (result.defense.partition(":")[0], worst.measure.name): compared[worst].verdict
        for result in results
        for worst in result.worst_cases
        if worst in compared
    }


def build_attacked(
    folder: Path, score: float, *more: list[dict[str, Any]], network: bool = True, **options: Any
) -> tuple[ComparisonGroup, list[ComparisonGroup]]:
    """Build a whole suite on `ldp` whose strongest attack has this score, and noise of equal utility that leaks 0.4."""
    others = {"blank": 0.0, "keypoints": 0.01, "context": 0.02, "repeat": 0.02, "oracle": 0.9}
    return build(
        folder,
        run_suite({**others, "dia": score}, **options),
        attack(noise(2.0), 0.4, 2, attack=DENOISE),
        attack(noise(2.0), 0.3, 2, attack=DIA) if network else [],
        [match(ldp(10.0), 0.3), match(noise(2.0), 0.31)],
        *more,
    )


@pytest.fixture(autouse=True)
def _one_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: [STANDARD])


@pytest.mark.parametrize(("score", "verdict"), [(0.2, LESS), (0.4, NOT_LESS), (0.6, MORE)])
def test_verdict(tmp_path: Path, score: float, verdict: str) -> None:
    group, groups = build_attacked(tmp_path, score)
    assert judge(group, groups)["ldp", "ssim"] == verdict
    assert judge(group, groups)["ldp", "mae"] is None  # the score is shown, and not judged
    table = build_group_tables(group, groups)["worst-case"]
    (row,) = (row for row in table.rows if row.values["defense"].startswith("ldp") and row.values["measure"] == "ssim")
    assert row.values["noise"].mean == pytest.approx(0.4)  # of the strongest attack
    assert row.values["noise_verdict"] == verdict
    assert (f"{verdict} of equal utility: noise:sigma=2" in row.values["flags"]) == (verdict != LESS)


def test_a_weak_attacker_of_the_defense_is_no_evidence(tmp_path: Path) -> None:
    complete, groups = build_attacked(tmp_path / "complete", 0.2)
    assert judge(complete, groups)["ldp", "ssim"] == LESS
    at_baseline, groups = build_attacked(tmp_path / "at-baseline", 0.01)
    assert judge(at_baseline, groups)["ldp", "ssim"] == NOT_LESS
    incomplete, groups = build_attacked(tmp_path / "incomplete", 0.2, without=["snap"])
    assert judge(incomplete, groups)["ldp", "ssim"] == NOT_LESS
    stronger = attack(ldp(10.0), 0.45, 3, attack={"name": "dia", "weights": "sha256:" + "e" * 64, "extra": 1})
    with_another, groups = build_attacked(tmp_path / "another", 0.2, stronger)  # an attack outside the suite
    assert judge(with_another, groups)["ldp", "ssim"] == MORE


def test_a_weak_attacker_of_the_noise_is_no_evidence(tmp_path: Path) -> None:
    group, groups = build_attacked(tmp_path / "without-network", 0.6, network=False)
    assert judge(group, groups)["ldp", "ssim"] == NOT_LESS
    partial = attack(noise(2.0), 0.8, 2, attack={"name": "blank"})[:4]
    group, groups = build_attacked(tmp_path / "partial", 0.6, partial)  # an attack with missing samples does not count
    assert judge(group, groups)["ldp", "ssim"] == MORE


def test_versions_of_a_suite_are_one_hypothesis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: with a correction for each version, the verdict of an old row would change."""
    newest = "standard-2026.2"
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: [STANDARD, newest])
    group, groups = build_attacked(tmp_path, 0.2, suite=newest)
    results = list_results(group)
    assert len([result for result in results if result.version]) == 2
    counts = []
    monkeypatch.setattr(noise_control, "correct_holm", lambda values: counts.append(len(values)) or values)
    compare_with_noise(group, groups, results)
    assert counts == [1, 1]  # SSIM, below and above


@pytest.mark.parametrize(("score", "difference"), [(0.3, 1.5 * TOLERANCE), (0.02, 0.5 * TOLERANCE)])
def test_noise_of_another_utility_is_no_control(tmp_path: Path, score: float, difference: float) -> None:
    """Negative control: the noise leaks as much, but a server can do more with it."""
    attacked = [*attack(ldp(10.0), 0.4, 1), *attack(noise(1.0), 0.4, 2, attack=DENOISE)]
    utility = [match(ldp(10.0), score), match(noise(1.0), score + difference)]
    group, groups = build(tmp_path / "other", attacked, utility)
    assert judge(group, groups) == {}
    table = build_group_tables(group, groups)["worst-case"]
    assert "noise" not in {column.label for column in table.columns}
    group, groups = build(tmp_path / "none", attacked)
    assert judge(group, groups) == {}
    group, groups = build(tmp_path / "seed", attacked, [match(ldp(10.0), 0.3, seed=1), match(noise(1.0), 0.3, seed=1)])
    assert judge(group, groups) == {}


def test_the_nearest_utility_is_the_control(tmp_path: Path) -> None:
    group, groups = build(
        tmp_path,
        attack(ldp(10.0), 0.4, 1),
        *(attack(noise(sigma), 1 / sigma, 2, attack=DENOISE) for sigma in (2.0, 3.0, 4.0)),
        [match(ldp(10.0), 0.3), *(match(noise(sigma), 0.31 - 0.006 * sigma) for sigma in (2.0, 3.0, 4.0))],
    )
    ((_, first), *_) = compare_with_noise(group, groups, list_results(group)).items()
    assert first.control.label == "noise:sigma=2"
    assert first.control.utilities == pytest.approx((0.3, 0.298))


def test_too_few_photographs_are_not_judged(tmp_path: Path) -> None:
    few = [one for one in [*attack(ldp(10.0), 0.2, 1), *attack(noise(2.0), 0.6, 2, attack=DENOISE)] if one["sample"] < "4"]
    group, groups = build(tmp_path, few, [match(ldp(10.0), 0.3), match(noise(2.0), 0.3)], count=4)
    assert judge(group, groups)["ldp", "ssim"] is None
