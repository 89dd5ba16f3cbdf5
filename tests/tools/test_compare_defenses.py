"""What tools/compare_defenses.py compares can be compared, and its verdicts say what the intervals do."""

import compare_defenses
import pytest

from bench.registry import discovery, spec
from leaderboard.intervals import Interval


def test_each_row_is_served_by_the_network_of_its_defense() -> None:
    rows = compare_defenses.rows()
    assert len({text for _, _, text in rows}) == len(rows)
    assert {name.partition(":")[0] for _, name, _ in rows} == compare_defenses.SERVED.keys()
    for _, name, text in rows:
        defense = spec.read(text, discovery.DEFENSE)
        for field, setting in compare_defenses.SERVED[name.partition(":")[0]].items():
            assert getattr(defense, field) in setting
    bases = [epsilon for epsilon, name, _ in rows if name == compare_defenses.BASE]
    assert {epsilon for epsilon, name, _ in rows if not name.startswith("metric-ldp")} == set(bases)


@pytest.mark.parametrize(
    ("seen", "gained", "told"),
    [
        ((-0.1, -0.01), (1.0, 9.0), "**dominates**"),
        ((-0.1, 0.01), (1.0, 9.0), "server does more, attacker cannot be told"),
        ((0.1, 0.2), (1.0, 9.0), "attacker sees more, server does more"),
        ((0.1, 0.2), (-9.0, -1.0), "is dominated"),
        ((-0.1, 0.2), (-9.0, -1.0), "server does less, attacker cannot be told"),
        ((-0.2, -0.1), (-9.0, 1.0), "attacker sees less"),
        ((-0.2, 0.1), (-9.0, 1.0), "cannot be told"),
    ],
)
def test_verdicts(seen: tuple[float, float], gained: tuple[float, float], told: str) -> None:
    assert compare_defenses.verdict(*(Interval(sum(ends) / 2, *ends, 10) for ends in (seen, gained))) == told
    dominating = "Dominating" in compare_defenses.summary([("`one`", "cannot be told"), ("`other`", told)])
    assert dominating == (told == compare_defenses.DOMINATES)
    assert ("higher, beyond chance, for `other`" in compare_defenses.summary([("`other`", told)])) == (
        "server does more" in told and not dominating
    )
