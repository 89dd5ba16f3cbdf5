"""The intersection attack (not in the paper) over the number of observed photographs: its recovery, and the coverage of words.

The attack has no database and reconstructs one from intersections of subspaces. The coverage limits its recovery: it is the
fraction of the photograph's words that the observed releases contain. The task `collisions` measures it with the true words,
while the attack has its own estimate. The upper limit is the database attack, which has all words.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from bench.registry import discovery
from leaderboard.reproduce.drawing import Drawing, FigureData
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.run import select_records
from leaderboard.reproduce.study import Row, build_plugin, build_reconstruction
from leaderboard.reproduce.tables import table1

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# At least one of about so many photographs contains a given word with 95% probability. Subspaces with fewer words need more.
MAX_RELEASES = {2: 800, 4: 400, 8: 200, 16: 100}
HALVINGS = 5


def list_counts(setting: Setting, dim: int) -> list[int]:
    """Return the numbers of other releases that the attack observes, in ascending order."""
    override = setting.profile.attack_overrides.get("others")
    return [override] if override else [MAX_RELEASES[dim] >> halvings for halvings in range(HALVINGS, -1, -1)]


def build_rows(setting: Setting) -> tuple[Row, ...]:
    rows = []
    for dim in table1.DIMS:
        for count in list_counts(setting, dim):
            configuration = {"others": count, "coverage": 1.0}  # 1.0: all releases are used
            experiments = (
                (
                    format_attack_name(dim, count),
                    build_plugin(discovery.ATTACK, "intersection", configuration),
                    build_reconstruction(setting),
                ),
                (format_coverage_name(dim, count), None, build_plugin(discovery.TASK, "collisions", configuration)),
            )
            rows += [
                Row(name=name, labels={}, paper={}, defense=table1.build_lifting(dim, setting), attack=attack, task=task)
                for name, attack, task in experiments
            ]
    return (*rows, *(row for row in table1.build_rows(setting) if row.labels["attack"] == "database"))


def format_attack_name(dim: int, count: int) -> str:
    return f"intersection, dim {dim}, {count} releases"


def format_coverage_name(dim: int, count: int) -> str:
    return f"coverage, dim {dim}, {count} releases"


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.9), layout="constrained", dpi=120)
    photographs = len(data.evaluation_set.photographs)
    average = f"mean over {photographs} photograph{'s' * (photographs > 1)}"
    figure.suptitle(f"The intersection attack, without a database. Stars: the database attack. Values: {average}", fontsize=9)
    recovery_axes, ssim_axes = figure.subplots(1, 2)
    for number, dim in enumerate(table1.DIMS):
        counts, color = list_counts(data.setting, dim), f"C{number}"
        recovered = [average_metric(data, format_attack_name(dim, count), "recovered") for count in counts]
        recovery_axes.plot(counts, recovered, "o-", color=color, label=f"descriptors, dim {dim}")
        recovery_axes.plot(
            counts,
            [average_metric(data, format_coverage_name(dim, count), "coverage") for count in counts],
            "x--",
            color=color,
            label="coverage",
        )
        ssim_axes.plot(
            counts,
            [average_metric(data, format_attack_name(dim, count), "ssim") for count in counts],
            "o-",
            color=color,
            label=f"dim {dim}",
        )
        for axes, metric in ((recovery_axes, "recovered"), (ssim_axes, "ssim")):
            limit = average_metric(data, table1.format_name("database", dim), metric)
            axes.plot(counts[-1:], [limit], marker="*", markersize=11, linestyle="", color=color, markeredgecolor="black")
    recovery_axes.set_ylabel("fraction recovered; coverage of the words (true)")
    ssim_axes.set_ylabel("SSIM")
    for axes in (recovery_axes, ssim_axes):
        axes.set_xscale("log", base=2)
        axes.set_xticks(sorted({count for dim in table1.DIMS for count in list_counts(data.setting, dim)}))
        axes.xaxis.set_major_formatter(lambda count, _: f"{count:g}")
        axes.tick_params(axis="x", labelsize=7)
        axes.set_xlabel("photographs observed (one in 16 shares the sub-database)", fontsize=9)
        axes.grid(alpha=0.3)
    recovery_axes.set_ylim(0, 1.04)
    recovery_axes.legend(fontsize=7, ncols=2)
    ssim_axes.legend(fontsize=7)
    yield "", figure


def average_metric(data: FigureData, row: str, metric: str) -> float:
    """Return the mean over the photographs that have the metric."""
    values = [
        record["metrics"][metric] for record in select_records(data.result, row) if record["metrics"].get(metric) is not None
    ]
    return float(np.mean(values)) if values else np.nan


DRAWING = Drawing(name="intersection-recovery", draw=draw_figures, build_rows=build_rows)
