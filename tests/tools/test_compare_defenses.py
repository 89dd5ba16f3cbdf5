"""The rows of tools/compare_defenses.py are comparable, and its verdicts follow from the intervals."""

import compare_defenses
import pytest

from bench.registry import discovery, spec
from leaderboard.intervals import Interval


def test_each_row_is_supported_by_the_network_of_its_defense() -> None:
    rows = compare_defenses.list_rows()
    assert len({text for _, _, text in rows}) == len(rows)
    assert {name.partition(":")[0] for _, name, _ in rows} == compare_defenses.SUPPORTED.keys()
    for _, name, text in rows:
        defense = spec.read(text, discovery.DEFENSE)
        for field, setting in compare_defenses.SUPPORTED[name.partition(":")[0]].items():
            assert getattr(defense, field) in setting
    bases = [epsilon for epsilon, name, _ in rows if name == compare_defenses.BASE]
    assert {epsilon for epsilon, name, _ in rows if not name.startswith("metric-ldp")} == set(bases)


@pytest.mark.parametrize(
    ("ssim", "recall", "expected"),
    [
        ((-0.1, -0.01), (1.0, 9.0), "**dominates**"),
        ((-0.1, 0.01), (1.0, 9.0), "higher recall, SSIM inconclusive"),
        ((0.1, 0.2), (1.0, 9.0), "higher SSIM, higher recall"),
        ((0.1, 0.2), (-9.0, -1.0), "is dominated"),
        ((-0.1, 0.2), (-9.0, -1.0), "lower recall, SSIM inconclusive"),
        ((-0.2, -0.1), (-9.0, 1.0), "lower SSIM"),
        ((-0.2, 0.1), (-9.0, 1.0), "inconclusive"),
    ],
)
def test_verdicts(ssim: tuple[float, float], recall: tuple[float, float], expected: str) -> None:
    assert compare_defenses.describe_verdict(*(Interval(sum(ends) / 2, *ends, 10) for ends in (ssim, recall))) == expected
    dominating = "These dominate" in compare_defenses.write_summary([("`one`", "inconclusive"), ("`other`", expected)])
    assert dominating == (expected == compare_defenses.DOMINATES)
    assert ("significantly higher for `other`" in compare_defenses.write_summary([("`other`", expected)])) == (
        "higher recall" in expected and not dominating
    )
