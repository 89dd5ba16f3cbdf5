"""Table S3: intersections of a subspace with the manifold of descriptors.

`bench/tasks/intersections.py` explains our interpretation of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from bench.registry import discovery
from leaderboard.reproduce import published
from leaderboard.reproduce.claims import Claim, TableEntry, falling, greater
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Measure, Row, Table, build_plugin
from leaderboard.reproduce.tables.table1 import build_lifting

COUNTS = (5, 10, 20, 50)
PRINTED = tuple(f"success_top{count}" for count in COUNTS)


def build_rows(setting: Setting) -> tuple[Row, ...]:
    per_photograph = math.ceil(setting.profile.subspaces / setting.photographs)
    task = build_plugin(discovery.TASK, "intersections", {"subspaces": per_photograph})
    return tuple(
        Row(
            name=f"dim {line['dim']}",
            labels={"dim": line["dim"]},
            paper=published.parse_numbers(line, PRINTED),
            defense=build_lifting(int(line["dim"]), setting),
            attack=None,
            task=task,
        )
        for line in published.read_rows("tableS3_intersecting_subspaces")
    )


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    return (
        Claim(
            text="Success falls as N grows.",
            statements=tuple(
                statement for dim in (4, 16) for statement in falling([(f"dim {dim}", measure) for measure in PRINTED])
            ),
        ),
        Claim(
            text="Success falls as the dimension grows.",
            statements=tuple(greater(("dim 4", measure), ("dim 16", measure)) for measure in PRINTED),
        ),
    )


TABLE = Table(
    name="tableS3",
    title="Table S3: intersecting adversarial subspaces (success, %)",
    measures={
        **{measure: Measure(metric=measure, factor=100, digits=2) for measure in PRINTED},
        **{f"with a_i, top{count}": Measure(metric=f"with_adversarial_top{count}", factor=100, digits=2) for count in COUNTS},
        "subspaces": Measure(metric="subspaces", digits=0),
    },
    build_rows=build_rows,
    build_claims=build_claims,
    notes=(
        "A word near a subspace succeeds if it matches one of the m/2 + 1 points that the subspace was built from, by the ratio "
        "test at 0.8. The adversarial words themselves do not count among the N. With them, success at m = 16 and N = 5 is 100% "
        "for any data, and the paper prints less.",
        "Subspaces: their number per photograph. Its descriptors are lifted repeatedly until this number is reached.",
    ),
)
