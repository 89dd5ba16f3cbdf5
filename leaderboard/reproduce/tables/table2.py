"""Table 2: localization by day under LDP-Feat, over |K|, ε and m.

The last rows are not in the paper. They retrieve references by the released words alone, which leaks nothing beyond the release.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Claim, Statement, TableEntry, about_equal, at_least, falling, greater, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.scenes import ALL_DESCRIPTORS, THRESHOLDS, format_name
from leaderboard.reproduce.study import Row, Table

PRINTED = tuple(f"recall_{threshold}" for threshold in THRESHOLDS)
MEASURE = PRINTED[0]  # the measure of the claims: recall at the strictest threshold
SIZES = ("128000", "256000", "512000", "1024000")
EPSILONS = ("16", "14", "12", "10")
SUBSETS = (1, 2, 4, 8, 16)
RELEASED_POINTS = (("256000", "inf", 1), *(("256000", epsilon, 2) for epsilon in EPSILONS))  # |K|, ε, m
RELEASED_GROUP = "retrieval by released words (ours)"
TOLERANCE = 5.0  # points of recall; a smaller difference counts as none
ZERO = 2.0  # points of recall; less counts as zero


def build_rows(setting: Setting) -> tuple[Row, ...]:
    rows: dict[str, Row] = {}  # by name, because the paper prints a row in each of its groups
    for line in published.read_rows("table2_localization_day"):
        row = scenes.build_row(setting, line, published.parse_numbers(line, PRINTED))
        rows.setdefault(row.name, row)
    task = scenes.build_task(setting, retrieval="released")
    released = [
        replace(row, name=f"{row.name}, released", labels={**row.labels, "group": RELEASED_GROUP}, paper={}, task=task)
        for row in (rows[format_name(*point)] for point in RELEASED_POINTS)
    ]
    return (*rows.values(), *released)


def build_entry(size: str, epsilon: str, subset: int, measure: str = MEASURE) -> TableEntry:
    return format_name(size, epsilon, subset), measure


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    return (
        same_order({key: value for key, value in paper.items() if key[1] == MEASURE}, scenes.MIN_DIFFERENCE, "points of recall"),
        *build_common_claims(MEASURE),
    )


def build_common_claims(measure: str) -> tuple[Claim, ...]:
    """Return the claims that Tables 2 and S1 share, for one measure."""

    def entry(size: str, epsilon: str, subset: int) -> TableEntry:
        return build_entry(size, epsilon, subset, measure)

    private = [entry(size, "10", 2) for size in SIZES]
    subsets = [entry("256000", "10", subset) for subset in SUBSETS]
    return (
        Claim(
            text="Without privacy accuracy grows with |K|, up to that of raw descriptors.",
            statements=falling([entry(size, "inf", 1) for size in (ALL_DESCRIPTORS, *reversed(SIZES))]),
        ),
        Claim(
            text="At ε = 10 and m = 2 an interior |K| is best: one of the two in the middle is above both ends.",
            statements=state_interior_best(private),
        ),
        Claim(
            text=f"LDP over all descriptors localizes nothing: accuracy equals 0, to within {ZERO:g} points.",
            statements=(
                Statement(
                    text=f"[{format_name(ALL_DESCRIPTORS, '10', 2)}] {measure} < {ZERO:g}",
                    weights={entry(ALL_DESCRIPTORS, "10", 2): 1.0},
                    below=ZERO,
                ),
            ),
        ),
        Claim(
            text="Accuracy grows with ε.",
            statements=tuple(
                statement
                for size, subset in (("512000", 4), ("256000", 2))
                for statement in falling([entry(size, epsilon, subset) for epsilon in EPSILONS])
            ),
        ),
        Claim(
            text=f"Accuracy equals that of the other |K| with the same m/|K|, to within {TOLERANCE:g} points.",
            statements=tuple(
                about_equal(entry("512000", epsilon, 4), entry("256000", epsilon, 2), TOLERANCE) for epsilon in EPSILONS
            ),
        ),
        Claim(
            text="m = 2 and m = 4 are best: above m = 1 and m = 16, and not below m = 8.",
            statements=tuple(
                statement
                for best in subsets[1:3]
                for statement in (greater(best, subsets[0]), greater(best, subsets[4]), at_least(best, subsets[3], TOLERANCE))
            ),
        ),
    )


def state_interior_best(entries: list[TableEntry]) -> tuple[Statement, ...]:
    """Return the statements that the mean of the middle entries is above each end."""
    first, *middle, last = entries
    weights = {entry: 1.0 / len(middle) for entry in middle}
    names = " and ".join(f"[{entry[0]}]" for entry in middle)
    return tuple(
        Statement(text=f"mean of {names} > [{end[0]}]", weights={**weights, end: -1.0}, above=0.0) for end in (first, last)
    )


TABLE = Table(
    name="table2",
    title="Table 2: localization by day",
    measures={**scenes.build_recall_measures(recall="day"), **scenes.build_error_measures("day")},
    build_rows=build_rows,
    build_claims=build_claims,
    dataset=scenes.select_scene,
    rank_measure=MEASURE,
    notes=(*scenes.NOTES, f"The rows `{RELEASED_GROUP}` are not in the paper. They use nothing of the query beyond its release."),
)
