"""Table 3: matchers, dictionaries and RANSAC's trials under LDP-Feat (|K| = 256k, ε = 10, m = 2).

The last row is not in the paper. It retrieves references by the released words alone, which leaks nothing beyond the release.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Claim, TableEntry, falling, greater, same_order
from leaderboard.reproduce.profiles import CPU, Setting
from leaderboard.reproduce.scenes import THRESHOLDS
from leaderboard.reproduce.study import Row, Table

PRINTED = tuple(f"recall_{threshold}" for threshold in THRESHOLDS)
MEASURE = PRINTED[0]
POINT = ("256000", "10", 2)  # |K|, ε, m
MATCHERS = {"mutual-nn": "mutual-nn"}  # the other rows match by words and use the records of Table 2
DICTIONARIES = {"Aachen Ref.": "references", "Places365": "shipped"}
TRIALS = {"10M": 10_000_000, "1M": 1_000_000, "100k": 100_000, "10k": 10_000}
RELEASED = "retrieval by released words"
CPU_TRIALS = {"10M": 100_000, "1M": 30_000, "100k": 10_000, "10k": 3_000}  # of profiles with fewer trials than the paper


def build_rows(setting: Setting) -> tuple[Row, ...]:
    size, epsilon, subset = POINT
    rows = []
    for line in published.read_rows("table3_ablation"):
        variable = line["variable"]
        dictionary = DICTIONARIES.get(variable, "references")
        task = scenes.build_task(setting, matcher=MATCHERS.get(variable, "auto"), **_scale_trials(setting, variable))
        rows.append(
            Row(
                name=variable,
                labels={
                    "ablation": line["ablation"],
                    "variable": variable,
                    **scenes.build_labels(setting, size, epsilon, subset),
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
        labels={**rows[0].labels, "ablation": "retrieval (ours)", "variable": "released words"},
        paper={},
        task=scenes.build_task(setting, retrieval="released"),
    )
    return (*rows, ours)


def _scale_trials(setting: Setting, variable: str) -> dict[str, int]:
    """Return the paper's trials, or the number that profile `cpu` scales to CPU_TRIALS."""
    if variable not in TRIALS:
        return {}
    return {"trials": TRIALS[variable] if setting.profile.trials == 1 else round(CPU_TRIALS[variable] / CPU.trials)}


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
    dataset=scenes.select_gallery,
    rank_measure=MEASURE,
    notes=(
        *scenes.NOTES,
        "The last row is not in the paper. It retrieves references by the released words alone.",
    ),
)
