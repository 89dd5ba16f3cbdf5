"""The signal of an experiment: whether an attack beats the two baselines, without which its score is no evidence.

The baselines are `blank`, the best constant image, and `keypoints`, the positions alone. A release that hides positions has only
the first. For each of the metrics `METRICS`, samples are paired and their mean difference to each baseline is tested by Student's
t against "at most zero". A metric has the greatest p-value of its baselines, since all of them have to be exceeded (an
intersection-union test). The metrics are a family of two tests with Holm's correction. The experiment has a signal if a corrected
p-value is less than `SIGNIFICANCE`. This is equivalent to a corrected lower bound of the mean difference above zero against each
baseline.

Identification has a third baseline, `chance`. Equal similarities have their mean rank, so a constant image has the logarithm of
the mean rank. That is 7.0 bits below the first rank. A random order is 6.6 bits below on average, so it would beat the constant
image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from bench.runner.records import Record
from bench.types import Points
from leaderboard.chance import IDENTIFIED, LOG_RECIPROCAL_RANK
from leaderboard.intervals import LEVEL, MIN_SAMPLES, Estimate, Interval, correct_holm, estimate_mean

BASELINES = ("blank", "keypoints")  # names of attacks; the second is none where positions are hidden
ORACLES = ("oracle", "neighbourhood-oracle")  # names of attacks with knowledge that no attacker has
SIGNIFICANCE = (1 - LEVEL) / 2  # one-sided: that of the lower end of a two-sided interval
# The values that are compared, by metric. The logarithm of the reciprocal rank is the information about the photograph, in bits.
METRICS: Mapping[str, Callable[[float], float]] = {"ssim": float, IDENTIFIED: math.log2}
CHANCE = "chance"
REMARK = (
    "Signal: the attack beats the best constant image (blank) and, unless they are hidden, the positions alone (keypoints), in "
    f"SSIM or in the logarithm of {IDENTIFIED}. Test: differences paired by sample, Student's t, one-sided {SIGNIFICANCE:.1%}, "
    "Holm's correction over the two metrics. The score of an attack without a signal is no evidence of privacy."
)

SampleValues = Mapping[str, Mapping[str, float]]  # metric -> sample -> value
ExperimentRecords = Sequence[Record]  # of one experiment: all its samples, and its seeds


class Verdict(Enum):
    """Whether the score of an attack is evidence."""

    SIGNAL = "signal"
    ABSENT = "no signal: attack at baseline"
    UNTESTED = "not tested"
    BASELINE = "baseline"
    REFERENCE = "reference"


@dataclass(frozen=True, kw_only=True)
class MetricTest:
    """The test of one metric."""

    metric: str
    differences: Mapping[str, Interval]  # baseline, or `CHANCE` -> mean difference, with its uncorrected interval
    p_value: float  # corrected


@dataclass(frozen=True, kw_only=True)
class Signal:
    """The verdict on one experiment, and the tests that it rests on."""

    verdict: Verdict
    reason: str = ""  # for `UNTESTED`
    tests: tuple[MetricTest, ...] = ()

    @property
    def text(self) -> str:
        """The verdict with its reason.

        >>> Signal(verdict=Verdict.UNTESTED, reason="no blank records").text
        'not tested: no blank records'
        """
        return f"{self.verdict.value}: {self.reason}" if self.reason else self.verdict.value

    @property
    def is_absent(self) -> bool:
        """Whether the attack was tested and is at its baselines."""
        return self.verdict is Verdict.ABSENT

    @property
    def is_untested(self) -> bool:
        """Whether baselines or samples are missing."""
        return self.verdict is Verdict.UNTESTED

    @property
    def word(self) -> str:
        """The verdict for a column: "yes", "no", "not tested", "baseline" or "reference"."""
        return {Verdict.SIGNAL: "yes", Verdict.ABSENT: "no"}.get(self.verdict, self.verdict.value)


def judge_signal(
    attack: SampleValues, baselines: Sequence[tuple[str, SampleValues]], required: Sequence[str] = BASELINES
) -> Signal:
    """Return the signal of an attack.

    Parameters
    ----------
    attack : the values of the attack
    baselines : (name, values) of the baselines, all of which have to be exceeded
    required : names that must be among them

    A metric is tested on the samples for which the attack and all baselines have a value. There must be at least `MIN_SAMPLES`.
    """
    missing = [name for name in required if name not in {baseline for baseline, _ in baselines}]
    if missing:
        return Signal(verdict=Verdict.UNTESTED, reason=f"no {' and no '.join(missing)} records")
    shared = {metric: _list_shared(metric, attack, [values for _, values in baselines]) for metric in METRICS}
    tested = {metric: samples for metric, samples in shared.items() if len(samples) >= MIN_SAMPLES}
    if not tested:
        count = max(map(len, shared.values()))
        reason = f"{count} samples with {' and '.join(required)}; at least {MIN_SAMPLES} are needed"
        return Signal(verdict=Verdict.UNTESTED, reason=reason)
    differences = {
        metric: [
            *((name, _estimate_difference(metric, samples, attack, values)) for name, values in baselines),
            *([(CHANCE, _estimate_gain(samples, attack))] if metric == IDENTIFIED else []),
        ]
        for metric, samples in tested.items()
    }
    p_values = correct_holm([max(one.p_above(0.0) for _, one in estimates) for estimates in differences.values()])
    tests = tuple(
        # of several baselines with one name, the one that is exceeded the least
        MetricTest(
            metric=metric,
            differences={name: _find_least(name, estimates).interval() for name in dict(estimates)},
            p_value=float(p_value),
        )
        for (metric, estimates), p_value in zip(differences.items(), p_values, strict=True)
    )
    verdict = Verdict.SIGNAL if p_values.min() < SIGNIFICANCE else Verdict.ABSENT
    return Signal(verdict=verdict, tests=tests)


def judge_experiments(experiments: Sequence[ExperimentRecords]) -> list[Signal | None]:
    """Return the signal of each experiment of one dataset; None if it has no attack or no value of `METRICS`.

    The baselines of an experiment are those with the same defense. If there are none, it is compared with a baseline of another
    defense that gives the same image: `blank` ignores the release, and `keypoints` reads nothing but the positions, so it is that
    of any release that has the same number of keypoints and keeps them in the clear.
    """
    values = [collect_values(records) for records in experiments]
    return [
        _judge(number, experiments, values) if records[0]["attack"] and any(values[number].values()) else None
        for number, records in enumerate(experiments)
    ]


def collect_values(records: ExperimentRecords) -> dict[str, dict[str, float]]:
    """Return the values of `METRICS` of each completed sample, as means over the seeds: metric -> sample -> value."""
    values: dict[str, dict[str, list[float]]] = {metric: {} for metric in METRICS}
    for record in records:
        for metric, samples in values.items():
            value = record["metrics"].get(metric) if record["status"] == "ok" else None
            if value is not None:
                samples.setdefault(record["sample"], []).append(METRICS[metric](float(value)))
    return {metric: {name: float(np.mean(each)) for name, each in samples.items()} for metric, samples in values.items()}


def is_baseline(record: Record) -> bool:
    """Return whether the record is of a baseline."""
    return get_attack(record) in BASELINES


def is_oracle(record: Record) -> bool:
    """Return whether the record is of an oracle, which knows a part of the secret."""
    return get_attack(record) in ORACLES


def get_attack(record: Record) -> str | None:
    """Return the name of the attack; None if the task takes no attack."""
    return record["attack"] and str(record["attack"]["name"])


def explain_untested(signals: Sequence[Signal | None]) -> str | None:
    """Return a sentence on the experiments that were not tested and on how to test them; None if there are none."""
    reasons = dict.fromkeys(one.reason for one in signals if one and one.is_untested)
    if not reasons:
        return None
    missing = [name for name in BASELINES if any(f"no {name}" in reason for reason in reasons)]
    advice = f" Add {' '.join(f'--attack {name}' for name in missing)}." if missing else ""
    return f"Signal: {Verdict.UNTESTED.value} for each attack ({'; '.join(reasons)}).{advice} Until then no score is evidence."


def _judge(number: int, experiments: Sequence[ExperimentRecords], values: Sequence[SampleValues]) -> Signal:
    own = experiments[number]
    if is_baseline(own[0]):
        return Signal(verdict=Verdict.BASELINE)
    if is_oracle(own[0]):
        return Signal(verdict=Verdict.REFERENCE)
    hidden = bool(own[0]["privacy"].get("uncovered")) and not _has_clear_positions(own)
    required = ("blank",) if hidden else BASELINES
    baselines = [(name, values[index]) for name in required for index in _find_baselines(name, own, experiments)]
    return judge_signal(values[number], baselines, required)


def _find_baselines(name: str, own: ExperimentRecords, experiments: Sequence[ExperimentRecords]) -> list[int]:
    """Return the indices of the experiments that are this baseline for the experiment."""
    named = [
        index
        for index, records in enumerate(experiments)
        if get_attack(records[0]) == name and any(record["status"] == "ok" for record in records)
    ]
    same = [index for index in named if experiments[index][0]["defense"] == own[0]["defense"]]
    return same or [index for index in named if name == "blank" or _has_equal_positions(own, experiments[index])][:1]


def _has_equal_positions(one: ExperimentRecords, other: ExperimentRecords) -> bool:
    """Return whether the releases of two experiments have the same positions of keypoints, in the clear."""
    if not (_has_clear_positions(one) and _has_clear_positions(other)):
        return False
    counts, others = (
        {record["sample"]: record["privacy"].get("keypoints") for record in records if record["status"] == "ok"}
        for records in (one, other)
    )
    return all(others.get(sample) == count for sample, count in counts.items())


def _has_clear_positions(records: ExperimentRecords) -> bool:
    """Return whether the records state that the positions of keypoints are in the clear."""
    return Points.disclosed in records[0]["privacy"].get("uncovered", ())


def _list_shared(metric: str, attack: SampleValues, baselines: Sequence[SampleValues]) -> list[str]:
    """Return the samples for which the attack and all baselines have a value, in the attack's order."""
    return [sample for sample in attack.get(metric, {}) if all(sample in values.get(metric, {}) for values in baselines)]


def _estimate_difference(metric: str, samples: Sequence[str], attack: SampleValues, baseline: SampleValues) -> Estimate:
    return estimate_mean([attack[metric][sample] - baseline[metric][sample] for sample in samples])


def _estimate_gain(samples: Sequence[str], attack: SampleValues) -> Estimate:
    """Return the estimated gain over a random order, in bits."""
    return estimate_mean([attack[IDENTIFIED][sample] - LOG_RECIPROCAL_RANK for sample in samples])


def _find_least(name: str, estimates: Sequence[tuple[str, Estimate]]) -> Estimate:
    return min((estimate for baseline, estimate in estimates if baseline == name), key=lambda estimate: estimate.mean)
