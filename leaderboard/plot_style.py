"""Plot styles of families of defenses, which differ in the shape of points, the style of lines and the colour.

The colours are those of Okabe and Ito, which people with any kind of colour blindness can distinguish.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PlotStyle:
    """The style of one family: matplotlib's names, and the shape as an SVG path around the origin, about 10 pixels wide."""

    marker: str
    path: str
    colour: str
    line: Any


STYLES = (
    PlotStyle("o", "M5,0A5,5 0 1 1 -5,0A5,5 0 1 1 5,0Z", "#0072b2", "-"),
    PlotStyle("s", "M-4.5,-4.5H4.5V4.5H-4.5Z", "#d55e00", "--"),
    PlotStyle("^", "M0,-5.6L5.4,4.4H-5.4Z", "#009e73", "-."),
    PlotStyle("D", "M0,-6L6,0L0,6L-6,0Z", "#cc79a7", ":"),
    PlotStyle("v", "M0,5.6L5.4,-4.4H-5.4Z", "#56b4e9", (0, (5, 1))),
    PlotStyle("P", "M-1.8,-5.4H1.8V-1.8H5.4V1.8H1.8V5.4H-1.8V1.8H-5.4V-1.8H-1.8Z", "#e69f00", (0, (1, 1))),
    PlotStyle(
        "X", "M-5,-2.6L-2.6,-5L0,-2.4L2.6,-5L5,-2.6L2.4,0L5,2.6L2.6,5L0,2.4L-2.6,5L-5,2.6L-2.4,0Z", "#000000", (0, (3, 1, 1, 1))
    ),
)


def choose_styles(families: Iterable[str]) -> dict[str, PlotStyle]:
    """Return a style for each family, in their order. Styles repeat if there are more families."""
    return {family: STYLES[index % len(STYLES)] for index, family in enumerate(dict.fromkeys(families))}


def position_labels(
    points: Sequence[tuple[float, float]], sizes: Sequence[tuple[float, float]], size: tuple[float, float], gap: float = 9.0
) -> list[tuple[float, float] | None]:
    """Return a position for each label, at which it covers no point, no other label and no border; None if there is no room.

    A label is nearer to its own point than to any other point.

    Parameters
    ----------
    points : (x, y) in pixels, y downward
    sizes : (width, height) of the labels in pixels
    size : (width, height) of the plot
    gap : between a point and its label

    Returns
    -------
    (x, y) of the middle of each label's left edge, in the order of the points.
    """
    occupied = [_box(x - gap / 2, y, gap, gap) for x, y in points]
    positions: list[tuple[float, float] | None] = []
    for number, ((x, y), (width, height)) in enumerate(zip(points, sizes, strict=True)):
        corners = [(left, y + side * (gap + height) / 2) for side in (-1, 1) for left in (x + gap / 2, x - gap / 2 - width)]
        above = [(x - width / 2, y + side * (gap + height / 2)) for side in (-1, 1)]
        beside = [(x + gap, y), (x - gap - width, y)]
        boxes = ((position, _box(*position, width, height)) for position in (*corners, *above, *beside))
        position, box = next(
            (one for one in boxes if _is_free(one[1], occupied, size) and _is_nearest(one[1], number, points)), (None, None)
        )
        if box is not None:
            occupied.append(box)
        positions.append(position)
    return positions


def _box(left: float, middle: float, width: float, height: float) -> NDArray[np.float64]:
    return np.array([left, middle - height / 2, left + width, middle + height / 2])


def _is_nearest(box: NDArray[np.float64], number: int, points: Sequence[tuple[float, float]]) -> bool:
    """Return whether the point with this number is nearer to the box than all others."""
    positions = np.asarray(points)
    distances = np.linalg.norm(positions - np.clip(positions, box[:2], box[2:]), axis=1)
    return bool((distances[number] < np.delete(distances, number)).all())


def _is_free(box: NDArray[np.float64], occupied: Sequence[NDArray[np.float64]], size: tuple[float, float]) -> bool:
    inside = box[0] >= 0 and box[1] >= 0 and box[2] <= size[0] and box[3] <= size[1]
    return bool(inside) and not any((box[:2] < other[2:]).all() and (other[:2] < box[2:]).all() for other in occupied)
