"""Table S1: localization by day and by night under LDP-Feat."""

from __future__ import annotations

from collections.abc import Mapping

from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Claim, Statement, TableEntry, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.scenes import THRESHOLDS
from leaderboard.reproduce.study import Row, Table
from leaderboard.reproduce.tables import table2

DAY, NIGHT = ([f"{time}_{threshold}" for threshold in THRESHOLDS] for time in ("day", "night"))


def build_rows(setting: Setting) -> tuple[Row, ...]:
    rows: dict[str, Row] = {}
    for line in published.read_rows("tableS1_localization_day_night"):
        row = scenes.build_row(setting, line, published.parse_numbers(line, (*DAY, *NIGHT)))
        rows.setdefault(row.name, row)
    return tuple(rows.values())


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    by_day, by_night = ({key: value for key, value in paper.items() if key[1] == measure[0]} for measure in (DAY, NIGHT))
    return (
        same_order({**by_day}, scenes.MIN_DIFFERENCE, "points of recall by day"),
        same_order({**by_night}, scenes.MIN_DIFFERENCE, "points of recall by night"),
        *table2.build_common_claims(DAY[0]),
        Claim(
            text="Night is worse than day, in every row that localizes by day.",
            statements=tuple(state_night_worse(row) for row, measure in by_day if paper[row, measure] > table2.ZERO),
        ),
    )


def state_night_worse(row: str) -> Statement:
    """Return the statement that a row localizes fewer queries by night. Unpaired: day and night have different queries."""
    text = f"[{row}] {DAY[0]} > {NIGHT[0]}"
    return Statement(text=text, weights={(row, DAY[0]): 1.0, (row, NIGHT[0]): -1.0}, above=0.0, paired=False)


TABLE = Table(
    name="tableS1",
    title="Table S1: localization by day and by night",
    measures={**scenes.build_recall_measures(day="day", night="night")},
    build_rows=build_rows,
    build_claims=build_claims,
    dataset=scenes.select_scene,
    rank_measure=DAY[0],
    notes=(
        *scenes.NOTES,
        "Queries by night have more noise and blur than those by day. The amounts were chosen by raw descriptors alone, so that "
        "they localize about half of such queries within 0.25 m and 2°, as in the paper, in a gallery of another seed.",
    ),
)
