"""Ranking of defenses, each by the strongest attack on it: the one with the greatest mean SSIM."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bench.core.hashing import canonical_json
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, Measure, list_measures

ADAPTED = "dia"  # the attack whose network is trained for the defense; without it, a defense may look safe


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """One defense with one setting, and its rank."""

    defense: str
    experiments: tuple[GroupedExperiment, ...]
    strongest: GroupedExperiment | None  # None if no attack reconstructed an image
    score: Interval | None  # of the strongest attack
    unranked_reason: str | None  # None for a ranked defense
    rank: int | None = None  # 1 is the most private; equal scores have equal ranks

    @property
    def configuration(self) -> dict[str, Any]:
        return dict(self.experiments[0].metadata["defense"])


def rank_defenses(group: ComparisonGroup) -> list[Standing]:
    """Return all defenses of a group with attacks: the ranked ones by rank, then the others."""
    by_defense: dict[str, list[GroupedExperiment]] = {}
    for experiment in group.experiments:
        by_defense.setdefault(canonical_json(experiment.metadata["defense"]), []).append(experiment)
    (privacy,) = list_measures([PRIVACY])
    standings = [_judge_defense(group, experiments, privacy) for experiments in by_defense.values()]
    ranked = sorted((standing for standing in standings if standing.unranked_reason is None), key=_mean_score)
    return [
        *(dataclasses.replace(one, rank=1 + sum(_mean_score(other) < _mean_score(one) for other in ranked)) for one in ranked),
        *(standing for standing in standings if standing.unranked_reason is not None),
    ]


def _judge_defense(group: ComparisonGroup, experiments: Sequence[GroupedExperiment], privacy: Measure) -> Standing:
    scores = [(score, one) for one in experiments if (score := group.average(one, privacy)) is not None]
    score, strongest = max(scores, key=lambda pair: pair[0].mean, default=(None, None))
    return Standing(
        defense=experiments[0].defense,
        experiments=tuple(experiments),
        strongest=strongest,
        score=score,
        unranked_reason=_explain_unranked(group, experiments, score),
    )


def _explain_unranked(group: ComparisonGroup, experiments: Sequence[GroupedExperiment], score: Interval | None) -> str | None:
    """Return the reason why a defense has no rank, or None if it has one."""
    adapted = [one for one in experiments if (one.metadata["attack"] or {}).get("name") == ADAPTED]
    if not adapted:
        return f"no adapted attacker was run ({ADAPTED})"
    if all(one.reason for one in adapted):
        return adapted[0].reason
    for one in experiments:  # the completed samples may be the easy ones
        if group.count_missing(one):
            return f"{one.attack} has completed {len(group.complete_samples(one))} of {len(group.samples)} samples"
    return None if score else "no attack reconstructed an image"


def _mean_score(standing: Standing) -> float:
    assert standing.score is not None
    return standing.score.mean
