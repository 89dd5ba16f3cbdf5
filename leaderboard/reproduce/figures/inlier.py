"""Reconstructions by the inlier attack from localized queries. They show the scene and not the people in front of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bench.registry import discovery
from leaderboard.figures import Panel, draw
from leaderboard.reproduce import scenes
from leaderboard.reproduce.drawing import Drawing, FigureData
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Row, build_plugin, build_reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = {"SSIM background": "ssim_background", "foreground": "ssim_foreground"}
LDP = ("256000", "12", 2)  # the paper's |K|, ε and m; nearly all queries are localized


def build_rows(setting: Setting) -> tuple[Row, ...]:
    attack = build_plugin(discovery.ATTACK, "inlier", {"trials": round(scenes.TRIALS * setting.profile.trials)})
    undefended = build_plugin(discovery.DEFENSE, "none", {})
    pairs = {
        "none, all keypoints (DIA)": (
            undefended,
            build_plugin(discovery.ATTACK, "dia", {"weights": setting.materials.raw_network}),
        ),
        "none, inliers": (undefended, attack),
        "affine, dim 4, inliers": (build_plugin(discovery.DEFENSE, "affine", {"dim": 4}), attack),
        f"ldp, {scenes.format_name(*LDP)}, inliers": (scenes.build_defense(setting, *LDP), attack),
    }
    return tuple(
        Row(name=name, labels={}, paper={}, defense=defense, attack=own_attack, task=build_reconstruction(setting))
        for name, (defense, own_attack) in pairs.items()
    )


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    for name, original in data.load_originals():
        panels = [Panel(original, "original", "")]
        panels += [data.build_panel(row.name, name, row.name, PARTS) for row in build_rows(data.setting)]
        yield name, draw(panels, f"Inlier attack; {name}")


DRAWING = Drawing(name="inlier", draw=draw_figures, build_rows=build_rows, uses_queries=True)
