"""Table S4: collisions in the clustering attack. `bench/tasks/collisions.py` says how the paper is read."""

from __future__ import annotations

from collections.abc import Mapping

from bench.registry import discovery
from leaderboard.reproduce import published
from leaderboard.reproduce.claims import Cell, Claim, falling
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Measure, Row, Table, build
from leaderboard.reproduce.tables.table1 import DIMS, lifting

PRINTED = "no_collision_percent"


def rows(setting: Setting) -> tuple[Row, ...]:
    task = build(discovery.TASK, "collisions", {"others": setting.profile.others})
    return tuple(
        Row(
            name=f"dim {line['dim']}",
            labels={"dim": line["dim"]},
            paper=published.numbers(line, [PRINTED]),
            defense=lifting(int(line["dim"]), setting),
            attack=None,
            task=task,
        )
        for line in published.lines("tableS4_clustering_collisions")
    )


def claims(paper: Mapping[Cell, float]) -> tuple[Claim, ...]:
    return (
        Claim(
            text="The share of descriptors without a collision falls as the dimension grows.",
            statements=falling([(f"dim {dim}", PRINTED) for dim in DIMS]),
        ),
    )


TABLE = Table(
    name="tableS4",
    title="Table S4: collisions in the clustering attack (%)",
    measures={
        PRINTED: Measure(metric="no_collision", times=100, digits=2),
        "of those whose a_i are all met": Measure(metric="no_collision_covered", times=100, digits=2),
        "whose a_i are all met": Measure(metric="covered", times=100, digits=1),
        "a_i met": Measure(metric="coverage", times=100, digits=1),
        "releases asked": Measure(metric="releases_asked", digits=1),
        "of the same sub-database": Measure(metric="releases_kept", digits=1),
    },
    rows=rows,
    claims=claims,
    notes=(
        "An adversarial word a_i that no other release goes through counts as a collision; the further columns tell how often "
        "that is, and what is left without it.",
    ),
)
