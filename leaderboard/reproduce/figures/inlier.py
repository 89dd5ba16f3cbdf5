"""The inlier attack: what the server sees of a query that it localized. The scene appears, and the people before it do not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bench.registry import discovery
from leaderboard.figures import Panel, draw
from leaderboard.reproduce import scenes
from leaderboard.reproduce.drawing import Drawing, Scene
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Row, build, reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = {"SSIM background": "ssim_background", "foreground": "ssim_foreground"}
LDP = ("256000", "12", 2)  # |K|, ε, m of the paper that nearly every query is localized with


def rows(setting: Setting) -> tuple[Row, ...]:
    attack = build(discovery.ATTACK, "inlier", {"trials": round(scenes.TRIALS * setting.profile.trials)})
    undefended = build(discovery.DEFENSE, "none", {})
    attacked = {
        "none, all keypoints (DIA)": (undefended, build(discovery.ATTACK, "dia", {"weights": setting.materials.raw_network})),
        "none, inliers": (undefended, attack),
        "affine, dim 4, inliers": (build(discovery.DEFENSE, "affine", {"dim": 4}), attack),
        f"ldp, {scenes.name(*LDP)}, inliers": (scenes.defense(setting, *LDP), attack),
    }
    return tuple(
        Row(name=name, labels={}, paper={}, defense=defense, attack=by, task=reconstruction(setting))
        for name, (defense, by) in attacked.items()
    )


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    for name, original in scene.originals():
        panels = [Panel(original, "original", "")]
        panels += [scene.panel(row.name, name, row.name, PARTS) for row in rows(scene.setting)]
        yield name, draw(panels, f"Inlier attack; {name}")


DRAWING = Drawing(name="inlier", draw=drawn, rows=rows, place=True)
