"""The privacy–utility plot of the page: the coordinates of points, labels, ticks and the Pareto front for a template."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from leaderboard.intervals import Interval
from leaderboard.plot_style import PlotStyle, position_labels
from leaderboard.plots import choose_family_styles, label_points
from leaderboard.tables import format_number
from leaderboard.tradeoff import Point, Tradeoff

WIDTH, HEIGHT = 520, 380  # of the whole, in the units of its viewBox
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 12, 48  # margins of the plot in it
LETTER = 7.4, 14.0  # width and height of a letter of a label
TICKS = 5
MARGIN = 0.12  # of the plot, around the points


@dataclass(frozen=True, kw_only=True)
class Tick:
    position: float
    text: str


@dataclass(frozen=True, kw_only=True)
class Spot:
    """A point in the coordinates of the plot."""

    point: Point
    x: float
    y: float
    bars: tuple[tuple[float, float, float, float], ...]  # lines of its intervals: x1, y1, x2, y2
    style: PlotStyle
    description: str  # for screen readers
    label: str
    label_position: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class Chart:
    """One plot."""

    tradeoff: Tradeoff
    spots: tuple[Spot, ...]
    across: tuple[Tick, ...]
    up: tuple[Tick, ...]
    front: str  # the d of an SVG path
    legend: tuple[tuple[str, PlotStyle], ...]
    baselines: tuple[Tick, ...]  # their scores
    width: int = WIDTH
    height: int = HEIGHT
    box: tuple[int, int, int, int] = (LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM)  # left, top, right, bottom of the plot


@dataclass(frozen=True)
class Scale:
    """A linear scale from values to coordinates."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        return round(self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start), 1)

    def ticks(self) -> tuple[Tick, ...]:
        from matplotlib.ticker import MaxNLocator

        values = MaxNLocator(TICKS, steps=[1, 2, 5, 10]).tick_values(self.low, self.high)
        decimals = max(0, -math.floor(math.log10(values[1] - values[0]) + 1e-9))
        return tuple(
            Tick(position=self(value), text=f"{value:.{decimals}f}") for value in values if self.low <= value <= self.high
        )


def build_charts(tradeoffs: Sequence[Tradeoff]) -> list[Chart]:
    """Return the charts of one group. Those of one measure have the same scales, so that they can be compared."""
    by_measure: dict[str, list[Tradeoff]] = {}
    for tradeoff in tradeoffs:
        if tradeoff.points:
            by_measure.setdefault(tradeoff.privacy.name, []).append(tradeoff)
    return [chart for members in by_measure.values() for chart in _build_comparable_charts(members)]


def _build_comparable_charts(tradeoffs: Sequence[Tradeoff]) -> list[Chart]:
    points = [point for tradeoff in tradeoffs for point in tradeoff.points]
    x = _fit_scale([point.utility for point in points], LEFT, WIDTH - RIGHT)
    baselines = [score for tradeoff in tradeoffs for score in tradeoff.baselines.values()]
    levels = [Interval(score, -math.inf, math.inf, 1) for score in baselines]
    y = _fit_scale([*(point.privacy for point in points), *levels], HEIGHT - BOTTOM, TOP)
    return [_build_chart(tradeoff, x, y) for tradeoff in tradeoffs]


def _build_chart(tradeoff: Tradeoff, x: Scale, y: Scale) -> Chart:
    positions = [(x(point.utility.mean), y(point.privacy.mean)) for point in tradeoff.points]
    texts = label_points(tradeoff)
    labels = position_labels(
        [(across - LEFT, up - TOP) for across, up in positions],
        [(LETTER[0] * len(text), LETTER[1]) for text in texts],
        (WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM),
        gap=11.0,
    )
    styles = choose_family_styles(tradeoff)
    spots = tuple(
        Spot(
            point=point,
            x=position[0],
            y=position[1],
            bars=_draw_bars(point, x, y),
            style=styles[point.standing.configuration["name"]],
            description=_describe(tradeoff, point),
            label=text,
            label_position=label and (round(label[0] + LEFT, 1), round(label[1] + TOP, 1)),
        )
        for point, position, text, label in zip(tradeoff.points, positions, texts, labels, strict=True)
    )
    return Chart(
        tradeoff=tradeoff,
        spots=spots,
        across=x.ticks(),
        up=y.ticks(),
        front=_draw_front(tradeoff.front, x, y),
        legend=tuple(styles.items()),
        baselines=tuple(Tick(position=y(score), text=name) for name, score in tradeoff.baselines.items()),
    )


def _fit_scale(values: Sequence[Interval], start: float, end: float) -> Scale:
    """Return a scale that shows all means and intervals, with some room around the means."""
    means = [value.mean for value in values]
    room = (max(means) - min(means)) * MARGIN or 0.05
    low = min([min(means) - room, *(value.low for value in values if math.isfinite(value.low))])
    high = max([max(means) + room, *(value.high for value in values if math.isfinite(value.high))])
    return Scale(low, high, start, end)


def _draw_bars(point: Point, x: Scale, y: Scale) -> tuple[tuple[float, float, float, float], ...]:
    across, up, bars = point.utility, point.privacy, []
    if math.isfinite(across.low):
        bars.append((x(across.low), y(up.mean), x(across.high), y(up.mean)))
    if math.isfinite(up.low):
        bars.append((x(across.mean), y(up.low), x(across.mean), y(up.high)))
    return tuple(bars)


def _draw_front(front: Sequence[Point], x: Scale, y: Scale) -> str:
    """Return an SVG path, up and then across: what is further right costs as much as the next point of the front."""
    path = ""
    for point in front:
        across, up = x(point.utility.mean), y(point.privacy.mean)
        path += f"V{up}H{across}" if path else f"M{across},{up}"
    return path


def _describe(tradeoff: Tradeoff, point: Point) -> str:
    standing = point.standing
    rank = f"rank {standing.rank}" if standing.rank is not None else f"unranked: {standing.unranked_reason}"
    return (
        f"{standing.defense}, {rank}: {tradeoff.utility.label} {format_number(point.utility.mean)}, "
        f"{tradeoff.privacy.label} {format_number(point.privacy.mean)} by {point.attack_experiment.attack}"
        + (", on the Pareto front" if point.on_front else "")
    )
