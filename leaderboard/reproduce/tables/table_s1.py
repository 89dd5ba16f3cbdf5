"""Table S1: localization by day and by night under LDP-Feat."""

from __future__ import annotations

from collections.abc import Mapping

from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Cell, Claim, Statement, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.scenes import WITHIN
from leaderboard.reproduce.study import Row, Table
from leaderboard.reproduce.tables import table2

DAY, NIGHT = ([f"{when}_{within}" for within in WITHIN] for when in ("day", "night"))


def rows(setting: Setting) -> tuple[Row, ...]:
    found: dict[str, Row] = {}
    for line in published.lines("tableS1_localization_day_night"):
        row = scenes.row(setting, line, published.numbers(line, (*DAY, *NIGHT)))
        found.setdefault(row.name, row)
    return tuple(found.values())


def claims(paper: Mapping[Cell, float]) -> tuple[Claim, ...]:
    by_day, by_night = ({key: value for key, value in paper.items() if key[1] == measure[0]} for measure in (DAY, NIGHT))
    return (
        same_order({**by_day}, scenes.APART, "points of recall by day"),
        same_order({**by_night}, scenes.APART, "points of recall by night"),
        *table2.about(DAY[0]),
        Claim(
            text="Night is worse than day, in every row that localizes by day.",
            statements=tuple(night_is_worse(row) for row, measure in by_day if paper[row, measure] > table2.ZERO),
        ),
    )


def night_is_worse(row: str) -> Statement:
    """Other queries by day than by night."""
    text = f"[{row}] {DAY[0]} > {NIGHT[0]}"
    return Statement(text=text, weights={(row, DAY[0]): 1.0, (row, NIGHT[0]): -1.0}, above=0.0, paired=False)


TABLE = Table(
    name="tableS1",
    title="Table S1: localization by day and by night",
    measures={**scenes.measures(day="day", night="night")},
    rows=rows,
    claims=claims,
    place=scenes.queried,
    ordered=DAY[0],
    notes=scenes.NOTES,
)
