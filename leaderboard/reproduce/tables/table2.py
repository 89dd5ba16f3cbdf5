"""Table 2: localization by day under LDP-Feat, over |K|, ε and m."""

from __future__ import annotations

from collections.abc import Mapping

from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Cell, Claim, Statement, about_equal, at_least, falling, greater, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.scenes import FULL, WITHIN, name
from leaderboard.reproduce.study import Row, Table

PRINTED = tuple(f"recall_{within}" for within in WITHIN)
MEASURE = PRINTED[0]  # what claims are about: the strictest threshold
SIZES = ("128000", "256000", "512000", "1024000")
EPSILONS = ("16", "14", "12", "10")
SUBSETS = (1, 2, 4, 8, 16)
NEARLY = 5.0  # points of recall that are nothing
ZERO = 2.0  # points of recall that are as good as none


def rows(setting: Setting) -> tuple[Row, ...]:
    found: dict[str, Row] = {}  # the paper prints a row in each group that it belongs to; it is one row
    for line in published.lines("table2_localization_day"):
        row = scenes.row(setting, line, published.numbers(line, PRINTED))
        found.setdefault(row.name, row)
    return tuple(found.values())


def cell(size: str, epsilon: str, subset: int, measure: str = MEASURE) -> Cell:
    return name(size, epsilon, subset), measure


def claims(paper: Mapping[Cell, float]) -> tuple[Claim, ...]:
    return (
        same_order({key: value for key, value in paper.items() if key[1] == MEASURE}, scenes.APART, "points of recall"),
        *about(MEASURE),
    )


def about(measure: str) -> tuple[Claim, ...]:
    """What the paper says of the rows, for one measure."""

    def at(size: str, epsilon: str, subset: int) -> Cell:
        return cell(size, epsilon, subset, measure)

    private = [at(size, "10", 2) for size in SIZES]
    subsets = [at("256000", "10", subset) for subset in SUBSETS]
    return (
        Claim(
            text="Without privacy accuracy grows with |K|, up to that of raw descriptors.",
            statements=falling([at(size, "inf", 1) for size in (FULL, *reversed(SIZES))]),
        ),
        Claim(
            text="At ε = 10 and m = 2 an interior |K| is best: one of the two in the middle is above both ends.",
            statements=interior(private),
        ),
        Claim(
            text=f"LDP over all descriptors localizes nothing: accuracy equals 0, to within {ZERO:g} points.",
            statements=(
                Statement(text=f"[{private_name()}] {measure} < {ZERO:g}", weights={at(FULL, "10", 2): 1.0}, below=ZERO),
            ),
        ),
        Claim(
            text="Accuracy grows with ε.",
            statements=tuple(
                statement
                for size, subset in (("512000", 4), ("256000", 2))
                for statement in falling([at(size, epsilon, subset) for epsilon in EPSILONS])
            ),
        ),
        Claim(
            text=f"Where m/|K| is equal, accuracy equals, to within {NEARLY:g} points.",
            statements=tuple(about_equal(at("512000", epsilon, 4), at("256000", epsilon, 2), NEARLY) for epsilon in EPSILONS),
        ),
        Claim(
            text="m = 2 and m = 4 are best: above m = 1 and m = 16, and not below m = 8.",
            statements=tuple(
                statement
                for best in subsets[1:3]
                for statement in (greater(best, subsets[0]), greater(best, subsets[4]), at_least(best, subsets[3], NEARLY))
            ),
        ),
    )


def interior(cells: list[Cell]) -> tuple[Statement, ...]:
    """The mean of the two in the middle is above each end."""
    first, *middle, last = cells
    weights = {cell: 1.0 / len(middle) for cell in middle}
    names = " and ".join(f"[{cell[0]}]" for cell in middle)
    return tuple(
        Statement(text=f"mean of {names} > [{end[0]}]", weights={**weights, end: -1.0}, above=0.0) for end in (first, last)
    )


def private_name() -> str:
    return name(FULL, "10", 2)


TABLE = Table(
    name="table2",
    title="Table 2: localization by day",
    measures={**scenes.measures(recall="day"), **scenes.told("day")},
    rows=rows,
    claims=claims,
    place=scenes.queried,
    ordered=MEASURE,
    notes=scenes.NOTES,
)
