"""Audits a defense's ε: bounds it from below by what `protect` releases, and looks for what an ε-LDP defense cannot do.

For any event E and any two descriptors, an ε-LDP release has Pr(E | d1) ≤ e^ε Pr(E | d2). Two descriptors are released many
times. On one half of the calls the event of each family is chosen that tells most; on the other half its two rates are measured.
What `protect` does with a descriptor, the quantiser included, is a black box.

- membership: one word is released, and another is not
- position: one word stands in one place of its row, and another is not released
- projection: what is released lies far in the direction from d2 to d1 (where descriptors are released)
- keypoints: the answers to two keypoints of one call have so many words in common
- calls: the answers to one keypoint in two calls have so many words in common

The last two compare (d1, d1) with (d1, d2): one descriptor changes, so ε bounds these ratios, too. A defense that remembers does
not promise that. All pairs of words are compared by enumeration, where the dictionary is small.

Where the promise depends on how far descriptors are apart, all bounds are divided by the distance of the two, and ε is per unit
of it.

Many keypoints of one call count as many trials, which presumes that a keypoint's answer depends on its own descriptor and on
chance. Where answers of one call are more alike than that allows, one keypoint of each call counts and the others do not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from decimal import Context, Decimal
from fractions import Fraction
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from bench.api import Defense
from bench.audit.events import Answers, answers, common, watch
from bench.audit.exhaustive import NotEnumerableError, greatest_ratio, law
from bench.audit.findings import Finding, Tally
from bench.codebook.examples import example_features, small_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.exact import exact
from bench.geometry.nearest_words import unit_rows
from bench.registry import fields
from bench.types import Features

TIGHT = 0.9  # of the claimed ε, from which on a bound is called tight
PLACES = 500  # pairs of keypoints in a call
CALLS = 400  # at least, where there are so many trials
DEVICES = 4000  # the same, of a defense that remembers: each call is another device
PILOTS = 20  # calls that choose what to look for; they are not counted
ENUMERATED = 6  # words of a dictionary, at most, whose outputs are enumerated
RUNS = 20_000  # of the enumeration, for each word
DIGITS = Context(prec=50)

LINKED = "equal descriptors get equal answers, which no epsilon covers: keypoints and calls were not compared"
ALIKE = "{}: answers of one call are more alike than independent ones, so that one of each call was counted"


@dataclasses.dataclass(frozen=True)
class Enumeration:
    """Bounds of the greatest ln of the ratio of an output's probabilities for two words, over the distance of the two."""

    low: float
    high: float  # infinite where a probability is too small to be told from 0
    exceeds: bool  # whether it is certainly greater than the claimed ε


@dataclasses.dataclass(frozen=True)
class Audit:
    """All findings, and what follows from them."""

    claimed: float
    by_distance: bool  # whether that, and all bounds, are per unit of distance
    findings: tuple[Finding, ...]
    enumeration: Enumeration | None
    notes: tuple[str, ...]

    @property
    def strongest(self) -> Finding:
        """Of the family that told most on that half of the calls on which it was not measured."""
        return max(self.findings, key=lambda finding: finding.expected)

    @property
    def verdict(self) -> Literal["consistent", "tight", "violated"]:
        if any(finding.certain > self.claimed for finding in self.findings) or (self.enumeration and self.enumeration.exceeds):
            return "violated"
        return "tight" if self.strongest.epsilon >= TIGHT * self.claimed else "consistent"


def audit(defense: Defense, words: int | None, trials: int, seed: int, folder: Path) -> Audit:
    """Audit a defense that claims ε.

    Parameters
    ----------
    words : of a dictionary, made up for this, that the defense is to report from; None for its own, or where it has none
    trials : releases of each of two descriptors, about
    seed : of the dictionary and of all draws
    folder : where the dictionary is written

    Raises
    ------
    UserError
        if the defense claims no ε or has no dictionary, or there are too few trials.
    """
    public = Public()
    if words is not None:
        defense = _reporting_from(defense, words, seed, folder)
    promised = defense.privacy(public)
    claimed = promised.per_distance if promised.epsilon is None else promised.epsilon
    if claimed is None:
        raise UserError(f"{defense.name()}, as configured, claims no epsilon: there is nothing to audit")
    if trials < 4:
        raise UserError(f"an audit needs at least 4 trials, got {trials}")
    secrets = example_features(2, seed) if words is None else near_words(defense, public)
    tried = secrets.take(np.array([0, len(secrets) - 1]))
    apart = float(defense.distance(tried, public, 0, 1))
    findings = tuple(finding.per(apart) for finding in _findings(defense, tried, public, trials, seed))
    notes = [LINKED] if defense.is_memoized() else []
    if alike := [finding.family for finding in findings if finding.alike]:
        notes.append(ALIKE.format(", ".join(alike)))
    enumeration = None
    try:
        if words is None or words > ENUMERATED:
            raise NotEnumerableError(f"that takes a dictionary of at most {ENUMERATED} words")
        if defense.is_memoized():
            raise NotEnumerableError("a device that remembers draws its answers to all words at once")
        enumeration = enumerated(defense, secrets, public, claimed)
    except NotEnumerableError as reason:
        notes.append(f"outputs were not enumerated: {reason}")
    return Audit(claimed, promised.epsilon is None, findings, enumeration, tuple(notes))


def near_words(defense: Defense, public: Public) -> Features:
    """Features near each word of the defense's dictionary, but not on it."""
    (asset,) = fields.asset_fields(defense).values()
    used = 0 if defense.word_count_field is None else getattr(defense, defense.word_count_field)
    words = public.dictionary(asset, used).words  # (K, D)
    aside = np.random.default_rng(0).integers(-2, 2, size=words.shape, endpoint=True)
    codes = np.clip(words + aside, 0, 255).astype(np.uint8)
    return dataclasses.replace(example_features(len(codes)), descriptors=unit_rows(codes), codes=codes)


def enumerated(defense: Defense, secrets: Features, public: Public, claimed: float) -> Enumeration:
    """Compare the exact laws of what is released for each of `secrets`, of whole rows in their order.

    Raises
    ------
    NotEnumerableError
        if there are too many courses, or the defense draws in a way that is not played.
    """

    def released(number: int, rng: np.random.Generator) -> bytes:
        return answers(defense.protect(secrets.take(np.array([number])), public, rng)).words.tobytes()

    laws = [law(lambda rng, number=number: released(number, rng), RUNS) for number in range(len(secrets))]  # type: ignore[misc]
    low = high = Decimal(0)
    for one, other in combinations(range(len(laws)), 2):
        apart = _quotient(defense.distance(secrets, public, one, other))
        bounds = (
            Decimal("inf") if each is None else _quotient(each).ln(DIGITS) for each in greatest_ratio([laws[one], laws[other]])
        )
        least, most = (DIGITS.divide(bound, apart) for bound in bounds)
        low, high = max(low, least), max(high, most)
    return Enumeration(float(low), float(high), low > _quotient(exact(claimed)))


def _quotient(value: Fraction) -> Decimal:
    return DIGITS.divide(Decimal(value.numerator), Decimal(value.denominator))


def _reporting_from(defense: Defense, words: int, seed: int, folder: Path) -> Defense:
    """The defense with a made-up dictionary for its own."""
    assets = fields.asset_fields(defense)
    if len(assets) != 1:
        raise UserError(f"--words: {defense.name()} reports from {'no dictionary' if not assets else 'several dictionaries'}")
    if words < 2:
        raise UserError(f"--words: a dictionary has at least 2 words, not {words}")
    return dataclasses.replace(defense, **dict.fromkeys(assets, small_dictionary(folder, words, seed)))  # type: ignore[type-var]


def _findings(defense: Defense, secrets: Features, public: Public, trials: int, seed: int) -> Iterator[Finding]:
    """Release two descriptors again and again, and yield what each family of events shows."""
    places = max(1, min(PLACES, trials // (DEVICES if defense.is_memoized() else CALLS)))
    calls = 4 * -(-trials // (4 * places))
    alike = secrets.take(np.zeros(2 * places, dtype=np.int64))  # pairs (d1, d1)
    mixed = secrets.take(np.arange(2 * places) % 2)  # pairs (d1, d2)

    def released(features: Features, *stream: int) -> tuple[Answers, Answers]:
        """Answers to the first keypoint of each pair, and to the second."""
        found = answers(defense.protect(features, public, np.random.default_rng([seed, *stream])))
        return found.take(slice(0, None, 2)), found.take(slice(1, None, 2))

    pilots = [(released(alike, 0, call)[1], released(mixed, 1, call)[1]) for call in range(PILOTS)]
    direction = secrets.descriptors[0] - secrets.descriptors[1]
    watched = watch([one for one, _ in pilots], [other for _, other in pilots], direction)
    tallies: dict[str, Tally] = {}
    before: Answers | None = None
    for call in range(calls):
        (neighbour, one), (neighbour_of_other, other) = released(alike, 2, call), released(mixed, 3, call)
        seen = {family: (flags(one), flags(other)) for family, flags in watched.families().items()}
        if not defense.is_memoized():
            seen["keypoints"] = common(neighbour, one), common(neighbour_of_other, other)
            if before is not None:
                seen["calls"] = common(before, one), common(before, other)
            before = one if before is None else None  # each call is compared with one other
        for family, pair in seen.items():
            tallies.setdefault(family, Tally()).add(*pair)
    names = watched.names(one.words.shape[1])
    for family, tally in tallies.items():
        yield tally.finding(family, names[family], places, len(tallies))
