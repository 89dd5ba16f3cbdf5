"""The audit: sound defenses pass at any ε, and each wrong defense is detected by the family of events that it violates.

Verdicts are at a confidence of 1 − 1e-6, and all seeds are fixed.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import install_plugins
from scipy import stats

from bench import cli
from bench.api import Defense, Privacy
from bench.audit.auditor import Audit, audit, create_features_near_words
from bench.audit.bounds import is_overdispersed, log_ratio
from bench.audit.findings import CONFIDENCE
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.exact import Exact
from bench.geometry.nearest_words import unit_rows
from bench.mechanisms.subset import draw_distinct, draw_word_subsets
from bench.settings import Asset
from bench.types import Descriptors, Features, Indices, Points, WordSets
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP

TRIALS = 20_000


def run_audit(defense: Defense, folder: Path, words: int | None = 64, trials: int = TRIALS, seed: int = 0) -> Audit:
    return audit(defense, words, trials, seed, folder)


def list_violations(found: Audit) -> set[str]:
    """Return the families with a certain violation."""
    return {finding.family for finding in found.findings if finding.certain_epsilon > found.claimed}


# ---- the bounds


@pytest.mark.parametrize(("hits", "trials"), [(0, 50), (1, 50), (25, 50), (50, 50), (123_456, 10**6)])
def test_bounds_are_those_of_clopper_and_pearson(hits: int, trials: int) -> None:
    interval = stats.binomtest(hits, trials).proportion_ci(0.95, "exact")
    against_certainty = log_ratio(hits, trials, 10, 10, 0.95)
    assert against_certainty == pytest.approx(-math.inf if hits == 0 else math.log(interval.low), rel=1e-9)
    least = stats.binomtest(70, 100).proportion_ci(0.95, "exact").low
    assert log_ratio(70, 100, hits, trials, 0.95) == pytest.approx(math.log(least) - math.log(interval.high), rel=1e-9)


def test_the_bound_fails_at_its_rate() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.binomial(2000, 0.3, 20_000), rng.binomial(2000, 0.1, 20_000)
    failed = (log_ratio(one, 2000, other, 2000, 0.95) > math.log(3)).mean()
    assert 0.001 < failed < 0.05
    assert (log_ratio(one, 2000, other, 2000, 0.5) > math.log(3)).mean() > 0.05  # the control


def test_overdispersed_answers_are_detected() -> None:
    rng = np.random.default_rng(0)
    assert not any(is_overdispersed(rng.binomial(500, share, 200), 500) for share in (0.001, 0.1, 0.5, 1.0))
    assert is_overdispersed(500 * rng.binomial(1, 0.1, 200), 500)
    assert is_overdispersed(rng.binomial(500, rng.beta(30, 70, 200)), 500)
    # Two rare events may occur in one call, but not five hundred.
    rare = [rng.binomial(500, 1e-5, 1000) for _ in range(300)]
    assert any(counts.max() == 2 for counts in rare)
    assert not any(is_overdispersed(counts, 500) for counts in rare)
    assert is_overdispersed(500 * (np.arange(1000) == 7), 500)


# ---- sound defenses


@pytest.mark.slow
@pytest.mark.parametrize(
    "defense",
    [
        LDP(epsilon=0.0),
        LDP(epsilon=Exact("1/3"), subset_size=3),
        LDP(epsilon=2.0),
        LDP(epsilon=5.0, subset_size=1),
        LDP(epsilon=10.0, words=16),
        LDP(epsilon=100.0),
        LDP(epsilon=1000.0, subset_size=4),
        LDP(epsilon=2.0, subset_size=12),
    ],
    ids=str,
)
def test_the_guarantee_of_ldp_holds(defense: LDP, tmp_path: Path) -> None:
    found = run_audit(defense, tmp_path)
    assert found.verdict != "violated"
    assert 0 <= found.strongest.epsilon <= found.claimed
    assert [finding.family for finding in found.findings] == ["membership", "position", "keypoints", "calls"]
    if 2 <= found.claimed <= 5 and defense.subset_size <= 2:
        assert found.strongest.epsilon > 0.85 * found.claimed  # the events are the right ones
        assert found.strongest.family in ("membership", "position")
    if found.claimed >= 100:
        assert found.strongest.epsilon > 5  # the most that so few trials can show


@pytest.mark.slow
def test_a_bound_near_the_claim_is_called_tight(tmp_path: Path) -> None:
    found = run_audit(LDP(epsilon=2.0), tmp_path, trials=50_000)
    assert found.verdict == "tight"
    assert 1.8 < found.strongest.epsilon < 2.0


@pytest.mark.exhaustive
def test_no_false_alarm(tmp_path: Path) -> None:
    """Over many seeds, the 95% bound fails sometimes and the verdict never."""
    audits = [run_audit(LDP(epsilon=1.0), tmp_path, words=16, trials=1000, seed=seed) for seed in range(10)]
    assert "violated" not in {found.verdict for found in audits}
    bounds = [finding.epsilon for found in audits for finding in found.findings[:2]]
    assert sum(bound > 1.0 for bound in bounds) <= 3
    assert max(bounds) > 0.6


@pytest.mark.slow
def test_a_defense_without_a_dictionary(tmp_path: Path) -> None:
    found = run_audit(NaiveLDP(epsilon=10.0), tmp_path, words=None, trials=1000)
    assert found.verdict == "consistent"
    # At ε = 800 and 1024 bits the true pattern is released, and the audit identifies it.
    found = run_audit(NaiveLDP(epsilon=800.0), tmp_path, words=None, trials=1000)
    assert found.verdict == "consistent"
    assert found.strongest.epsilon > 3
    assert found.strongest.rates[0] > 0.9


@dataclasses.dataclass(frozen=True, kw_only=True)
class Laplace(Defense):
    """Adds noise to unit descriptors, whose L1 distance is at most 2 √128, and releases the sum."""

    releases = Descriptors

    scale: float = 1.0  # of the required noise

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Descriptors:
        noise = rng.laplace(0, self.scale * 2 * 128**0.5 / 4.0, secret.descriptors.shape)
        released = (secret.descriptors + noise).astype(np.float32)
        return Descriptors(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, descriptors=released)

    def privacy(self, public: Public) -> Privacy:
        return Privacy("epsilon-ldp", 4.0)


@pytest.mark.slow
def test_noise_is_audited_by_projections(tmp_path: Path) -> None:
    sound = run_audit(Laplace(), tmp_path, words=None, trials=5000)
    assert sound.verdict == "consistent"
    assert "projection" in {finding.family for finding in sound.findings}
    assert list_violations(run_audit(Laplace(scale=0.01), tmp_path, words=None, trials=5000)) == {"projection"}


# ---- memoized defenses


@pytest.mark.slow
def test_memoized_answers_count_once_per_call(tmp_path: Path) -> None:
    found = run_audit(LDP(epsilon=2.0, memoize=True), tmp_path, words=16, trials=4 * TRIALS)
    assert found.verdict in ("consistent", "tight")
    assert [finding.family for finding in found.findings] == ["membership", "position"]
    assert found.strongest.epsilon > 1.5
    assert all(finding.overdispersed and finding.trials < 2 * TRIALS for finding in found.findings)
    assert any("linked" in note or "equal answers" in note for note in found.notes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Secretive(LDP):
    """A memoized defense with the claim of a defense that is not memoized."""

    def is_memoized(self) -> bool:
        return False

    def privacy(self, public: Public) -> Privacy:
        return dataclasses.replace(super().privacy(public), guarantee="epsilon-ldp")


@pytest.mark.slow
def test_undeclared_memoization_is_detected(tmp_path: Path) -> None:
    assert list_violations(run_audit(Secretive(epsilon=2.0, memoize=True), tmp_path, words=16)) == {"keypoints"}


# ---- wrong defenses

Draw = Callable[[Indices, int, float, int, np.random.Generator], Indices]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wrong(LDP):
    """Like ldp, except for the draw of the words."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        """(N,) -> (N, m)"""
        return draw_word_subsets(true, domain, self.epsilon, self.subset_size, rng)

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> WordSets:
        dictionary = public.dictionary(self.dictionary)
        words = self.draw(public.nearest_words(self.dictionary, secret), len(dictionary), rng)
        candidates = unit_rows(dictionary.words[words])
        return WordSets(positions=Points(keypoints=secret.keypoints.copy()), size=secret.size, candidates=candidates, words=words)


class TooSmallDomain(Wrong):
    """Computes p from half of the words."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        included = rng.random(len(true)) < 1 / (1 + (domain / 2 - self.subset_size) / self.subset_size * math.exp(-self.epsilon))
        return draw_sets(true, included, domain, self.subset_size, rng)


class OneTooFew(Wrong):
    """Computes p from one word less, a difference that no feasible number of trials detects."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        included = rng.random(len(true)) < 1 / (1 + (domain - 1 - self.subset_size) / self.subset_size * math.exp(-self.epsilon))
        return draw_sets(true, included, domain, self.subset_size, rng)


class TrueWordFirst(Wrong):
    """Releases the right sets, in an order that reveals the true word."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        words = super().draw(true, domain, rng)
        return np.take_along_axis(words, np.argsort(words != true[:, None], axis=1, kind="stable"), axis=1)


class OneSeedForEveryKeypoint(Wrong):
    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        seed = int(rng.integers(2**32))
        alone = [super(OneSeedForEveryKeypoint, self).draw(word[None], domain, np.random.default_rng(seed)) for word in true]
        return np.concatenate(alone)


class OneSeedForEveryCall(Wrong):
    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        return super().draw(true, domain, np.random.default_rng(7))


class NearestWord(Wrong):
    """Claims ε, and releases the word itself."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        return true[:, None]


class SubsetSelectionAsItComes(Wrong):
    """multi-freq-ldpy's client, whose sets begin with the true value if they contain it. It chooses their size."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        from multi_freq_ldpy.pure_frequency_oracles.SS import SS_Client

        np.random.seed(rng.integers(2**32))  # noqa: NPY002  # its source of randomness
        return np.stack([SS_Client.py_func(int(word), domain, self.epsilon) for word in true])


class SubsetSelectionSorted(SubsetSelectionAsItComes):
    """Negative control: the same sets, sorted."""

    def draw(self, true: Indices, domain: int, rng: np.random.Generator) -> Indices:
        return np.sort(super().draw(true, domain, rng), axis=1)


def draw_sets(true: Indices, included: np.ndarray, domain: int, size: int, rng: np.random.Generator) -> Indices:
    """Draw the sets of the mechanism given u."""
    words = np.empty((len(true), size), dtype=np.int64)
    for u in (0, 1):
        rows = np.flatnonzero(included == u)
        others = draw_distinct(len(rows), domain - 1, size - u, rng)
        words[rows, u:] = others + (others >= true[rows, None])
    words[included, 0] = true[included]
    return np.sort(words, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "family"),
    [
        (TooSmallDomain, "membership"),
        (TrueWordFirst, "position"),
        (OneSeedForEveryKeypoint, "keypoints"),
        (OneSeedForEveryCall, "calls"),
        (NearestWord, "membership"),
        (SubsetSelectionAsItComes, "position"),
    ],
)
def test_a_wrong_defense_is_detected(wrong: type[Wrong], family: str, tmp_path: Path) -> None:
    trials = 2000 if wrong in (OneSeedForEveryKeypoint, SubsetSelectionAsItComes) else TRIALS  # they are slow
    found = run_audit(wrong(epsilon=2.0), tmp_path, trials=trials)
    assert found.verdict == "violated"
    assert family in list_violations(found)
    if family == "position":
        assert "membership" not in list_violations(found)  # the sets are right
    if family in ("keypoints", "calls"):
        assert list_violations(found) <= {family, "membership", "position"}


@pytest.mark.slow
def test_the_wrong_defenses_have_one_error(tmp_path: Path) -> None:
    """Negative controls: with the draws of `ldp`, and with sorted sets, the same code passes."""
    assert run_audit(Wrong(epsilon=2.0), tmp_path).verdict != "violated"
    assert run_audit(SubsetSelectionSorted(epsilon=2.0), tmp_path, trials=2000).verdict != "violated"


# ---- enumeration


@pytest.mark.slow
@pytest.mark.parametrize(("words", "size", "epsilon"), [(3, 1, 1.0), (4, 2, 2.0), (4, 1, Exact("1/3"))])
def test_all_outputs_of_ldp_keep_the_ratio_exactly(words: int, size: int, epsilon: float, tmp_path: Path) -> None:
    found = run_audit(LDP(epsilon=epsilon, subset_size=size), tmp_path, words=words, trials=2000)
    assert found.enumeration is not None
    assert not found.enumeration.exceeds
    assert found.enumeration.low == pytest.approx(epsilon, abs=1e-14) == found.enumeration.high
    assert found.verdict != "violated"


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "words", "size"), [(OneTooFew, 5, 1), (TrueWordFirst, 3, 2), (NearestWord, 5, 1)])
def test_enumeration_detects_what_trials_cannot(wrong: type[Wrong], words: int, size: int, tmp_path: Path) -> None:
    found = run_audit(wrong(epsilon=0.5, subset_size=size), tmp_path, words=words, trials=400)
    assert found.enumeration is not None
    assert found.enumeration.exceeds
    assert found.verdict == "violated"
    if wrong is OneTooFew:
        assert list_violations(found) == set()
        assert found.enumeration.low == pytest.approx(0.5 + math.log(4 / 3), abs=1e-12)  # |K| − m over |K| − 1 − m


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [100.0, 1000.0])
def test_enumeration_at_large_epsilon(epsilon: float, tmp_path: Path) -> None:
    """Probabilities below 2^-60 are indistinguishable from zero."""
    found = run_audit(LDP(epsilon=epsilon, subset_size=1), tmp_path, words=3, trials=400)
    assert found.enumeration is not None
    assert 38 < found.enumeration.low < 50
    assert math.isinf(found.enumeration.high)
    assert not found.enumeration.exceeds


@pytest.mark.slow
def test_missing_enumerations_are_explained(tmp_path: Path) -> None:
    assert any("at most 6 words" in note for note in run_audit(LDP(), tmp_path, trials=400).notes)
    memoized = run_audit(LDP(epsilon=1.0, memoize=True), tmp_path, words=4, trials=400)
    assert memoized.enumeration is None
    assert any("answers to all words" in note for note in memoized.notes)


# ---- inputs


def test_inputs_are_near_words_and_not_on_them(tmp_path: Path) -> None:
    from bench.codebook.examples import write_dictionary

    asset, public = write_dictionary(tmp_path, 64), Public()
    secrets = create_features_near_words(LDP(dictionary=asset), public)
    np.testing.assert_array_equal(public.nearest_words(asset, secrets), np.arange(64))
    assert secrets.codes is not None
    assert (secrets.codes != public.dictionary(asset).words).any(axis=1).all()
    assert len(create_features_near_words(LDP(dictionary=asset, words=10), public)) == 10


@pytest.mark.parametrize(
    ("defense", "words", "trials", "complaint"),
    [
        (LDP(epsilon=math.inf), 8, 100, "ldp, as configured, claims no epsilon"),
        (LDP(), 1, 100, "--words: must be at least 2, got 1"),
        (LDP(), 8, 3, "at least 4 trials, got 3"),
        (NaiveLDP(), 8, 100, "--words: naive-ldp has no dictionary"),
        (LDP(subset_size=9), 8, 100, "subset_size is 9, but the dictionary has 8 words"),
    ],
)
def test_invalid_arguments_are_refused(defense: Defense, words: int, trials: int, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=complaint):
        audit(defense, words, trials, 0, tmp_path)


def run(capfd: pytest.CaptureFixture[str], *arguments: Any) -> tuple[int, str, str]:
    status = cli.main(["audit", *map(str, arguments)])
    return status, *capfd.readouterr()


@pytest.mark.slow
def test_the_command(capfd: pytest.CaptureFixture[str]) -> None:
    status, shown, _ = run(capfd, "--defense", "ldp:epsilon=3/2,subset_size=1", "--words", 3, "--trials", 4000)
    assert status == 0
    assert "claims ε = 1.5" in shown
    assert "all outputs enumerated" in shown
    assert f"with confidence {CONFIDENCE:.0%}" in shown
    status, _, message = run(capfd, "--defense", "affine")
    assert (status, message) == (2, "bench: affine, as configured, claims no epsilon, so there is nothing to audit\n")


def test_a_violation_is_exit_status_1(capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"overclaiming": "fake_plugins.overclaiming:PLUGIN"}})
    status, shown, _ = run(capfd, "--defense", "overclaiming", "--words", 16, "--trials", 4000)
    assert status == 1
    assert "violated, with error probability 1e-06 (by membership, position, projection, " in " ".join(shown.split())


@pytest.mark.slow
def test_same_seed_same_audit(tmp_path: Path) -> None:
    one, again, other = (run_audit(LDP(epsilon=2.0), tmp_path, trials=1000, seed=seed) for seed in (1, 1, 2))
    assert one == again
    assert one != other
    assert Asset(tmp_path / "dictionary-64-1.safetensors").endswith("1.safetensors")
