"""Affine and LDP-Feat reconstructions at matched recall: rows photographs, a figure for each dimension of the subspaces.

What a defense hides is compared with what another hides only where both serve as well. So the queries of a place are localized
under each, and each dimension is set beside the ε whose share of localized queries is nearest to its own; both stand above the
pictures, for no ε need be near. The place's |K| is another than the photographs', at the same chance of the truth (`scale.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from leaderboard.figures import Panel, draw
from leaderboard.reproduce import run, scenes
from leaderboard.reproduce.drawing import Drawing, Scene
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Row
from leaderboard.reproduce.tables import table1, table4

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS, SUBSET = 256_000, 2  # the paper's |K| and m
MEASURE = "recall_0.25m_2deg"
ATTACKS = {"database": "database", "dia": "DIA"}


def rows(setting: Setting) -> tuple[Row, ...]:
    """Those of Tables 1 and 4 that are drawn."""
    lifted = [row for row in table1.rows(setting) if row.labels["attack"] in ATTACKS]
    drawn_from = {table4.name(WORDS, epsilon, SUBSET) for epsilon in table4.EPSILONS}
    return (*lifted, *(row for row in table4.rows(setting) if row.name in drawn_from))


def localized(setting: Setting) -> tuple[Row, ...]:
    """The same defenses on the queries of a place."""
    task = scenes.task(setting)
    defenses = {subspaces(dim): table1.lifting(dim, setting) for dim in table1.DIMS}
    defenses |= {private(epsilon): scenes.defense(setting, str(WORDS), str(epsilon), SUBSET) for epsilon in table4.EPSILONS}
    return tuple(
        Row(name=name, labels={}, paper={}, defense=defense, attack=None, task=task) for name, defense in defenses.items()
    )


def subspaces(dim: int) -> str:
    return f"affine, dim {dim}"


def private(epsilon: int) -> str:
    return scenes.name(str(WORDS), str(epsilon), SUBSET)


def recalls(scene: Scene) -> dict[str, float]:
    """The share of the place's queries that are localized under each defense."""
    setting = scene.setting
    ran = run.execute(localized(setting), setting, run.queries(setting.profile.place), scene.out, DRAWING.name)
    found = {}
    for row in ran.rows:
        values = [record["metrics"][MEASURE] for record in run.of(ran, row.name) if record["status"] == "ok"]
        found[row.name] = float(np.mean(values)) if values else np.nan
    return found


def nearest(recall: float, known: Mapping[int, float]) -> int:
    """The ε whose recall is nearest; the smallest of several."""
    return min(sorted(known), key=lambda epsilon: abs(known[epsilon] - recall))


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    known = recalls(scene)
    of_epsilon = {epsilon: known[private(epsilon)] for epsilon in table4.EPSILONS}
    for dim in table1.DIMS:
        recall = known[subspaces(dim)]
        epsilon = nearest(recall, of_epsilon)
        panels = []
        for number, (name, original) in enumerate(scene.originals()):
            shown = [
                Panel(original, "original", ""),
                *(
                    scene.panel(table1.name(attack, dim), name, f"{title}, dim {dim}: recall {recall:.0%}")
                    for attack, title in ATTACKS.items()
                ),
                scene.panel(
                    table4.name(WORDS, epsilon, SUBSET),
                    name,
                    f"DIA, paper's ε {epsilon}, m = {SUBSET}: recall {of_epsilon[epsilon]:.0%}",
                ),
            ]
            panels += shown if number == 0 else [Panel(panel.pixels, "", panel.beneath) for panel in shown]
        heading = f"Affine subspaces and LDP-Feat at the recall that is nearest (of queries within 0.25 m and 2°), dim {dim}"
        yield f"dim{dim}", draw(panels, heading, columns=len(ATTACKS) + 2)


DRAWING = Drawing(name="matched-recall", draw=drawn, rows=rows)
