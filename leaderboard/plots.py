"""Plots of boards, for print, for grey, and for people who tell few colours: marks and line styles differ, not colour alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from bench.core.hashing import canonical
from leaderboard.comparison import Board
from leaderboard.figures import drawable
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, measures
from leaderboard.plot_style import Mark, marks, place_labels
from leaderboard.ranking import Standing, standings
from leaderboard.tables import labels, setting
from leaderboard.tradeoff import Tradeoff

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRADEOFF = "tradeoff"  # begins the names of the plots that the page draws itself
BRIEF = 48  # letters of a label
ROW = 0.3  # inches a defense
LETTER = 3.9, 9.0  # points that a letter of a label is wide and high


def plots(board: Board, found: Sequence[Tradeoff]) -> Iterator[tuple[str, Figure]]:
    """Name and figure of each plot of a board of attacks."""
    ranked = standings(board)
    if any(one.score for one in ranked):
        yield "attacks", attacks(board, ranked)
    if curves := _curves(ranked):
        yield "epsilon", epsilon(board, curves)
    several = len({one.served.key for one in found}) > 1
    for one in found:
        yield "-".join(filter(None, (TRADEOFF, one.condition, one.served.key[:8] if several else None))), tradeoff(one)


def tradeoff(found: Tradeoff) -> Figure:
    """Every defense and setting: its utility to the right, what the strongest attack sees upwards; with the Pareto front."""
    figure, axes = _axes(7.2, 4.6, found.caption)
    for family, mark in family_marks(found).items():
        of_it = [point for point in found.points if point.standing.configuration["name"] == family]
        for ranked, label in ((True, family), (False, f"{family}, unranked")):
            at = [(point.utility, point.privacy) for point in of_it if (point.standing.rank is not None) == ranked]
            _scatter(axes, at, mark, filled=ranked, label=label)
    # Between two settings of the front, what the further one costs is the least that buys more than the nearer one gives.
    x, y = [point.utility.mean for point in found.front], [point.privacy.mean for point in found.front]
    axes.plot(x, y, color="0.35", lw=1, ls=(0, (4, 2)), drawstyle="steps-pre", zorder=1, label="Pareto front")
    axes.set_xlabel(f"{found.utility.label} →", fontsize=9)
    axes.set_ylabel(f"{found.privacy.label} of the strongest attack →", fontsize=9)
    axes.margins(0.12)
    axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    figure.draw_without_rendering()  # so that it is known where the points lie
    _write_settings(axes, found)
    return figure


def attacks(board: Board, ranked: Sequence[Standing]) -> Figure:
    """What every attack brings back of every defense, a line a defense, with intervals."""
    (privacy,) = measures([PRIVACY])
    names = list(dict.fromkeys(cell.attack for one in ranked for cell in one.cells if board.average(cell, privacy)))
    height = ROW * len(ranked) * max(1.0, len(names) / 3)
    figure, axes = _axes(
        9.0, 1.2 + height, f"{', '.join([board.title, *board.facts[:3]])}. Filled: the strongest attack on that defense"
    )
    for place, (name, mark) in enumerate(marks(names).items()):
        beside = (place - (len(names) - 1) / 2) / (len(names) + 1)
        for filled in (True, False):
            at = [
                (score, Interval(row + beside, -math.inf, math.inf, 1))
                for row, one in enumerate(ranked)
                for cell in one.cells
                if cell.attack == name and (cell is one.strongest) == filled and (score := board.average(cell, privacy))
            ]
            _scatter(axes, at, mark, filled=filled, label=None)
        axes.plot([], [], mark.marker, color=mark.colour, mfc="white", label=_brief(name))
    axes.set_yticks(range(len(ranked)), [_ranked(one) for one in ranked], fontsize=8)
    axes.set_ylim(len(ranked) - 0.5, -0.5)
    axes.set_xlabel(f"{privacy.label} →", fontsize=9)
    axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def epsilon(board: Board, curves: dict[str, list[Standing]]) -> Figure:
    """What the strongest attack sees, over ε of a descriptor."""
    (privacy,) = measures([PRIVACY])
    figure, axes = _axes(5.6, 3.6, ", ".join([board.title, *board.facts[:3]]))
    for (label, curve), mark in zip(curves.items(), marks(curves).values(), strict=True):
        at = [_epsilon(one) for one in curve]
        scores = [one.score for one in curve if one.score]
        axes.plot(
            at,
            [score.mean for score in scores],
            color=mark.colour,
            marker=mark.marker,
            ls=mark.line,
            ms=5,
            lw=1.3,
            label=_brief(label),
        )
        low, high = [score.low for score in scores], [score.high for score in scores]
        if all(map(math.isfinite, low)):
            axes.fill_between(at, low, high, color=mark.colour, alpha=0.12, lw=0)
    axes.set_xlabel("ε of a descriptor", fontsize=9)
    axes.set_ylabel(f"{privacy.label} of the strongest attack", fontsize=9)
    axes.legend(fontsize=7, frameon=False)
    return figure


def family_marks(found: Tradeoff) -> dict[str, Mark]:
    """The names of the defenses, and how each is marked."""
    return marks(sorted({point.standing.configuration["name"] for point in found.points}))


def settings(found: Tradeoff) -> list[str]:
    """What stands at each point: the defense's name, and those of its fields that differ among the points, `ldp ε 10`."""
    configurations = [point.standing.configuration for point in found.points]
    texts = []
    for one in configurations:
        same_family = [other for other in configurations if other["name"] == one["name"]]
        differing = [name for name in one if len({canonical(other.get(name)) for other in same_family}) > 1]
        texts.append(
            " ".join([one["name"], *(f"{'ε' if name == 'epsilon' else name} {setting(one[name])}" for name in differing)])
        )
    return texts


def _curves(ranked: Sequence[Standing]) -> dict[str, list[Standing]]:
    """Settings that differ in ε alone, at least two of them: defense without ε -> by ε."""
    found: dict[str, list[Standing]] = {}
    for one in ranked:
        if one.rank is not None and math.isfinite(_epsilon(one)):
            fixed = {name: value for name, value in one.configuration.items() if name != "epsilon"}
            found.setdefault(labels([(fixed, None)])[0][0], []).append(one)
    return {label: sorted(curve, key=_epsilon) for label, curve in found.items() if len({_epsilon(one) for one in curve}) > 1}


def _epsilon(standing: Standing) -> float:
    told = standing.cells[0].head["privacy"]["epsilon_descriptor"]
    return math.nan if told is None else float(told)


def _axes(width: float, height: float, title: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    axes = figure.subplots()
    axes.set_title(drawable(title), fontsize=8, loc="left", wrap=True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.25, lw=0.5)
    axes.set_axisbelow(True)
    return figure, axes


def _scatter(axes: Axes, at: Sequence[tuple[Interval, Interval]], mark: Mark, *, filled: bool, label: str | None) -> None:
    """Marks with thin lines for the intervals, where there are any."""
    if not at:
        return
    across, up = [one for one, _ in at], [other for _, other in at]
    axes.errorbar(
        [value.mean for value in across],
        [value.mean for value in up],
        xerr=_reach(across),
        yerr=_reach(up),
        fmt=mark.marker,
        color=mark.colour,
        mfc=mark.colour if filled else "white",
        ms=6,
        lw=0.7,
        label=label and _brief(label),
        zorder=3,
    )


def _reach(values: Sequence[Interval]) -> tuple[list[float], list[float]]:
    low = [value.mean - value.low if math.isfinite(value.low) else 0.0 for value in values]
    return [max(0.0, one) for one in low], [max(0.0, v.high - v.mean) if math.isfinite(v.high) else 0.0 for v in values]


def _write_settings(axes: Axes, found: Tradeoff) -> None:
    """Write the settings beside the points, where there is room."""
    size = (axes.bbox.width * 72 / axes.figure.dpi, axes.bbox.height * 72 / axes.figure.dpi)  # in points
    means = [(point.utility.mean, point.privacy.mean) for point in found.points]
    within = axes.transAxes.inverted().transform(axes.transData.transform(means))  # (n, 2) from 0 to 1
    points = [(x * size[0], (1 - y) * size[1]) for x, y in within]
    texts = settings(found)
    sizes = [(LETTER[0] * min(len(text), BRIEF), LETTER[1]) for text in texts]
    for text, place in zip(texts, place_labels(points, sizes, size), strict=True):
        if place:
            left, up = place[0] / size[0], 1 - place[1] / size[1]
            axes.text(left, up, _brief(text), fontsize=7, color="0.2", va="center", transform=axes.transAxes)


def _ranked(standing: Standing) -> str:
    return _brief(f"{standing.rank}  {standing.defense}" if standing.rank is not None else f"unranked  {standing.defense}")


def _brief(text: str) -> str:
    """Text that leaves room for the plot."""
    return drawable(text if len(text) <= BRIEF else text[: BRIEF - 1] + "…")
