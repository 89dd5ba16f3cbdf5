"""Table S4: collisions in the clustering attack. `bench/tasks/collisions.py` explains our interpretation of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from bench.registry import discovery
from bench.tasks.collisions import Collisions
from leaderboard.reproduce import published
from leaderboard.reproduce.claims import Claim, TableEntry, falling
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Measure, Row, Table, build_plugin
from leaderboard.reproduce.tables.table1 import DIMS, build_lifting

PRINTED = "no_collision_percent"
CONFOUNDER = (
    "our fraction is that of the descriptors with all a_i covered, about "
    f"{Collisions.coverage:g}^(dim/2), because the search for other releases ends when that fraction of the a_i is covered; the "
    "column of covered descriptors does not depend on it"
)


def build_rows(setting: Setting) -> tuple[Row, ...]:
    task = build_plugin(discovery.TASK, "collisions", {"others": setting.profile.other_releases})
    return tuple(
        Row(
            name=f"dim {line['dim']}",
            labels={"dim": line["dim"], "coverage^(dim/2)": f"{100 * Collisions.coverage ** (int(line['dim']) / 2):.2f}"},
            paper=published.parse_numbers(line, [PRINTED]),
            defense=build_lifting(int(line["dim"]), setting),
            attack=None,
            task=task,
        )
        for line in published.read_rows("tableS4_clustering_collisions")
    )


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    return (
        Claim(
            text="The fraction of descriptors without a collision falls as the dimension grows.",
            statements=tuple(
                replace(statement, confounder=CONFOUNDER) for statement in falling([(f"dim {dim}", PRINTED) for dim in DIMS])
            ),
        ),
    )


TABLE = Table(
    name="tableS4",
    title="Table S4: collisions in the clustering attack (%)",
    measures={
        PRINTED: Measure(metric="no_collision", factor=100, digits=2),
        "covered (all a_i)": Measure(metric="covered", factor=100, digits=2),
        "no collision among covered": Measure(metric="no_collision_covered", factor=100, digits=2),
        "a_i covered": Measure(metric="coverage", factor=100, digits=1),
        "releases searched": Measure(metric="releases_asked", digits=1),
        "of the same sub-database": Measure(metric="releases_kept", digits=1),
    },
    build_rows=build_rows,
    build_claims=build_claims,
    notes=(
        "An adversarial word a_i that no other release contains counts as a collision. A descriptor is covered if other releases "
        "contain all its m/2 words a_i. The search for releases ends at a coverage of "
        f"{Collisions.coverage:.0%} of the a_i, so about {Collisions.coverage:g}^(m/2) of the descriptors are covered. Our first "
        "column follows from this constant. The paper states neither its criterion nor its coverage, so its "
        "values and ours are not comparable.",
    ),
)
