"""Rows and measures of the localization tables: queries under LDP-Feat, over |K|, ε, m and the matcher.

Each |K| is scaled by s and ln s is added to each ε (`scale.py`). RANSAC's trials are scaled as well. With |K| = 2^1024, the row
without privacy (ε = ∞) uses raw descriptors, and the row with privacy uses naive LDP on all descriptors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bench.api import Dataset, Defense
from bench.codebook.public import REFERENCES
from bench.registry import discovery
from bench.settings import Asset
from bench.tasks.localization import Localization
from leaderboard.reproduce import scale
from leaderboard.reproduce.profiles import Profile, Setting
from leaderboard.reproduce.study import Measure, Row, build_plugin

ALL_DESCRIPTORS = "2^1024"  # |K| of all descriptors
TRIALS = 10_000_000  # RANSAC's trials in the paper
THRESHOLDS = ("0.25m_2deg", "0.5m_5deg", "5m_10deg")
MIN_DIFFERENCE = 10.0  # points of recall

NOTES = (
    "Recall in % of queries. Where |K| is scaled by s, ε is shifted by ln s: the chance that the true word is released stays the "
    "paper's, the guarantee is that of our ε. The paper's scene is Aachen; ours is in the heading.",
    "References are retrieved by the raw descriptors of the query, as in the paper, whose retrieval did not depend on ε.",
    "A query that the server rejects for its intrinsics counts as not localized; a note on the row states the number.",
)


def select_scene(profile: Profile) -> Dataset:
    """Return the default dataset of the localization tables, which share their records."""
    return profile.hard_night


def build_task(setting: Setting, trials: int = TRIALS, **configuration: Any) -> Localization:
    """Return the localization task. `trials` is the number in the paper, which the profile scales."""
    return Localization(trials=max(1, round(trials * setting.profile.trials)), **configuration)


def build_defense(
    setting: Setting, size: str, epsilon: str, subset: int, dictionary: str = REFERENCES, factor: float | None = None
) -> Defense:
    """Return the defense for the paper's |K|, ε and m. |K| is scaled by `factor`, by default the profile's `gallery_scale`."""
    if size == ALL_DESCRIPTORS:
        if math.isinf(float(epsilon)):
            return build_plugin(discovery.DEFENSE, "none", {})
        shifted = float(epsilon)  # nothing to scale
        return build_plugin(discovery.DEFENSE, "naive-ldp", {"epsilon": shifted, "subset_size": subset})
    words, shifted = scale_parameters(setting, size, epsilon, factor)
    configuration = {"epsilon": shifted, "subset_size": subset, "words": words, "dictionary": Asset(dictionary)}
    return build_plugin(discovery.DEFENSE, "ldp", configuration)


def build_labels(setting: Setting, size: str, epsilon: str, subset: int, factor: float | None = None) -> dict[str, str]:
    """Return the labels of a row: the paper's |K|, ε and m, then our |K| and ε."""
    if size == ALL_DESCRIPTORS:
        ours = {"our |K|": "all", "our ε": epsilon}
    else:
        words, shifted = scale_parameters(setting, size, epsilon, factor)
        ours = {"our |K|": f"{words:,}", "our ε": "inf" if math.isinf(shifted) else f"{shifted:.4g}"}
    return {"|K|": size if size == ALL_DESCRIPTORS else f"{int(size):,}", "ε": epsilon, "m": str(subset), **ours}


def scale_parameters(setting: Setting, size: str, epsilon: str, factor: float | None = None) -> tuple[int, float]:
    """Return our |K| and ε for the paper's |K| and ε."""
    scaling = setting.profile.gallery_scale if factor is None else factor
    return scale.words(int(size), scaling), scale.epsilon(float(epsilon), scaling)


def format_name(size: str, epsilon: str, subset: int) -> str:
    """Return the name of a row, by which claims refer to it."""
    short = size if size == ALL_DESCRIPTORS else f"{int(size) // 1000}k"
    return f"|K| {short}, ε {epsilon}, m {subset}"


def build_row(setting: Setting, line: Mapping[str, str], paper: Mapping[str, float]) -> Row:
    """Return the row for a line of Table 2 or S1."""
    size, epsilon, subset = line["database_size"], line["epsilon"], int(line["subset_size"])
    return Row(
        name=format_name(size, epsilon, subset),
        labels={"group": line["group"], **build_labels(setting, size, epsilon, subset)},
        paper=paper,
        defense=build_defense(setting, size, epsilon, subset),
        attack=None,
        task=build_task(setting),
    )


def build_recall_measures(**conditions: str | None) -> dict[str, Measure]:
    """Return measures of the recall at each threshold: `recall="day"` gives `recall_0.25m_2deg` and others of the day queries."""
    return {
        f"{prefix}_{threshold}": Measure(metric=f"recall_{threshold}", factor=100, digits=1, condition=condition, fraction=True)
        for prefix, condition in conditions.items()
        for threshold in THRESHOLDS
    }


def build_error_measures(condition: str | None = None) -> dict[str, Measure]:
    """Return measures of the median errors, in the scene's unit of length and degrees, and of the mean counts of RANSAC."""
    errors = {
        f"median_{name}": Measure(metric=name, digits=2, condition=condition, median=True)
        for name in ("translation_error", "rotation_error")
    }
    return errors | {name: Measure(metric=name, digits=0, condition=condition) for name in ("matches", "inliers", "trials")}
