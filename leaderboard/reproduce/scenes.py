"""What the tables of localization share: rows of queries that LDP-Feat privatised, over |K|, ε, m and how they are matched.

Where every |K| is scaled by s, every ε is shifted by ln s (`scale.py`); RANSAC's trials are scaled as well. The row without a
dictionary and without privacy is that of raw descriptors; that with privacy is naive LDP over all descriptors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bench.api import Asset, Dataset, Defense, Task
from bench.codebook.public import REFERENCES
from bench.registry import discovery
from leaderboard.reproduce import scale
from leaderboard.reproduce.profiles import Profile, Setting
from leaderboard.reproduce.study import Measure, Row, build

FULL = "2^1024"  # |K| of all descriptors
TRIALS = 10_000_000  # of RANSAC, in the paper
WITHIN = ("0.25m_2deg", "0.5m_5deg", "5m_10deg")
APART = 10.0  # points of recall; a difference that we ask for

NOTES = (
    "Shares of queries in %. Where |K| is scaled by s, ε is shifted by ln s: the chance that the true word is released stays the "
    "paper's, the guarantee is that of our ε. The paper's place is Aachen; ours stands in the heading.",
    "References are retrieved by the raw descriptors of the query, as in the paper, whose retrieval did not depend on ε.",
)


def queried(profile: Profile) -> Dataset:
    """Whose queries the tables are about, unless another place is named."""
    return profile.place


def task(setting: Setting, trials: int = TRIALS, **given: Any) -> Task:
    """Localization with that many of the paper's trials."""
    return build(discovery.TASK, "localization", {"trials": max(1, round(trials * setting.profile.trials)), **given})


def defense(
    setting: Setting, size: str, epsilon: str, subset: int, dictionary: str = REFERENCES, factor: float | None = None
) -> Defense:
    """What the paper's |K|, ε and m are here; |K| is scaled by `factor`, the profile's for localization if None."""
    if size == FULL:
        if math.isinf(float(epsilon)):
            return build(discovery.DEFENSE, "none", {})
        shifted = float(epsilon)  # nothing to scale
        return build(discovery.DEFENSE, "naive-ldp", {"epsilon": shifted, "subset_size": subset})
    words, shifted = scaled(setting, size, epsilon, factor)
    given = {"epsilon": shifted, "subset_size": subset, "words": words, "dictionary": Asset(dictionary)}
    return build(discovery.DEFENSE, "ldp", given)


def labels(setting: Setting, size: str, epsilon: str, subset: int, factor: float | None = None) -> dict[str, str]:
    """Of a row, for people: the paper's and ours."""
    if size == FULL:
        ours = {"our |K|": "all", "our ε": epsilon}
    else:
        words, shifted = scaled(setting, size, epsilon, factor)
        ours = {"our |K|": f"{words:,}", "our ε": "inf" if math.isinf(shifted) else f"{shifted:.4g}"}
    return {"|K|": size if size == FULL else f"{int(size):,}", "ε": epsilon, "m": str(subset), **ours}


def scaled(setting: Setting, size: str, epsilon: str, factor: float | None = None) -> tuple[int, float]:
    """Our |K| and ε for the paper's."""
    by = setting.profile.place_scale if factor is None else factor
    return scale.words(int(size), by), scale.epsilon(float(epsilon), by)


def name(size: str, epsilon: str, subset: int) -> str:
    """What claims call a row."""
    short = size if size == FULL else f"{int(size) // 1000}k"
    return f"|K| {short}, ε {epsilon}, m {subset}"


def row(setting: Setting, line: Mapping[str, str], paper: Mapping[str, float]) -> Row:
    """A line of Table 2 or S1."""
    size, epsilon, subset = line["database_size"], line["epsilon"], int(line["subset_size"])
    return Row(
        name=name(size, epsilon, subset),
        labels={"group": line["group"], **labels(setting, size, epsilon, subset)},
        paper=paper,
        defense=defense(setting, size, epsilon, subset),
        attack=None,
        task=task(setting),
    )


def measures(**conditions: str | None) -> dict[str, Measure]:
    """The shares within each threshold, by prefix and condition: `recall="day"` makes `recall_0.25m_2deg` of queries by day."""
    return {
        f"{prefix}_{within}": Measure(metric=f"recall_{within}", times=100, digits=1, condition=condition, share=True)
        for prefix, condition in conditions.items()
        for within in WITHIN
    }


def told(condition: str | None = None) -> dict[str, Measure]:
    """Median errors, in the place's unit of length and degrees, and what RANSAC had to do with, means over queries."""
    errors = {
        f"median_{name}": Measure(metric=name, digits=2, condition=condition, median=True)
        for name in ("translation_error", "rotation_error")
    }
    return errors | {name: Measure(metric=name, digits=0, condition=condition) for name in ("matches", "inliers", "trials")}
