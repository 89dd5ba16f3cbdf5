"""Reconstructions from affine subspaces and LDP-Feat at matched recall: one row per photograph, one figure per dimension.

The privacy of two defenses is compared at equal utility. So the queries of a gallery are localized under each defense, and each
dimension is paired with the ε of nearest recall. Both recalls are printed above the images, since they may still differ. The
gallery's |K| differs from the photographs' at the same probability of the true word (`scale.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from leaderboard.figures import Panel, draw
from leaderboard.reproduce import run, scenes
from leaderboard.reproduce.drawing import Drawing, FigureData
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Row
from leaderboard.reproduce.tables import table1, table4

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS, SUBSET = 256_000, 2  # the paper's |K| and m
MEASURE = "recall_0.25m_2deg"
ATTACKS = {"database": "database", "dia": "DIA"}


def build_rows(setting: Setting) -> tuple[Row, ...]:
    """Return the rows of Tables 1 and 4 that the figures show."""
    affine_rows = [row for row in table1.build_rows(setting) if row.labels["attack"] in ATTACKS]
    ldp_names = {table4.format_name(WORDS, epsilon, SUBSET) for epsilon in table4.EPSILONS}
    return (*affine_rows, *(row for row in table4.build_rows(setting) if row.name in ldp_names))


def build_localization_rows(setting: Setting) -> tuple[Row, ...]:
    """Return rows of the same defenses on the queries of the gallery."""
    task = scenes.build_task(setting)
    defenses = {format_affine_name(dim): table1.build_lifting(dim, setting) for dim in table1.DIMS}
    defenses |= {
        format_ldp_name(epsilon): scenes.build_defense(setting, str(WORDS), str(epsilon), SUBSET) for epsilon in table4.EPSILONS
    }
    return tuple(
        Row(name=name, labels={}, paper={}, defense=defense, attack=None, task=task) for name, defense in defenses.items()
    )


def format_affine_name(dim: int) -> str:
    return f"affine, dim {dim}"


def format_ldp_name(epsilon: int) -> str:
    return scenes.format_name(str(WORDS), str(epsilon), SUBSET)


def measure_recalls(data: FigureData) -> dict[str, float]:
    """Return the fraction of the gallery's queries that are localized under each defense."""
    setting = data.setting
    result = run.run_rows(
        build_localization_rows(setting), setting, run.select_queries(setting.profile.gallery), data.out, DRAWING.name
    )
    recalls = {}
    for row in result.rows:
        values = [record["metrics"][MEASURE] for record in run.select_records(result, row.name) if record["status"] == "ok"]
        recalls[row.name] = float(np.mean(values)) if values else np.nan
    return recalls


def find_nearest_epsilon(recall: float, recalls: Mapping[int, float]) -> int:
    """Return the ε with the nearest recall; of several, the smallest."""
    return min(sorted(recalls), key=lambda epsilon: abs(recalls[epsilon] - recall))


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    recalls = measure_recalls(data)
    ldp_recalls = {epsilon: recalls[format_ldp_name(epsilon)] for epsilon in table4.EPSILONS}
    for dim in table1.DIMS:
        recall = recalls[format_affine_name(dim)]
        epsilon = find_nearest_epsilon(recall, ldp_recalls)
        panels = []
        for number, (name, original) in enumerate(data.load_originals()):
            row = [
                Panel(original, "original", ""),
                *(
                    data.build_panel(table1.format_name(attack, dim), name, f"{title}, dim {dim}: recall {recall:.0%}")
                    for attack, title in ATTACKS.items()
                ),
                data.build_panel(
                    table4.format_name(WORDS, epsilon, SUBSET),
                    name,
                    f"DIA, paper's ε {epsilon}, m = {SUBSET}: recall {ldp_recalls[epsilon]:.0%}",
                ),
            ]
            panels += row if number == 0 else [Panel(panel.pixels, "", panel.caption) for panel in row]
        heading = f"Affine subspaces and LDP-Feat at the nearest recall (queries within 0.25 m and 2°), dim {dim}"
        yield f"dim{dim}", draw(panels, heading, columns=len(ATTACKS) + 2)


DRAWING = Drawing(name="matched-recall", draw=draw_figures, build_rows=build_rows)
