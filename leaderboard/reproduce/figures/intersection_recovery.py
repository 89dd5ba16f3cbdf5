"""The intersection attack (in no paper) over the number of photographs seen: what it recovers, beside the words truly met.

It knows no database, and rebuilds one from where subspaces meet. So it can do no better than its releases cover the words that
the photograph was led through. The share that they do is measured by the owner, who knows these words; the attack has its own
count of it. The database attack, which knows all words from the start, is what it tends to.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from bench.registry import discovery
from leaderboard.reproduce.drawing import Drawing, Scene
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.run import of
from leaderboard.reproduce.study import Row, build, reconstruction
from leaderboard.reproduce.tables import table1

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of about as many photographs one meets a given word with 95% chance: the fewer words a subspace has, the more it takes.
MOST = {2: 800, 4: 400, 8: 200, 16: 100}
HALVINGS = 5


def counts(setting: Setting, dim: int) -> list[int]:
    """How many releases of other photographs are seen, fewest first."""
    reduced = setting.profile.reduced.get("others")
    return [reduced] if reduced else [MOST[dim] >> halvings for halvings in range(HALVINGS, -1, -1)]


def rows(setting: Setting) -> tuple[Row, ...]:
    found = []
    for dim in table1.DIMS:
        for seen in counts(setting, dim):
            asked = {"others": seen, "coverage": 1.0}  # so that none is left unseen
            trials = (
                (attacked(dim, seen), build(discovery.ATTACK, "intersection", asked), reconstruction(setting)),
                (covered(dim, seen), None, build(discovery.TASK, "collisions", asked)),
            )
            found += [
                Row(name=name, labels={}, paper={}, defense=table1.lifting(dim, setting), attack=attack, task=task)
                for name, attack, task in trials
            ]
    return (*found, *(row for row in table1.rows(setting) if row.labels["attack"] == "database"))


def attacked(dim: int, seen: int) -> str:
    return f"intersection, dim {dim}, {seen} seen"


def covered(dim: int, seen: int) -> str:
    return f"words met, dim {dim}, {seen} seen"


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.9), layout="constrained", dpi=120)
    count = len(scene.judged.chosen)
    over = f"mean over {count} photograph{'s' * (count > 1)}"
    figure.suptitle(f"The intersection attack, which knows no database; stars: the database attack; {over}", fontsize=9)
    shares, pictures = figure.subplots(1, 2)
    for number, dim in enumerate(table1.DIMS):
        seen, color = counts(scene.setting, dim), f"C{number}"
        recovered = [mean(scene, attacked(dim, count), "recovered") for count in seen]
        shares.plot(seen, recovered, "o-", color=color, label=f"descriptors, dim {dim}")
        shares.plot(seen, [mean(scene, covered(dim, count), "coverage") for count in seen], "x--", color=color, label="words met")
        pictures.plot(seen, [mean(scene, attacked(dim, count), "ssim") for count in seen], "o-", color=color, label=f"dim {dim}")
        for axes, metric in ((shares, "recovered"), (pictures, "ssim")):
            known = mean(scene, table1.name("database", dim), metric)
            axes.plot(seen[-1:], [known], marker="*", markersize=11, linestyle="", color=color, markeredgecolor="black")
    shares.set_ylabel("share recovered; share of words met (true)")
    pictures.set_ylabel("SSIM")
    for axes in (shares, pictures):
        axes.set_xscale("log", base=2)
        axes.set_xticks(sorted({count for dim in table1.DIMS for count in counts(scene.setting, dim)}))
        axes.xaxis.set_major_formatter(lambda count, place: f"{count:g}")
        axes.tick_params(axis="x", labelsize=7)
        axes.set_xlabel("photographs seen (one in 16 shares the words)", fontsize=9)
        axes.grid(alpha=0.3)
    shares.set_ylim(0, 1.04)
    shares.legend(fontsize=7, ncols=2)
    pictures.legend(fontsize=7)
    yield "", figure


def mean(scene: Scene, row: str, metric: str) -> float:
    """Over the photographs that have it."""
    values = [record["metrics"][metric] for record in of(scene.ran, row) if record["metrics"].get(metric) is not None]
    return float(np.mean(values)) if values else np.nan


DRAWING = Drawing(name="intersection-recovery", draw=drawn, rows=rows)
