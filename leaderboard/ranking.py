"""Ranking of defenses by two scores: SSIM and identification.

Each score is the greatest mean of an attack with a signal, so the two may be of different attacks. The rank of a defense is that
of the sum of its positions in the two scores. SSIM separates defenses where each photograph is identified. Identification
separates them where SSIM is that of a blank image. Of equal sums, the defense with the lower identification comes first. Where
both are equal, the defenses share a rank. Records without identification are ranked by SSIM alone.

The strongest attack, which represents a defense in tables and plots, is the one with the greatest mean SSIM among the attacks
with a signal, or among all attacks if none has one. Of equal ones, it is the one with the greater identification. A baseline is
the strongest attack only where no other attack gave an image. No rank rests on an attack without a signal: the benchmark then
cannot say how private the defense is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.core.hashing import canonical_json
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, RANKING, Measure, list_measures
from leaderboard.signal import BASELINES, Signal, Verdict, is_baseline, is_oracle

ADAPTED = "dia"  # the attack whose network is trained for the defense; without it, a defense may look safe


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """One defense with one setting, and its rank."""

    defense: str
    experiments: tuple[GroupedExperiment, ...]
    strongest: GroupedExperiment | None  # None if no attack reconstructed an image
    score: Interval | None  # SSIM of the strongest attack
    identification: Interval | None  # the greatest mean reciprocal rank of an attack with a signal
    identifying: GroupedExperiment | None  # that attack
    unranked_reason: str | None  # None for a ranked defense
    signal: Signal | None  # of the strongest attack
    rank: int | None = None  # 1 is the most private

    def represent(self, measure: Measure) -> GroupedExperiment | None:
        """Return the attack that represents the defense in a plot of one of the measures `RANKING`."""
        return self.strongest if measure.name == PRIVACY else self.identifying or self.strongest

    @property
    def configuration(self) -> dict[str, Any]:
        return dict(self.experiments[0].metadata["defense"])


def rank_defenses(group: ComparisonGroup) -> list[Standing]:
    """Return all defenses of a group with attacks: the ranked ones by rank, then the others.

    The module's documentation describes the order.
    """
    by_defense: dict[str, list[GroupedExperiment]] = {}
    for experiment in group.experiments:
        by_defense.setdefault(canonical_json(experiment.metadata["defense"]), []).append(experiment)
    standings = [_judge_defense(group, experiments) for experiments in by_defense.values()]
    ranked = [standing for standing in standings if standing.unranked_reason is None]
    keys = _order_standings(ranked)
    order = sorted(range(len(ranked)), key=lambda index: keys[index])
    return [
        *(dataclasses.replace(ranked[index], rank=1 + sum(key < keys[index] for key in keys)) for index in order),
        *(standing for standing in standings if standing.unranked_reason is not None),
    ]


def average_baselines(group: ComparisonGroup, privacy: Measure, condition: str | None = None) -> dict[str, float]:
    """Return the mean of a measure of each baseline that was run, over the defenses that it was run on."""
    scores: dict[str, list[float]] = {}
    for experiment in group.experiments:
        score = group.average(experiment, privacy, condition) if is_baseline(experiment.metadata) else None
        if score:
            scores.setdefault(experiment.metadata["attack"]["name"], []).append(score.mean)
    return {name: float(np.mean(scores[name])) for name in BASELINES if name in scores}


def _judge_defense(group: ComparisonGroup, experiments: Sequence[GroupedExperiment]) -> Standing:
    privacy, identified = list_measures(RANKING)
    attacks = [one for one in experiments if not is_oracle(one.metadata)]
    scores = [(score, one) for one in attacks if (score := group.average(one, privacy)) is not None]
    ranks = {one: score for one in attacks if (score := group.average(one, identified)) is not None}
    score, strongest = max(
        scores, key=lambda pair: _strength(group.signals.get(pair[1]), pair[0], ranks.get(pair[1])), default=(None, None)
    )
    signal = group.signals.get(strongest) if strongest else None
    evident = [one for one in ranks if (own := group.signals.get(one)) and own.verdict is Verdict.SIGNAL]
    identifying = max(evident, key=lambda one: ranks[one].mean, default=None)
    return Standing(
        defense=experiments[0].defense,
        experiments=tuple(experiments),
        strongest=strongest,
        score=score,
        identification=None if identifying is None else ranks[identifying],
        identifying=identifying,
        unranked_reason=_explain_unranked(group, experiments, signal),
        signal=signal,
    )


def _strength(signal: Signal | None, score: Interval, identification: Interval | None) -> tuple[bool, bool, float, float]:
    """Return what attacks are ordered by: no baseline, a signal, mean SSIM, mean reciprocal rank."""
    verdict = signal.verdict if signal else None
    reciprocal = identification.mean if identification else 0.0
    return verdict is not Verdict.BASELINE, verdict is Verdict.SIGNAL, score.mean, reciprocal


def _explain_unranked(group: ComparisonGroup, experiments: Sequence[GroupedExperiment], signal: Signal | None) -> str | None:
    """Return the reason why a defense has no rank, or None if it has one."""
    adapted = [one for one in experiments if (one.metadata["attack"] or {}).get("name") == ADAPTED]
    if not adapted:
        return f"no adapted attacker was run ({ADAPTED})"
    if all(one.reason for one in adapted):
        return adapted[0].reason
    for one in experiments:  # the completed samples may be the easy ones
        if group.count_missing(one):
            return f"{one.attack} has completed {len(group.complete_samples(one))} of {len(group.samples)} samples"
    if signal is None:
        return "no attack reconstructed an image"
    return None if signal.verdict is Verdict.SIGNAL else signal.text


def _order_standings(ranked: Sequence[Standing]) -> list[tuple[float, float]]:
    """Return what the rank of each defense follows from: the sum of its positions by both scores, and its identification."""
    similarities = [one.score.mean for one in ranked if one.score]
    identifications = [one.identification.mean for one in ranked if one.identification]
    if len(identifications) < len(ranked):  # records without the metric
        return [(similarity, 0.0) for similarity in similarities]
    positions = zip(_list_positions(similarities), _list_positions(identifications), strict=True)
    return [(one + other, identification) for (one, other), identification in zip(positions, identifications, strict=True)]


def _list_positions(scores: Sequence[float]) -> list[int]:
    """Return the number of smaller scores for each score."""
    return [sum(other < score for other in scores) for score in scores]
