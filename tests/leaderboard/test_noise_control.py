"""The matched-noise control: which noise is the control, and the verdict."""

from pathlib import Path
from typing import Any

import fabricated
import numpy as np
import pytest
from fabricated import baselines, ldp, reconstructions, record

from leaderboard import comparison
from leaderboard.comparison import ComparisonGroup
from leaderboard.noise_control import LESS, MORE, NOT_LESS, TOLERANCE, compare_with_noise
from leaderboard.suite_table import build_suite_table
from leaderboard.worst_case import list_results

DIFFERENCES = np.array([-0.02, 0.01, 0.0, 0.02, -0.01, 0.0])  # between photographs
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


def build(folder: Path, *parts: list[dict[str, Any]]) -> tuple[ComparisonGroup, list[ComparisonGroup]]:
    records = [one for part in (*parts, baselines(NONE, 6)) for one in part]
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


@pytest.mark.parametrize(("score", "verdict"), [(0.2, LESS), (0.4, NOT_LESS), (0.6, MORE)])
def test_verdict(tmp_path: Path, score: float, verdict: str) -> None:
    group, groups = build(
        tmp_path,
        attack(ldp(10.0), score, 1),
        attack(noise(2.0), 0.4, 2, attack=DENOISE),
        attack(noise(2.0), 0.3, 2, attack={"name": "blank"}),
        [match(ldp(10.0), 0.3), match(noise(2.0), 0.31)],
    )
    assert judge(group, groups)["ldp", "ssim"] == verdict
    assert judge(group, groups)["ldp", "mae"] is None  # the score is shown, and not judged
    table = build_suite_table(group, groups)
    assert table
    (row,) = (row for row in table.rows if row.values["defense"].startswith("ldp") and row.values["measure"] == "ssim")
    assert row.values["noise"].mean == pytest.approx(0.4)  # of the strongest attack
    assert row.values["noise_verdict"] == verdict
    assert (f"{verdict} of equal utility: noise:sigma=2" in row.values["flags"]) == (verdict != LESS)


def test_noise_of_another_utility_is_no_control(tmp_path: Path) -> None:
    """Negative control: the noise leaks as much, but a server can do more with it."""
    attacked = [*attack(ldp(10.0), 0.4, 1), *attack(noise(1.0), 0.4, 2, attack=DENOISE)]
    utility = [match(ldp(10.0), 0.3), match(noise(1.0), 0.3 + 1.5 * TOLERANCE)]
    group, groups = build(tmp_path / "other", attacked, utility)
    assert judge(group, groups) == {}
    table = build_suite_table(group, groups)
    assert table
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
    group, groups = build(tmp_path, few, [match(ldp(10.0), 0.3), match(noise(2.0), 0.3)])
    assert judge(group, groups)["ldp", "ssim"] is None
