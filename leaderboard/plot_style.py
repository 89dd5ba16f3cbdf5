"""How families of defenses are told apart in a plot: by the shapes of marks and the styles of lines first, by colour last.

The colours are Okabe and Ito's, which people with any kind of colour blindness can tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Mark:
    """Of one family: matplotlib's names, and the shape as an SVG path about the origin, some 10 pixels wide."""

    marker: str
    path: str
    colour: str
    line: Any


MARKS = (
    Mark("o", "M5,0A5,5 0 1 1 -5,0A5,5 0 1 1 5,0Z", "#0072b2", "-"),
    Mark("s", "M-4.5,-4.5H4.5V4.5H-4.5Z", "#d55e00", "--"),
    Mark("^", "M0,-5.6L5.4,4.4H-5.4Z", "#009e73", "-."),
    Mark("D", "M0,-6L6,0L0,6L-6,0Z", "#cc79a7", ":"),
    Mark("v", "M0,5.6L5.4,-4.4H-5.4Z", "#56b4e9", (0, (5, 1))),
    Mark("P", "M-1.8,-5.4H1.8V-1.8H5.4V1.8H1.8V5.4H-1.8V1.8H-5.4V-1.8H-1.8Z", "#e69f00", (0, (1, 1))),
    Mark(
        "X", "M-5,-2.6L-2.6,-5L0,-2.4L2.6,-5L5,-2.6L2.4,0L5,2.6L2.6,5L0,2.4L-2.6,5L-5,2.6L-2.4,0Z", "#000000", (0, (3, 1, 1, 1))
    ),
)


def marks(families: Iterable[str]) -> dict[str, Mark]:
    """A mark for each family, in their order; of more than there are marks, some are used again."""
    return {family: MARKS[place % len(MARKS)] for place, family in enumerate(dict.fromkeys(families))}


def place_labels(
    points: Sequence[tuple[float, float]], sizes: Sequence[tuple[float, float]], size: tuple[float, float], gap: float = 9.0
) -> list[tuple[float, float] | None]:
    """Where each label goes so that it covers no point, no other label and no border; None for one that finds no room.

    A label is nearer to its own point than to any other: what stands beside another's would be read as its.

    Parameters
    ----------
    points : (x, y) in pixels, y downward
    sizes : (width, height) of the labels in pixels
    size : (width, height) of the plot
    gap : between a point and its label

    Returns
    -------
    The left end and the middle of each label's height, in the order of the points.
    """
    taken = [_box(x - gap / 2, y, gap, gap) for x, y in points]
    placed: list[tuple[float, float] | None] = []
    for number, ((x, y), (width, height)) in enumerate(zip(points, sizes, strict=True)):
        corners = [(left, y + side * (gap + height) / 2) for side in (-1, 1) for left in (x + gap / 2, x - gap / 2 - width)]
        above = [(x - width / 2, y + side * (gap + height / 2)) for side in (-1, 1)]
        beside = [(x + gap, y), (x - gap - width, y)]
        places = ((place, _box(*place, width, height)) for place in (*corners, *above, *beside))
        chosen, box = next(
            ((at, box) for at, box in places if _free(box, taken, size) and _own(box, number, points)), (None, None)
        )
        if box is not None:
            taken.append(box)
        placed.append(chosen)
    return placed


def _box(left: float, middle: float, width: float, height: float) -> NDArray[np.float64]:
    return np.array([left, middle - height / 2, left + width, middle + height / 2])


def _own(box: NDArray[np.float64], number: int, points: Sequence[tuple[float, float]]) -> bool:
    """Whether no other point is as near to the box as that of the number."""
    at = np.asarray(points)
    away = np.linalg.norm(at - np.clip(at, box[:2], box[2:]), axis=1)
    return bool((away[number] < np.delete(away, number)).all())


def _free(box: NDArray[np.float64], taken: Sequence[NDArray[np.float64]], size: tuple[float, float]) -> bool:
    inside = box[0] >= 0 and box[1] >= 0 and box[2] <= size[0] and box[3] <= size[1]
    return bool(inside) and not any((box[:2] < other[2:]).all() and (other[:2] < box[2:]).all() for other in taken)
