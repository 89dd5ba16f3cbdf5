"""The privacy–utility plot as numbers that a template draws: where each point, label, tick and the Pareto front lie."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from leaderboard.intervals import Interval
from leaderboard.plot_style import Mark, place_labels
from leaderboard.plots import family_marks, settings
from leaderboard.tables import number
from leaderboard.tradeoff import Point, Tradeoff

WIDTH, HEIGHT = 520, 380  # of the whole, in the units of its viewBox
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 12, 48  # margins of the plot in it
LETTER = 7.4, 14.0  # width and height of a letter of a label
TICKS = 5
MARGIN = 0.12  # of the plot, around the points


@dataclass(frozen=True, kw_only=True)
class Tick:
    at: float
    text: str


@dataclass(frozen=True, kw_only=True)
class Spot:
    """A point as it is drawn."""

    point: Point
    x: float
    y: float
    bars: tuple[tuple[float, float, float, float], ...]  # lines of its intervals: x1, y1, x2, y2
    mark: Mark
    told: str  # for who does not see it
    label: str
    label_at: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class Chart:
    """One plot."""

    found: Tradeoff
    spots: tuple[Spot, ...]
    across: tuple[Tick, ...]
    up: tuple[Tick, ...]
    front: str  # the d of an SVG path
    legend: tuple[tuple[str, Mark], ...]
    width: int = WIDTH
    height: int = HEIGHT
    box: tuple[int, int, int, int] = (LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM)  # left, top, right, bottom of the plot


@dataclass(frozen=True)
class Scale:
    """A linear scale from values to places."""

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
        return tuple(Tick(at=self(value), text=f"{value:.{decimals}f}") for value in values if self.low <= value <= self.high)


def charts(found: Sequence[Tradeoff]) -> list[Chart]:
    """Lay the plots of one board out, side by side on the same scales, so that they can be compared."""
    points = [point for one in found for point in one.points]
    if not points:
        return []
    x = _scale([point.utility for point in points], LEFT, WIDTH - RIGHT)
    y = _scale([point.privacy for point in points], HEIGHT - BOTTOM, TOP)
    return [_chart(one, x, y) for one in found]


def _chart(found: Tradeoff, x: Scale, y: Scale) -> Chart:
    places = [(x(point.utility.mean), y(point.privacy.mean)) for point in found.points]
    texts = settings(found)
    labels = place_labels(
        [(across - LEFT, up - TOP) for across, up in places],
        [(LETTER[0] * len(text), LETTER[1]) for text in texts],
        (WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM),
        gap=11.0,
    )
    chosen = family_marks(found)
    spots = tuple(
        Spot(
            point=point,
            x=place[0],
            y=place[1],
            bars=_bars(point, x, y),
            mark=chosen[point.standing.configuration["name"]],
            told=_told(found, point),
            label=text,
            label_at=label and (round(label[0] + LEFT, 1), round(label[1] + TOP, 1)),
        )
        for point, place, text, label in zip(found.points, places, texts, labels, strict=True)
    )
    return Chart(
        found=found, spots=spots, across=x.ticks(), up=y.ticks(), front=_steps(found.front, x, y), legend=tuple(chosen.items())
    )


def _scale(values: Sequence[Interval], start: float, end: float) -> Scale:
    """Of all means and intervals, with some room around the means."""
    means = [value.mean for value in values]
    room = (max(means) - min(means)) * MARGIN or 0.05
    low = min([min(means) - room, *(value.low for value in values if math.isfinite(value.low))])
    high = max([max(means) + room, *(value.high for value in values if math.isfinite(value.high))])
    return Scale(low, high, start, end)


def _bars(point: Point, x: Scale, y: Scale) -> tuple[tuple[float, float, float, float], ...]:
    across, up, bars = point.utility, point.privacy, []
    if math.isfinite(across.low):
        bars.append((x(across.low), y(up.mean), x(across.high), y(up.mean)))
    if math.isfinite(up.low):
        bars.append((x(across.mean), y(up.low), x(across.mean), y(up.high)))
    return tuple(bars)


def _steps(front: Sequence[Point], x: Scale, y: Scale) -> str:
    """Up and then across: what is further right costs as much as the next point of the front."""
    path = ""
    for point in front:
        across, up = x(point.utility.mean), y(point.privacy.mean)
        path += f"V{up}H{across}" if path else f"M{across},{up}"
    return path


def _told(found: Tradeoff, point: Point) -> str:
    standing = point.standing
    rank = f"rank {standing.rank}" if standing.rank is not None else "unranked"
    return (
        f"{standing.defense}, {rank}: {found.utility.label} {number(point.utility.mean)}, "
        f"{found.privacy.label} {number(point.privacy.mean)} by {point.cell.attack}"
        + (", on the Pareto front" if point.best else "")
    )
