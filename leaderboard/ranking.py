"""Ranking of defenses, each by the strongest attack on it.

That is the attack with the greatest mean SSIM among the attacks with a signal, or among all attacks if none has a signal. A
baseline is the strongest attack only where no other attack gave an image. No rank rests on an attack without a signal: the
benchmark then cannot say how private the defense is.
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
from leaderboard.measures import PRIVACY, Measure, list_measures
from leaderboard.signal import BASELINES, Signal, Verdict, is_baseline, is_oracle

ADAPTED = "dia"  # the attack whose network is trained for the defense; without it, a defense may look safe


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """One defense with one setting, and its rank."""

    defense: str
    experiments: tuple[GroupedExperiment, ...]
    strongest: GroupedExperiment | None  # None if no attack reconstructed an image
    score: Interval | None  # of the strongest attack
    unranked_reason: str | None  # None for a ranked defense
    signal: Signal | None  # of the strongest attack
    rank: int | None = None  # 1 is the most private; equal scores have equal ranks

    @property
    def has_signal(self) -> bool:
        """Whether the score of the strongest attack is evidence."""
        return self.signal is not None and self.signal.verdict is Verdict.SIGNAL

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


def average_baselines(group: ComparisonGroup, condition: str | None = None) -> dict[str, float]:
    """Return the mean of `PRIVACY` of each baseline that was run, over the defenses that it was run on."""
    (privacy,) = list_measures([PRIVACY])
    scores: dict[str, list[float]] = {}
    for experiment in group.experiments:
        score = group.average(experiment, privacy, condition) if is_baseline(experiment.metadata) else None
        if score:
            scores.setdefault(experiment.metadata["attack"]["name"], []).append(score.mean)
    return {name: float(np.mean(scores[name])) for name in BASELINES if name in scores}


def _judge_defense(group: ComparisonGroup, experiments: Sequence[GroupedExperiment], privacy: Measure) -> Standing:
    attacks = [one for one in experiments if not is_oracle(one.metadata)]
    scores = [(score, one) for one in attacks if (score := group.average(one, privacy)) is not None]
    score, strongest = max(scores, key=lambda pair: _strength(group.signals.get(pair[1]), pair[0]), default=(None, None))
    signal = group.signals.get(strongest) if strongest else None
    return Standing(
        defense=experiments[0].defense,
        experiments=tuple(experiments),
        strongest=strongest,
        score=score,
        unranked_reason=_explain_unranked(group, experiments, signal),
        signal=signal,
    )


def _strength(signal: Signal | None, score: Interval) -> tuple[bool, bool, float]:
    """Return what attacks are ordered by: no baseline, a signal, the mean score."""
    verdict = signal.verdict if signal else None
    return verdict is not Verdict.BASELINE, verdict is Verdict.SIGNAL, score.mean


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


def _mean_score(standing: Standing) -> float:
    assert standing.score is not None
    return standing.score.mean
