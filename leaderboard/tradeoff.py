"""Privacy-utility tradeoffs: the score of the strongest attack on a defense, and the score of the server's task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.core.hashing import canonical_json
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import Interval
from leaderboard.measures import RANKING, UTILITY, Measure, list_measures
from leaderboard.ranking import Standing, average_baselines, rank_defenses


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """One defense with one setting."""

    standing: Standing
    attack_experiment: GroupedExperiment  # of the strongest attack
    utility_experiment: GroupedExperiment
    privacy: Interval  # smaller is better
    utility: Interval  # larger is better
    on_front: bool  # whether it lies on the Pareto front
    own_dictionaries: bool  # whether the two experiments use different dictionaries


@dataclass(frozen=True, kw_only=True, eq=False)
class Tradeoff:
    """The points of one group with attacks and one utility group, under one condition such as day or night."""

    attack_group: ComparisonGroup
    utility_group: ComparisonGroup
    condition: str | None
    privacy: Measure
    utility: Measure
    points: tuple[Point, ...]
    baselines: Mapping[str, float]  # name -> its mean privacy score

    @property
    def caption(self) -> str:
        """The measures, the datasets and the settings of the server's task."""
        attacked, served = self.attack_group.metadata["dataset"], self.utility_group.metadata["dataset"]
        condition = f"{self.condition.capitalize()}: " if self.condition else ""
        settings = f" ({self.utility_group.settings})" if self.utility_group.settings else ""
        if attacked["hash"] == served["hash"]:
            return f"{condition}{self.privacy.label} and {self.utility.label} on {attacked['name']}{settings}"
        words = "; each with its own dictionary" if any(point.own_dictionaries for point in self.points) else ""
        return f"{condition}{self.privacy.label} on {attacked['name']}, {self.utility.label} on {served['name']}{settings}{words}"

    @property
    def front(self) -> list[Point]:
        """The Pareto front, from the most private point to the most useful."""
        return sorted((point for point in self.points if point.on_front), key=lambda point: point.utility.mean)


def build_tradeoffs(attack_group: ComparisonGroup, groups: Sequence[ComparisonGroup]) -> list[Tradeoff]:
    """Return one tradeoff for each score that ranks, and each condition of each utility group.

    Both groups have the same extractor, seeds and source. Groups on other photographs are used only if no group has the same
    photographs, and matching only if localization is missing.
    """
    for utility in list_measures(UTILITY):
        candidates = [
            one for one in groups if utility in one.measures and list_shared_settings(one) == list_shared_settings(attack_group)
        ]
        same = [one for one in candidates if one.metadata["dataset"]["hash"] == attack_group.metadata["dataset"]["hash"]]
        tradeoffs = [
            _build_tradeoff(attack_group, group, privacy, utility, condition)
            for privacy in list_measures(RANKING)
            for group in same or candidates
            for condition in group.conditions
        ]
        if filled := [tradeoff for tradeoff in tradeoffs if tradeoff.points]:
            return filled
    return []


def pareto(cost: ArrayLike, gain: ArrayLike) -> NDArray[np.bool_]:
    """Return whether each of (n,) points is dominated by no other point, as (n,) booleans.

    A point dominates another if it costs no more, gains no less, and is better in at least one of the two.
    """
    costs, gains = np.asarray(cost, dtype=np.float64), np.asarray(gain, dtype=np.float64)
    no_worse = (costs[None] <= costs[:, None]) & (gains[None] >= gains[:, None])
    better = (costs[None] < costs[:, None]) | (gains[None] > gains[:, None])
    return np.logical_not(np.logical_and(no_worse, better).any(axis=1))


def _build_tradeoff(
    attack_group: ComparisonGroup, utility_group: ComparisonGroup, privacy: Measure, utility: Measure, condition: str | None
) -> Tradeoff:
    complete = [one for one in utility_group.experiments if not one.reason and not utility_group.count_missing(one)]
    privacy_condition = condition if condition in attack_group.conditions else None
    pairs = []
    for standing in rank_defenses(attack_group):
        served, strongest = _find_same_defense(standing, complete), standing.represent(privacy)
        gain = utility_group.average(served, utility, condition) if served else None
        loss = attack_group.average(strongest, privacy, privacy_condition) if strongest else None
        if served and strongest and gain and loss:
            pairs.append((standing, strongest, served, loss, gain))
    ranked = [pair for pair in pairs if pair[0].rank is not None]  # an unranked one may look more private than it is
    front = pareto([pair[3].mean for pair in ranked], [pair[4].mean for pair in ranked])
    best = {pair[1].key for pair, on_front in zip(ranked, front, strict=True) if on_front}
    points = tuple(
        Point(
            standing=standing,
            attack_experiment=strongest,
            utility_experiment=served,
            privacy=loss,
            utility=gain,
            on_front=strongest.key in best,
            own_dictionaries=strongest.metadata["defense"] != served.metadata["defense"],
        )
        for standing, strongest, served, loss, gain in pairs
    )
    return Tradeoff(
        attack_group=attack_group,
        utility_group=utility_group,
        condition=condition,
        privacy=privacy,
        utility=utility,
        points=points,
        baselines=average_baselines(attack_group, privacy, privacy_condition),
    )


def _find_same_defense(standing: Standing, experiments: Sequence[GroupedExperiment]) -> GroupedExperiment | None:
    """Return the experiment of a utility group with the same defense and setting.

    On another dataset a defense may have other files, such as the dictionary of that scene. The defense is then the same if all
    other fields are equal and only one experiment qualifies.
    """
    equal = [one for one in experiments if one.metadata["defense"] == standing.configuration]
    content = standing.experiments[0].metadata["dataset"]["hash"]
    if equal or any(one.metadata["dataset"]["hash"] == content for one in experiments):
        return equal[0] if equal else None
    alike = [one for one in experiments if drop_files(one.metadata["defense"]) == drop_files(standing.configuration)]
    return alike[0] if len(alike) == 1 else None


def drop_files(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration of a defense without the digests of its files."""
    if "parts" in configuration:
        return {**configuration, "parts": [drop_files(part) for part in configuration["parts"]]}
    return {name: None if str(value).startswith("sha256:") else value for name, value in configuration.items()}


def list_shared_settings(group: ComparisonGroup) -> str:
    """Return extractor, seeds and source, which are equal in groups that can be joined."""
    return canonical_json([group.metadata["dataset"]["extractor"], group.seeds, group.metadata["environment"]["source"]])
