"""Table 3: matchers, dictionaries and RANSAC's trials under LDP-Feat (|K| = 256k, ε = 10, m = 2).

The last row is not in the paper. It retrieves references by the released words alone, which leaks nothing beyond the release.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bench.codebook.public import REFERENCES
from bench.tasks.localization import Localization
from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Claim, TableEntry, falling, greater, same_order
from leaderboard.reproduce.profiles import CPU, Setting
from leaderboard.reproduce.scenes import THRESHOLDS
from leaderboard.reproduce.study import Row, Table

PRINTED = tuple(f"recall_{threshold}" for threshold in THRESHOLDS)
MEASURE = PRINTED[0]
POINT = ("256000", "10", 2)  # |K|, ε, m
MATCHERS = {"mutual-nn": "mutual-nn"}  # the other rows match by words
DICTIONARIES = {"Aachen Ref.": REFERENCES, "Places365": "shipped-clustered"}
SOURCES = {REFERENCES: "references' descriptors", "shipped-clustered": "shipped words"}  # that the words are clustered from
MOST = "10M"  # the trials of the rows that vary something else, in the paper as here
TRIALS = {"10M": 10_000_000, "1M": 1_000_000, "100k": 100_000, "10k": 10_000}
RELEASED = "retrieval by released words"
CPU_TRIALS = {"10M": 100_000, "1M": 30_000, "100k": 10_000, "10k": 3_000}  # of profiles with fewer trials than the paper


def build_rows(setting: Setting) -> tuple[Row, ...]:
    size, epsilon, subset = POINT
    rows = []
    for line in published.read_rows("table3_ablation"):
        variable = line["variable"]
        dictionary = DICTIONARIES.get(variable, REFERENCES)
        trials = variable if variable in TRIALS else MOST
        task = build_task(setting, trials, matcher=MATCHERS.get(variable, "auto"))
        rows.append(
            Row(
                name=variable,
                labels={
                    "ablation": line["ablation"],
                    "variable": variable,
                    **scenes.build_labels(setting, size, epsilon, subset),
                    "clustered from": SOURCES[dictionary],
                    "trials, paper": f"{TRIALS[trials]:,}",
                    "trials, ours": f"{task.trials:,}",
                },
                paper=published.parse_numbers(line, PRINTED),
                defense=scenes.build_defense(setting, size, epsilon, subset, dictionary),
                attack=None,
                task=task,
            )
        )
    ours = replace(
        rows[0],
        name=RELEASED,
        labels={**rows[0].labels, "ablation": "retrieval (ours)", "variable": "released words", "trials, paper": ""},
        paper={},
        task=build_task(setting, MOST, retrieval="released"),
    )
    return (*rows, ours)


def build_task(setting: Setting, trials: str, **configuration: Any) -> Localization:
    """Return the task with the paper's number of trials, or with the number that profile `cpu` scales to CPU_TRIALS."""
    number = TRIALS[trials] if setting.profile.trials == 1 else round(CPU_TRIALS[trials] / CPU.trials)
    return scenes.build_task(setting, trials=number, **configuration)


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    def entry(variable: str) -> TableEntry:
        return variable, MEASURE

    return (
        same_order({key: value for key, value in paper.items() if key[1] == MEASURE}, scenes.MIN_DIFFERENCE, "points of recall"),
        Claim(
            text="Matching by words beats mutual nearest neighbours by far.",
            statements=(greater(entry("voc-match"), entry("mutual-nn")),),
        ),
        Claim(
            text="A dictionary from the references beats a generic one.",
            statements=(greater(entry("Aachen Ref."), entry("Places365")),),
        ),
        Claim(text="More trials of RANSAC help.", statements=falling([entry(variable) for variable in TRIALS])),
    )


TABLE = Table(
    name="table3",
    title="Table 3: ablations of localization by day",
    measures={**scenes.build_recall_measures(recall="day"), **scenes.build_error_measures("day")},
    build_rows=build_rows,
    build_claims=build_claims,
    dataset=scenes.select_scene,
    rank_measure=MEASURE,
    notes=(
        *scenes.NOTES,
        "The columns of trials show the largest number that RANSAC is allowed; the column `trials` shows the mean number made. A "
        "row of ours is comparable with a row of the paper in its order, not in its number of trials.",
        "Both dictionaries are clustered into as many words. That of the row Places365 is clustered from the shipped words of "
        "other photographs, since the descriptors of these photographs are not shipped.",
        "The last row is not in the paper. It retrieves references by the released words alone.",
    ),
)
