"""Audit of a defense's ε: lower bounds from releases of `protect`, and a search for violations of ε-LDP.

For any event E and any two descriptors, an ε-LDP release has Pr(E | d1) ≤ e^ε Pr(E | d2). Two descriptors are released many
times. One half of the calls selects the most informative event of each family. The other half measures the two rates of that
event. `protect`, including the quantiser, is a black box. The families of events are:

- membership: one word is released, and another is not.
- position: one word is at a certain position in its row, and another is not released.
- projection: the release is far in the direction from d2 to d1 (if descriptors are released).
- keypoints: the answers to two keypoints of one call have at least a certain number of words in common.
- calls: the answers to one keypoint in two calls have at least a certain number of words in common.

The last two compare (d1, d1) with (d1, d2). One descriptor changes, so ε bounds these ratios, too. A memoized defense does not
guarantee that. For a small dictionary, all pairs of words are compared by enumeration.

If the guarantee depends on the distance of descriptors, all bounds are divided by the distance of the two, and ε is per unit of
distance.

All keypoints of one call count as trials. This assumes that the answer for a keypoint depends on its own descriptor and on chance
alone. If the answers of one call are overdispersed under that assumption, only one keypoint of each call counts.
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
from bench.audit.events import Answers, compare_answers, extract_answers, select_events
from bench.audit.exhaustive import NotEnumerableError, bound_greatest_ratio, compute_law
from bench.audit.findings import Finding, Tally
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.exact import to_fraction
from bench.geometry.nearest_words import unit_rows
from bench.registry import fields
from bench.types import Features

TIGHT_FRACTION = 0.9  # of the claimed ε; a bound of at least this is called tight
PAIRS_PER_CALL = 500  # pairs of keypoints in a call
MIN_CALLS = 400  # least number of calls, if there are enough trials
MIN_DEVICES = 4000  # least number of calls for a memoized defense, each as another device, if there are enough trials
PILOT_CALLS = 20  # calls that select the events; not counted
MAX_ENUMERATED_WORDS = 6  # greatest dictionary whose outputs are enumerated
MAX_RUNS = 20_000  # of `protect` in the enumeration, for each word
DIGITS = Context(prec=50)

LINKED = "equal descriptors get equal answers, which no epsilon covers: keypoints and calls are not compared"
OVERDISPERSED = "{}: answers of one call are overdispersed, so only one of each call is counted"


@dataclasses.dataclass(frozen=True)
class Enumeration:
    """Bounds of the greatest log ratio of an output's probabilities for two words, divided by the distance of the words."""

    low: float
    high: float  # infinite where a probability is indistinguishable from 0
    exceeds: bool  # whether `low` is greater than the claimed ε


@dataclasses.dataclass(frozen=True)
class Audit:
    """All findings and the verdict."""

    claimed: float
    by_distance: bool  # whether `claimed` and all bounds are per unit of distance
    findings: tuple[Finding, ...]
    enumeration: Enumeration | None
    notes: tuple[str, ...]

    @property
    def strongest(self) -> Finding:
        """The finding with the greatest bound in the half of the calls that selects events."""
        return max(self.findings, key=lambda finding: finding.selection_epsilon)

    @property
    def verdict(self) -> Literal["consistent", "tight", "violated"]:
        certain = any(finding.certain_epsilon > self.claimed for finding in self.findings)
        if certain or (self.enumeration and self.enumeration.exceeds):
            return "violated"
        return "tight" if self.strongest.epsilon >= TIGHT_FRACTION * self.claimed else "consistent"


def audit(defense: Defense, words: int | None, trials: int, seed: int, folder: Path) -> Audit:
    """Return the audit of a defense that claims an ε.

    Parameters
    ----------
    words : size of a synthetic dictionary for the defense; None for its own dictionary, or if it has none
    trials : approximate number of releases of each of two descriptors
    seed : of the dictionary and all draws
    folder : for the dictionary

    Raises
    ------
    UserError
        if the defense claims no ε, `words` is given and it has no dictionary, or there are too few trials.
    """
    public = Public()
    if words is not None:
        defense = _replace_dictionary(defense, words, seed, folder)
    guarantee = defense.privacy(public)
    claimed = guarantee.per_distance if guarantee.epsilon is None else guarantee.epsilon
    if claimed is None:
        raise UserError(f"{defense.name()}, as configured, claims no epsilon, so there is nothing to audit")
    if trials < 4:
        raise UserError(f"--trials: an audit needs at least 4 trials, got {trials}")
    secrets = draw_features(2, seed) if words is None else create_features_near_words(defense, public)
    pair = secrets.take(np.array([0, len(secrets) - 1]))
    distance = float(defense.distance(pair, public, 0, 1))
    findings = tuple(finding.divide_by(distance) for finding in _measure_events(defense, pair, public, trials, seed))
    notes = [LINKED] if defense.is_memoized() else []
    if overdispersed := [finding.family for finding in findings if finding.overdispersed]:
        notes.append(OVERDISPERSED.format(", ".join(overdispersed)))
    enumeration = None
    try:
        if words is None or words > MAX_ENUMERATED_WORDS:
            raise NotEnumerableError(f"enumeration needs a dictionary of at most {MAX_ENUMERATED_WORDS} words")
        if defense.is_memoized():
            raise NotEnumerableError("a memoized defense draws its answers to all words together")
        enumeration = enumerate_outputs(defense, secrets, public, claimed)
    except NotEnumerableError as reason:
        notes.append(f"outputs are not enumerated: {reason}")
    return Audit(claimed, guarantee.epsilon is None, findings, enumeration, tuple(notes))


def create_features_near_words(defense: Defense, public: Public) -> Features:
    """Return features near each word of the defense's dictionary, but different from it."""
    (asset,) = fields.list_assets(defense).values()
    used = 0 if defense.word_count_field is None else getattr(defense, defense.word_count_field)
    words = public.dictionary(asset, used).words  # (K, D)
    aside = np.random.default_rng(0).integers(-2, 2, size=words.shape, endpoint=True)
    if words.dtype != np.uint8:
        return dataclasses.replace(draw_features(len(words)), descriptors=unit_rows(words + aside), codes=None)
    codes = np.clip(words + aside, 0, 255).astype(np.uint8)
    return dataclasses.replace(draw_features(len(codes)), descriptors=unit_rows(codes), codes=codes)


def enumerate_outputs(defense: Defense, secrets: Features, public: Public, claimed: float) -> Enumeration:
    """Return bounds of the greatest ratio between the exact laws of the released, ordered rows for any two of `secrets`.

    Raises
    ------
    NotEnumerableError
        if there are too many sequences of draws, or the defense uses an unsupported kind of draw.
    """

    def release_row(number: int, rng: np.random.Generator) -> bytes:
        return extract_answers(defense.protect(secrets.take(np.array([number])), public, rng)).words.tobytes()

    laws = [compute_law(lambda rng, number=number: release_row(number, rng), MAX_RUNS) for number in range(len(secrets))]  # type: ignore[misc]
    low = high = Decimal(0)
    for one, other in combinations(range(len(laws)), 2):
        distance = _to_decimal(defense.distance(secrets, public, one, other))
        bounds = (
            Decimal("inf") if each is None else _to_decimal(each).ln(DIGITS)
            for each in bound_greatest_ratio([laws[one], laws[other]])
        )
        least, most = (DIGITS.divide(bound, distance) for bound in bounds)
        low, high = max(low, least), max(high, most)
    return Enumeration(float(low), float(high), low > _to_decimal(to_fraction(claimed)))


def _to_decimal(value: Fraction) -> Decimal:
    return DIGITS.divide(Decimal(value.numerator), Decimal(value.denominator))


def _replace_dictionary(defense: Defense, words: int, seed: int, folder: Path) -> Defense:
    """Return the defense with a synthetic dictionary."""
    assets = fields.list_assets(defense)
    if len(assets) != 1:
        raise UserError(f"--words: {defense.name()} has {'no dictionary' if not assets else 'several dictionaries'}")
    if words < 2:
        raise UserError(f"--words: must be at least 2, got {words}")
    return dataclasses.replace(defense, **dict.fromkeys(assets, write_dictionary(folder, words, seed)))  # type: ignore[type-var]


def _measure_events(defense: Defense, secrets: Features, public: Public, trials: int, seed: int) -> Iterator[Finding]:
    """Release two descriptors repeatedly, and yield the finding of each family of events."""
    pairs = max(1, min(PAIRS_PER_CALL, trials // (MIN_DEVICES if defense.is_memoized() else MIN_CALLS)))
    calls = 4 * -(-trials // (4 * pairs))
    equal = secrets.take(np.zeros(2 * pairs, dtype=np.int64))  # pairs (d1, d1)
    mixed = secrets.take(np.arange(2 * pairs) % 2)  # pairs (d1, d2)

    def release_pairs(features: Features, *stream: int) -> tuple[Answers, Answers]:
        """Return the answers to the first keypoint of each pair, and to the second."""
        answers = extract_answers(defense.protect(features, public, np.random.default_rng([seed, *stream])))
        return answers.take(slice(0, None, 2)), answers.take(slice(1, None, 2))

    pilots = [(release_pairs(equal, 0, call)[1], release_pairs(mixed, 1, call)[1]) for call in range(PILOT_CALLS)]
    direction = secrets.descriptors[0] - secrets.descriptors[1]
    events = select_events([one for one, _ in pilots], [other for _, other in pilots], direction)
    tallies: dict[str, Tally] = {}
    before: Answers | None = None
    for call in range(calls):
        (neighbour, one), (neighbour_of_other, other) = release_pairs(equal, 2, call), release_pairs(mixed, 3, call)
        observed = {family: (flags(one), flags(other)) for family, flags in events.families().items()}
        if not defense.is_memoized():
            observed["keypoints"] = compare_answers(neighbour, one), compare_answers(neighbour_of_other, other)
            if before is not None:
                observed["calls"] = compare_answers(before, one), compare_answers(before, other)
            before = one if before is None else None  # each call is compared with one other call
        for family, pair in observed.items():
            tallies.setdefault(family, Tally()).add(*pair)
    names = events.names(one.words.shape[1])
    for family, tally in tallies.items():
        yield tally.measure(family, names[family], pairs, len(tallies))
