"""Verdicts: bootstrap against SciPy and enumeration, and claims that hold, fail and cannot be told on made-up numbers."""

import dataclasses
import itertools
import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.mechanisms.subset import log10_chance
from defenses.ldp import LDP
from leaderboard.intervals import RESAMPLES, independent, interval, rank_correlation
from leaderboard.reproduce import scale, tables
from leaderboard.reproduce.claims import (
    FEWEST,
    Claim,
    Statement,
    Verdict,
    about_equal,
    at_least,
    falling,
    greater,
    judge,
    same_order,
)
from leaderboard.reproduce.profiles import CPU, PROFILES, Materials, Setting
from leaderboard.reproduce.study import printed
from leaderboard.reproduce.tables import table2, table3, table4

A, B = ("a", "ssim"), ("b", "ssim")
SETTING = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=7)


# ---- intervals


def test_interval_is_that_of_scipy(rng: np.random.Generator) -> None:
    values = rng.gamma(2.0, size=30)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=1).confidence_interval
    ours = interval(values)
    error = values.std() / math.sqrt(len(values))
    assert ours.mean == pytest.approx(values.mean())
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), abs=0.1 * error)


def test_interval_is_that_of_all_resamples(rng: np.random.Generator) -> None:
    values = rng.normal(size=6)
    means = np.mean(list(itertools.product(values, repeat=6)), axis=1)  # (6^6,)
    assert (interval(values).low, interval(values).high) == pytest.approx(np.quantile(means, (0.025, 0.975)), abs=0.05)


def test_intervals_cover_the_mean_about_as_often_as_they_say(rng: np.random.Generator) -> None:
    found = [interval(sample) for sample in rng.normal(size=(100, 40))]
    assert 0.88 < np.mean([one.low < 0 < one.high for one in found]) < 0.99


def test_one_photograph_has_no_interval() -> None:
    assert (interval([3.0]).low, interval([3.0]).high) == (-math.inf, math.inf)


@pytest.mark.parametrize("ties", [False, True])
def test_rank_correlation_is_that_of_scipy(rng: np.random.Generator, ties: bool) -> None:
    one, other = rng.normal(size=(2, 20))
    if ties:
        one, other = one.round(), other.round()
    assert rank_correlation(list(one), list(other)) == pytest.approx(stats.spearmanr(one, other).statistic)
    assert rank_correlation([1, 2, 3], [10, 100, 1000]) == pytest.approx(1)  # of ranks, not of values


# ---- verdicts

PHOTOGRAPHS = 20


def made_up(means: Mapping[str, float], spread: float, shared: float = 0.0) -> pd.DataFrame:
    """SSIM of rows on photographs: `spread` of each by itself, `shared` by all rows of a photograph."""
    rng = np.random.default_rng(0)
    common = shared * rng.normal(size=PHOTOGRAPHS)
    return pd.DataFrame({(row, "ssim"): mean + common + spread * rng.normal(size=PHOTOGRAPHS) for row, mean in means.items()})


def verdict(statement: Statement, values: pd.DataFrame) -> Verdict:
    (finding,) = judge([Claim(text="a claim", statements=(statement,))], values, {}, {})
    return finding.verdict


def test_an_order_holds_fails_and_cannot_be_told() -> None:
    assert verdict(greater(A, B), made_up({"a": 0.6, "b": 0.5}, 0.02)) is Verdict.HOLDS
    assert verdict(greater(A, B), made_up({"a": 0.5, "b": 0.6}, 0.02)) is Verdict.FAILS
    assert verdict(greater(A, B), made_up({"a": 0.6, "b": 0.599}, 0.2)) is Verdict.OPEN


def test_pairing_tells_what_means_alone_do_not() -> None:
    """Photographs differ far more than rows do. Shuffled, so that the pairs are lost, nothing can be told."""
    values = made_up({"a": 0.51, "b": 0.5}, 0.002, shared=0.2)
    assert verdict(greater(A, B), values) is Verdict.HOLDS
    values[A] = np.random.default_rng(1).permutation(values[A])
    assert verdict(greater(A, B), values) is Verdict.OPEN


def test_slack_and_equality() -> None:
    behind = made_up({"a": 0.495, "b": 0.5}, 0.002)
    assert verdict(at_least(A, B, 0.01), behind) is Verdict.HOLDS
    assert verdict(greater(A, B), behind) is Verdict.FAILS
    assert verdict(at_least(A, B, 0.001), behind) is Verdict.FAILS
    assert verdict(about_equal(A, B, 0.03), behind) is Verdict.HOLDS
    assert verdict(about_equal(A, B, 0.03), made_up({"a": 0.6, "b": 0.5}, 0.002)) is Verdict.FAILS
    assert verdict(about_equal(A, B, 0.03), made_up({"a": 0.4, "b": 0.5}, 0.002)) is Verdict.FAILS
    assert verdict(about_equal(A, B, 0.03), made_up({"a": 0.5, "b": 0.5}, 0.2)) is Verdict.OPEN


def test_cells_of_different_units_are_compared_by_independent_resampling() -> None:
    """Day and night have other queries: paired, nothing could be told."""
    rng = np.random.default_rng(3)
    day = pd.Series((rng.random(200) < 0.8).astype(float), index=[f"day {number}" for number in range(200)])
    night = pd.Series((rng.random(100) < 0.3).astype(float), index=[f"night {number}" for number in range(100)])
    values = pd.DataFrame({A: day, B: night})
    unpaired = Statement(text="", weights={A: 1.0, B: -1.0}, above=0.0, paired=False)
    assert verdict(unpaired, values) is Verdict.HOLDS
    assert verdict(dataclasses.replace(unpaired, weights={A: -1.0, B: 1.0}), values) is Verdict.FAILS
    assert verdict(dataclasses.replace(unpaired, paired=True), values) is Verdict.OPEN
    ours = independent([day, night], [1.0, -1.0])
    expected = stats.bootstrap((day, night), lambda x, y: x.mean() - y.mean(), method="percentile", random_state=1)
    assert ours.mean == pytest.approx(day.mean() - night.mean())
    assert (ours.low, ours.high) == pytest.approx(tuple(expected.confidence_interval), abs=0.01)
    assert ours.count == 100


def test_few_photographs_decide_nothing() -> None:
    clear = made_up({"a": 0.9, "b": 0.1}, 0.001)
    assert verdict(greater(A, B), clear.head(FEWEST)) is Verdict.HOLDS
    assert verdict(greater(A, B), clear.head(FEWEST - 1)) is Verdict.OPEN


def test_only_photographs_that_have_all_cells_count() -> None:
    values = made_up({"a": 0.6, "b": 0.5}, 0.001)
    values.loc[0, [A]] = 99.0
    values.loc[0, [B]] = np.nan
    (finding,) = judge([Claim(text="", statements=(greater(A, B),))], values, {}, {})
    ours = finding.evidence[0].ours
    assert ours is not None
    assert ours.count == PHOTOGRAPHS - 1
    assert ours.high < 1


def test_a_row_that_does_not_apply_leaves_the_claim_open_and_says_why() -> None:
    values = made_up({"a": 0.6}, 0.001)
    (finding,) = judge([Claim(text="", statements=(greater(A, B),))], values, {A: 2.0, B: 1.0}, {"b": "n/a: no network"})
    assert finding.verdict is Verdict.OPEN
    assert finding.evidence[0].paper == 1.0
    assert finding.evidence[0].reason == "b: n/a: no network"


def test_a_claim_fails_with_one_statement_and_holds_with_all() -> None:
    values = made_up({"a": 0.6, "b": 0.5, "c": 0.4, "d": 0.4}, 0.001)
    c, d, missing = ("c", "ssim"), ("d", "ssim"), ("e", "ssim")
    cases = {
        Verdict.HOLDS: falling([A, B, c]),
        Verdict.FAILS: (*falling([A, B]), greater(c, A), greater(missing, A)),
        Verdict.OPEN: (*falling([A, B]), greater(missing, A)),
    }
    for expected, statements in cases.items():
        (finding,) = judge([Claim(text="", statements=statements)], values, {}, {})
        assert finding.verdict is expected
    assert verdict(Statement(text="", weights={A: 1.0, B: -1.0, c: -1.0, d: 1.0}, below=0.11), values) is Verdict.HOLDS


def test_same_order_is_asked_of_the_pairs_that_are_far_enough_apart() -> None:
    paper = {A: 0.5, B: 0.52, ("c", "ssim"): 0.6}
    claim = same_order(paper, 0.03, "SSIM")
    assert [list(statement.weights) for statement in claim.statements] == [[("c", "ssim"), A], [("c", "ssim"), B]]
    (finding,) = judge([claim], made_up({"a": 0.7, "b": 0.5, "c": 0.6}, 0.001), paper, {})
    assert [evidence.verdict for evidence in finding.evidence] == [Verdict.FAILS, Verdict.HOLDS]


# ---- the tables


@pytest.mark.parametrize("name", sorted(tables.everything()))
def test_the_paper_keeps_its_own_claims(name: str) -> None:
    """Had each photograph the paper's values, every claim would hold; were all values negated, none that has a direction."""
    table = tables.everything()[name]
    rows = (*table.rows(SETTING), *table.borrowed(SETTING))
    assert len({row.name for row in rows}) == len(rows)
    values = printed(rows)
    claims = table.claims(values)
    for sign, expected in ((1, Verdict.HOLDS), (-1, Verdict.FAILS)):
        alike = pd.DataFrame({cell: [sign * value] * FEWEST for cell, value in values.items()})
        wrong = [finding.claim.text for finding in judge(claims, alike, values, {}) if finding.verdict is not expected]
        assert wrong == [text for text in wrong if sign == -1 and ("flat" in text or "equals" in text)]


def test_claims_about_structure_fail_where_they_should() -> None:
    """Had m = 4 the points of m = 32, and quantised descriptors more than raw ones, those two claims would fall, and no other."""
    rows = tables.everything()["tableS2"].rows(SETTING)
    paper = printed(rows)
    wrong = dict(paper)
    wrong["m 4", "points"], wrong["m 32", "points"] = paper["m 32", "points"], paper["m 4", "points"]
    wrong["no privacy", "points"] = 1.1 * paper["raw", "points"]
    _, *claims = tables.everything()["tableS2"].claims(paper)  # the first is about every pair
    alike = pd.DataFrame({cell: [value] * FEWEST for cell, value in wrong.items()})
    failed = [finding.claim.text for finding in judge(claims, alike, paper, {}) if finding.verdict is not Verdict.HOLDS]
    assert [text.partition(":")[0] for text in failed] == [
        "Quantisation alone, without privacy, loses points.",
        "An interior m is near best",
    ]


def test_structure_s_dictionaries_tell_the_truth_as_often_as_the_papers() -> None:
    for row in tables.everything()["tableS2"].rows(SETTING)[2:]:
        defense = row.defense
        assert isinstance(defense, LDP)
        ours = log10_chance(defense.epsilon, defense.words, defense.subset_size)
        assert ours == pytest.approx(log10_chance(10, 512_000, int(row.labels["m"])), abs=1e-4)
        assert defense.epsilon == pytest.approx(10 - math.log(2))


# ---- the scale


@pytest.mark.parametrize("factor", [profile.scale for profile in PROFILES.values()] + [1 / 8])
@pytest.mark.parametrize(("words", "epsilon", "subset"), [(256_000, 16, 1), (256_000, 10, 4), (512_000, 12, 4)])
def test_the_scale_keeps_the_chance_of_the_truth(factor: float, words: int, epsilon: float, subset: int) -> None:
    def chance(size: float, budget: float) -> float:
        return subset * math.exp(budget) / (subset * math.exp(budget) + size - subset)

    ours = chance(scale.words(words, factor), scale.epsilon(epsilon, factor))
    assert ours == pytest.approx(chance(words, epsilon), rel=5 * subset / (factor * words))
    if factor != 1:  # the controls: without the shift, and with the shift to the wrong side
        for wrong in (epsilon, epsilon - math.log(factor)):
            assert chance(scale.words(words, factor), wrong) != pytest.approx(chance(words, epsilon), rel=1e-3)


def test_the_defenses_of_table_4_tell_the_truth_as_often_as_the_papers() -> None:
    public = Public()
    for row in table4.rows(SETTING):
        words, epsilon, subset = (float(row.labels[column].replace(",", "")) for column in ("|K|", "ε", "m"))
        privacy = row.defense.privacy(public)
        expected = subset * math.exp(epsilon) / (subset * math.exp(epsilon) + words - subset)
        assert privacy.log10_true is not None
        assert 10**privacy.log10_true == pytest.approx(expected, rel=1e-4)
        assert privacy.epsilon == pytest.approx(epsilon - math.log(2))


def test_the_trials_of_table_3_are_those_of_the_issue() -> None:
    """10M, 1M, 100k and 10k of the paper's; of profile cpu as many as two cores can make."""
    settings = {name: dataclasses.replace(SETTING, profile=profile) for name, profile in PROFILES.items()}
    made = {
        name: {row.name: dataclasses.asdict(row.task)["trials"] for row in table3.rows(own)} for name, own in settings.items()
    }
    assert [made["paper"][row] for row in table3.TRIALS] == [10_000_000, 1_000_000, 100_000, 10_000]
    assert [made["cpu"][row] for row in table3.TRIALS] == [100_000, 30_000, 10_000, 3_000]
    assert [made["smoke"][row] for row in table3.TRIALS] == [3_333, 1_000, 333, 100]
    assert made["cpu"]["voc-match"] == 30_000


def test_table_3_shares_the_row_of_its_point_with_table_2() -> None:
    point = next(row for row in table2.rows(SETTING) if row.name == "|K| 256k, ε 10, m 2")
    own = {row.name: row for row in table3.rows(SETTING)}
    for name in ("voc-match", "Aachen Ref.", "1M"):
        assert (own[name].defense, own[name].task) == (point.defense, point.task)
    assert own["mutual-nn"].task != point.task
