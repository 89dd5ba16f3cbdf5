"""Table 3: how LDP-Feat is matched, where its dictionary is from, and how long RANSAC tries (|K| = 256k, ε = 10, m = 2).

A row of ours comes last: references retrieved by the released words alone, which leak nothing beyond the release.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Cell, Claim, falling, greater, same_order
from leaderboard.reproduce.profiles import CPU, Setting
from leaderboard.reproduce.scenes import WITHIN
from leaderboard.reproduce.study import Row, Table

PRINTED = tuple(f"recall_{within}" for within in WITHIN)
MEASURE = PRINTED[0]
POINT = ("256000", "10", 2)  # |K|, ε, m
MATCHERS = {"mutual-nn": "mutual-nn"}  # others by words, as in Table 2, so that rows are shared
DICTIONARIES = {"Aachen Ref.": "references", "Places365": "shipped"}
TRIALS = {"10M": 10_000_000, "1M": 1_000_000, "100k": 100_000, "10k": 10_000}
RELEASED = "retrieval by released words"
CPU_TRIALS = {"10M": 100_000, "1M": 30_000, "100k": 10_000, "10k": 3_000}  # a profile that cannot make the paper's makes these


def rows(setting: Setting) -> tuple[Row, ...]:
    size, epsilon, subset = POINT
    found = []
    for line in published.lines("table3_ablation"):
        variable = line["variable"]
        dictionary = DICTIONARIES.get(variable, "references")
        task = scenes.task(setting, matcher=MATCHERS.get(variable, "auto"), **_trials(setting, variable))
        found.append(
            Row(
                name=variable,
                labels={"ablation": line["ablation"], "variable": variable, **scenes.labels(setting, size, epsilon, subset)},
                paper=published.numbers(line, PRINTED),
                defense=scenes.defense(setting, size, epsilon, subset, dictionary),
                attack=None,
                task=task,
            )
        )
    ours = replace(
        found[0],
        name=RELEASED,
        labels={**found[0].labels, "ablation": "retrieval (ours)", "variable": "released words"},
        paper={},
        task=scenes.task(setting, retrieval="released"),
    )
    return (*found, ours)


def _trials(setting: Setting, variable: str) -> dict[str, int]:
    """The paper's trials, or those that come to CPU_TRIALS at the share that profile cpu makes of the paper's."""
    if variable not in TRIALS:
        return {}
    return {"trials": TRIALS[variable] if setting.profile.trials == 1 else round(CPU_TRIALS[variable] / CPU.trials)}


def claims(paper: Mapping[Cell, float]) -> tuple[Claim, ...]:
    def cell(variable: str) -> Cell:
        return variable, MEASURE

    return (
        same_order({key: value for key, value in paper.items() if key[1] == MEASURE}, scenes.APART, "points of recall"),
        Claim(
            text="Matching by words beats mutual nearest neighbours by far.",
            statements=(greater(cell("voc-match"), cell("mutual-nn")),),
        ),
        Claim(
            text="A dictionary from the references beats a generic one.",
            statements=(greater(cell("Aachen Ref."), cell("Places365")),),
        ),
        Claim(text="More trials of RANSAC help.", statements=falling([cell(variable) for variable in TRIALS])),
    )


TABLE = Table(
    name="table3",
    title="Table 3: ablations of localization by day",
    measures={**scenes.measures(recall="day"), **scenes.told("day")},
    rows=rows,
    claims=claims,
    place=scenes.queried,
    ordered=MEASURE,
    notes=(
        *scenes.NOTES,
        "The last row is ours, and no row of the paper: there, references are retrieved by the released words alone.",
    ),
)
