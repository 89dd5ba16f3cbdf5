"""Verdicts: claims that hold, fail or stay open for synthetic numbers."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.mechanisms.subset import log10_chance
from bench.tasks.localization import Localization
from defenses.ldp import LDP
from leaderboard.intervals import MIN_SAMPLES, combine_independent
from leaderboard.reproduce import scale, tables
from leaderboard.reproduce.claims import (
    Claim,
    Statement,
    Verdict,
    about_equal,
    at_least,
    falling,
    greater,
    judge_claims,
    same_order,
)
from leaderboard.reproduce.profiles import CPU, PROFILES, Materials, Setting
from leaderboard.reproduce.study import collect_paper_values
from leaderboard.reproduce.tables import table2, table3, table4, table_s4

A, B = ("a", "ssim"), ("b", "ssim")
SETTING = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=7)


# ---- verdicts

PHOTOGRAPHS = 20


def sample_values(means: Mapping[str, float], spread: float, common_spread: float = 0.0) -> pd.DataFrame:
    """Return SSIM of rows on photographs: `spread` per value, `common_spread` per photograph."""
    rng = np.random.default_rng(0)
    common = common_spread * rng.normal(size=PHOTOGRAPHS)
    return pd.DataFrame({(row, "ssim"): mean + common + spread * rng.normal(size=PHOTOGRAPHS) for row, mean in means.items()})


def find_verdict(statement: Statement, values: pd.DataFrame) -> Verdict:
    (result,) = judge_claims([Claim(text="a claim", statements=(statement,))], values, {}, {})
    return result.verdict


def test_an_order_holds_fails_or_stays_open() -> None:
    assert find_verdict(greater(A, B), sample_values({"a": 0.6, "b": 0.5}, 0.02)) is Verdict.HOLDS
    assert find_verdict(greater(A, B), sample_values({"a": 0.5, "b": 0.6}, 0.02)) is Verdict.FAILS
    assert find_verdict(greater(A, B), sample_values({"a": 0.6, "b": 0.599}, 0.2)) is Verdict.OPEN


def test_a_confounded_statement_cannot_be_decided_by_any_number() -> None:
    """The control is the same statement without the confounder."""
    values = sample_values({"a": 0.6, "b": 0.5}, 0.02)
    confounded = dataclasses.replace(greater(A, B), confounder="the setting determines both")
    (result,) = judge_claims([Claim(text="a claim", statements=(confounded,))], values, {}, {})
    assert result.verdict is Verdict.OPEN
    assert result.evidence[0].reason == "the setting determines both"
    assert find_verdict(greater(A, B), values) is Verdict.HOLDS


def test_collisions_follow_from_the_coverage_and_decide_nothing() -> None:
    """Photographs of our printed means. The reason states the constant, and the rates have columns of their own."""
    rows = table_s4.build_rows(SETTING)
    means = {"dim 2": 95.16, "dim 4": 91.46, "dim 8": 85.17, "dim 16": 76.85}
    rng = np.random.default_rng(0)
    values = pd.DataFrame({(row, table_s4.PRINTED): mean + 0.1 * rng.normal(size=8) for row, mean in means.items()})
    paper = collect_paper_values(rows)
    (result,) = judge_claims(table_s4.build_claims(paper), values, paper, {})
    assert {evidence.verdict for evidence in result.evidence} == {Verdict.OPEN}
    assert all("about 0.95^(dim/2)" in evidence.reason for evidence in result.evidence)
    assert [row.labels["coverage^(dim/2)"] for row in rows] == ["95.00", "90.25", "81.45", "66.34"]
    assert {"covered (all a_i)", "no collision among covered"} <= table_s4.TABLE.measures.keys()


def test_pairing_decides_where_means_alone_do_not() -> None:
    """Photographs differ far more than rows. Shuffling destroys the pairs, and the verdict is then open."""
    values = sample_values({"a": 0.51, "b": 0.5}, 0.002, common_spread=0.2)
    assert find_verdict(greater(A, B), values) is Verdict.HOLDS
    values[A] = np.random.default_rng(1).permutation(values[A])
    assert find_verdict(greater(A, B), values) is Verdict.OPEN


def test_slack_and_equality() -> None:
    behind = sample_values({"a": 0.495, "b": 0.5}, 0.002)
    assert find_verdict(at_least(A, B, 0.01), behind) is Verdict.HOLDS
    assert find_verdict(greater(A, B), behind) is Verdict.FAILS
    assert find_verdict(at_least(A, B, 0.001), behind) is Verdict.FAILS
    assert find_verdict(about_equal(A, B, 0.03), behind) is Verdict.HOLDS
    assert find_verdict(about_equal(A, B, 0.03), sample_values({"a": 0.6, "b": 0.5}, 0.002)) is Verdict.FAILS
    assert find_verdict(about_equal(A, B, 0.03), sample_values({"a": 0.4, "b": 0.5}, 0.002)) is Verdict.FAILS
    assert find_verdict(about_equal(A, B, 0.03), sample_values({"a": 0.5, "b": 0.5}, 0.2)) is Verdict.OPEN


def test_entries_of_different_samples_are_compared_by_independent_resampling() -> None:
    """Day and night have different queries; paired by query, the verdict would be open."""
    rng = np.random.default_rng(3)
    day = pd.Series((rng.random(200) < 0.8).astype(float), index=[f"day {number}" for number in range(200)])
    night = pd.Series((rng.random(100) < 0.3).astype(float), index=[f"night {number}" for number in range(100)])
    values = pd.DataFrame({A: day, B: night})
    unpaired = Statement(text="", weights={A: 1.0, B: -1.0}, above=0.0, paired=False)
    assert find_verdict(unpaired, values) is Verdict.HOLDS
    assert find_verdict(dataclasses.replace(unpaired, weights={A: -1.0, B: 1.0}), values) is Verdict.FAILS
    assert find_verdict(dataclasses.replace(unpaired, paired=True), values) is Verdict.OPEN
    (result,) = judge_claims([Claim(text="", statements=(unpaired,))], values, {}, {})
    assert result.evidence[0].p_value == pytest.approx(stats.ttest_ind(day, night, equal_var=False).pvalue)
    assert result.evidence[0].ours == combine_independent([day, night], [1.0, -1.0]).interval()


def test_few_photographs_decide_nothing() -> None:
    clear = sample_values({"a": 0.9, "b": 0.1}, 0.001)
    assert find_verdict(greater(A, B), clear.head(MIN_SAMPLES)) is Verdict.HOLDS
    assert find_verdict(greater(A, B), clear.head(MIN_SAMPLES - 1)) is Verdict.OPEN


def test_only_photographs_with_all_entries_count() -> None:
    values = sample_values({"a": 0.6, "b": 0.5}, 0.001)
    values.loc[0, [A]] = 99.0
    values.loc[0, [B]] = np.nan
    (result,) = judge_claims([Claim(text="", statements=(greater(A, B),))], values, {}, {})
    ours = result.evidence[0].ours
    assert ours is not None
    assert ours.count == PHOTOGRAPHS - 1
    assert ours.high < 1


def test_verdicts_have_holms_correction_over_the_statements_of_a_claim() -> None:
    """A difference that a claim of one statement decides stays open among many, and a clear one is still decided."""
    values = sample_values({"a": 0.523, "b": 0.5, "c": 0.2}, 0.02)
    p_value = stats.ttest_rel(values[A], values[B]).pvalue
    assert 0.05 / 20 < p_value < 0.05
    assert find_verdict(greater(A, B), values) is Verdict.HOLDS
    equal = [about_equal(A, B, 0.02 + 1e-4 * number) for number in range(20)]  # cannot be decided
    (result,) = judge_claims([Claim(text="", statements=(greater(A, B), greater(A, ("c", "ssim")), *equal))], values, {}, {})
    assert [evidence.verdict for evidence in result.evidence[:3]] == [Verdict.OPEN, Verdict.HOLDS, Verdict.OPEN]
    first = result.evidence[0]
    assert first.p_value == pytest.approx(21 * p_value)  # the second of 22 in the order of p-values
    untested = greater(A, ("d", "ssim"))  # a statement that cannot be tested is in no family
    (result,) = judge_claims([Claim(text="", statements=(greater(A, B), untested))], values, {}, {})
    assert result.evidence[0].p_value == pytest.approx(p_value)


def test_a_two_sided_window_is_tested_at_both_ends() -> None:
    values = sample_values({"a": 0.51, "b": 0.5}, 0.02)
    statement, difference = about_equal(A, B, 0.03), values[A] - values[B]
    (result,) = judge_claims([Claim(text="", statements=(statement,))], values, {}, {})
    ends = [
        stats.ttest_1samp(difference, -0.03, alternative="greater").pvalue,
        stats.ttest_1samp(difference, 0.03, alternative="less").pvalue,
    ]
    assert result.evidence[0].p_value == pytest.approx(2 * max(ends))


def test_a_row_without_a_signal_leaves_the_claim_open_with_that_reason() -> None:
    values, reason = sample_values({"a": 0.6, "b": 0.5, "c": 0.4}, 0.001), "no signal: attack at baseline"
    claim = Claim(text="", statements=falling([A, B, ("c", "ssim")]))
    (result,) = judge_claims([claim], values, {}, {}, {"c": reason})
    assert [evidence.verdict for evidence in result.evidence] == [Verdict.HOLDS, Verdict.OPEN]
    assert result.evidence[1].reason == f"c: {reason}"
    assert result.evidence[1].ours is not None  # the value is shown
    assert result.verdict is Verdict.OPEN
    (control,) = judge_claims([claim], values, {}, {})
    assert control.verdict is Verdict.HOLDS


def test_a_row_that_does_not_apply_leaves_the_claim_open_with_a_reason() -> None:
    values = sample_values({"a": 0.6}, 0.001)
    (result,) = judge_claims([Claim(text="", statements=(greater(A, B),))], values, {A: 2.0, B: 1.0}, {"b": "n/a: no network"})
    assert result.verdict is Verdict.OPEN
    assert result.evidence[0].paper == 1.0
    assert result.evidence[0].reason == "b: n/a: no network"


def test_a_claim_fails_with_one_statement_and_holds_with_all() -> None:
    values = sample_values({"a": 0.6, "b": 0.5, "c": 0.4, "d": 0.4}, 0.001)
    c, d, missing = ("c", "ssim"), ("d", "ssim"), ("e", "ssim")
    cases = {
        Verdict.HOLDS: falling([A, B, c]),
        Verdict.FAILS: (*falling([A, B]), greater(c, A), greater(missing, A)),
        Verdict.OPEN: (*falling([A, B]), greater(missing, A)),
    }
    for expected, statements in cases.items():
        (result,) = judge_claims([Claim(text="", statements=statements)], values, {}, {})
        assert result.verdict is expected
    assert find_verdict(Statement(text="", weights={A: 1.0, B: -1.0, c: -1.0, d: 1.0}, below=0.11), values) is Verdict.HOLDS


def test_same_order_uses_only_pairs_that_differ_enough() -> None:
    paper = {A: 0.5, B: 0.52, ("c", "ssim"): 0.6}
    claim = same_order(paper, 0.03, "SSIM")
    assert [list(statement.weights) for statement in claim.statements] == [[("c", "ssim"), A], [("c", "ssim"), B]]
    (result,) = judge_claims([claim], sample_values({"a": 0.7, "b": 0.5, "c": 0.6}, 0.001), paper, {})
    assert [evidence.verdict for evidence in result.evidence] == [Verdict.FAILS, Verdict.HOLDS]


# ---- the tables


def drop_confounders(claim: Claim) -> Claim:
    """Return the claim as it is tested on numbers without a confounder, such as the paper's."""
    return dataclasses.replace(
        claim, statements=tuple(dataclasses.replace(statement, confounder="") for statement in claim.statements)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(tables.load_tables()))
def test_the_papers_values_satisfy_its_claims(name: str) -> None:
    """With the paper's values for each photograph every claim holds; with negated values no claim with a direction does."""
    table = tables.load_tables()[name]
    rows = (*table.build_rows(SETTING), *table.build_reference_rows(SETTING))
    assert len({row.name for row in rows}) == len(rows)
    values = collect_paper_values(rows)
    claims = [drop_confounders(claim) for claim in table.build_claims(values)]
    for sign, expected in ((1, Verdict.HOLDS), (-1, Verdict.FAILS)):
        equal = pd.DataFrame({entry: [sign * value] * MIN_SAMPLES for entry, value in values.items()})
        wrong = [result.claim.text for result in judge_claims(claims, equal, values, {}) if result.verdict is not expected]
        assert wrong == [text for text in wrong if sign == -1 and ("flat" in text or "equals" in text)]


def test_claims_about_structure_fail_where_they_should() -> None:
    """Two claims fail, and no other, if m = 4 and m = 32 swap their points and quantisation has more points than raw."""
    rows = tables.load_tables()["tableS2"].build_rows(SETTING)
    paper = collect_paper_values(rows)
    wrong = dict(paper)
    wrong["m 4", "points"], wrong["m 32", "points"] = paper["m 32", "points"], paper["m 4", "points"]
    wrong["no privacy", "points"] = 1.1 * paper["raw", "points"]
    _, *claims = tables.load_tables()["tableS2"].build_claims(paper)  # the first is about every pair
    equal = pd.DataFrame({entry: [value] * MIN_SAMPLES for entry, value in wrong.items()})
    failed = [result.claim.text for result in judge_claims(claims, equal, paper, {}) if result.verdict is not Verdict.HOLDS]
    assert [text.partition(":")[0] for text in failed] == [
        "Quantisation alone, without privacy, loses points.",
        "An interior m is near best",
    ]


def test_structure_defenses_release_the_true_word_with_the_papers_probability() -> None:
    for row in tables.load_tables()["tableS2"].build_rows(SETTING)[2:]:
        defense = row.defense
        assert isinstance(defense, LDP)
        ours = log10_chance(defense.epsilon, defense.words, defense.subset_size)
        assert ours == pytest.approx(log10_chance(10, 512_000, int(row.labels["m"])), abs=1e-4)
        assert defense.epsilon == pytest.approx(10 - math.log(2))


# ---- the scale


@pytest.mark.parametrize("factor", [profile.scale for profile in PROFILES.values()] + [1 / 8])
@pytest.mark.parametrize(("words", "epsilon", "subset"), [(256_000, 16, 1), (256_000, 10, 4), (512_000, 12, 4)])
def test_the_scale_keeps_the_probability_of_the_true_word(factor: float, words: int, epsilon: float, subset: int) -> None:
    def probability(size: float, budget: float) -> float:
        return subset * math.exp(budget) / (subset * math.exp(budget) + size - subset)

    ours = probability(scale.words(words, factor), scale.epsilon(epsilon, factor))
    assert ours == pytest.approx(probability(words, epsilon), rel=5 * subset / (factor * words))
    if factor != 1:  # controls: no shift, and a shift of the wrong sign
        for wrong in (epsilon, epsilon - math.log(factor)):
            assert probability(scale.words(words, factor), wrong) != pytest.approx(probability(words, epsilon), rel=1e-3)


def test_table_4_defenses_release_the_true_word_with_the_papers_probability() -> None:
    public = Public()
    for row in table4.build_rows(SETTING):
        words, epsilon, subset = (float(row.labels[column].replace(",", "")) for column in ("|K|", "ε", "m"))
        privacy = row.defense.privacy(public)
        expected = subset * math.exp(epsilon) / (subset * math.exp(epsilon) + words - subset)
        assert privacy.log10_true is not None
        assert 10**privacy.log10_true == pytest.approx(expected, rel=1e-4)
        assert privacy.epsilon == pytest.approx(epsilon - math.log(2))


@pytest.mark.slow
def test_table_2_has_rows_that_retrieve_by_released_words() -> None:
    """They differ from the row of the same point in retrieval alone, and no value of the paper stands beside them."""
    rows = {row.name: row for row in table2.build_rows(SETTING)}
    released = [row for row in rows.values() if row.labels["group"] == table2.RELEASED_GROUP]
    assert [(row.labels["ε"], row.labels["m"]) for row in released] == [
        ("inf", "1"),
        *((epsilon, "2") for epsilon in table2.EPSILONS),
    ]
    for row in released:
        other = rows[row.name.removesuffix(", released")]
        assert isinstance(row.task, Localization)
        assert row.task == dataclasses.replace(other.task, retrieval="released") != other.task  # type: ignore[type-var]
        assert (row.defense, row.paper) == (other.defense, {})


@pytest.mark.slow
def test_table_3_has_the_specified_trials() -> None:
    """Profile `paper` has the paper's 10M, 1M, 100k and 10k. Profile `cpu` has as many as two cores can run."""
    settings = {name: dataclasses.replace(SETTING, profile=profile) for name, profile in PROFILES.items()}
    trials = {
        name: {row.name: dataclasses.asdict(row.task)["trials"] for row in table3.build_rows(setting)}
        for name, setting in settings.items()
    }
    assert [trials["paper"][row] for row in table3.TRIALS] == [10_000_000, 1_000_000, 100_000, 10_000]
    assert [trials["cpu"][row] for row in table3.TRIALS] == [100_000, 30_000, 10_000, 3_000]
    assert [trials["smoke"][row] for row in table3.TRIALS] == [3_333, 1_000, 333, 100]
    for name, most in {"paper": 10_000_000, "cpu": 100_000, "smoke": 3_333}.items():  # the other rows have those of row 10M
        assert {trials[name][row] for row in trials[name].keys() - table3.TRIALS} == {most}


@pytest.mark.slow
def test_table_3_shows_the_trials_of_the_paper_and_ours() -> None:
    labels = {row.name: row.labels for row in table3.build_rows(SETTING)}
    shown = [(labels[row]["trials, paper"], labels[row]["trials, ours"]) for row in table3.TRIALS]
    assert shown == [
        ("10,000,000", "100,000"),
        ("1,000,000", "30,000"),
        ("100,000", "10,000"),
        ("10,000", "3,000"),
    ]
    for row in ("voc-match", "mutual-nn"):
        assert (labels[row]["trials, paper"], labels[row]["trials, ours"]) == ("10,000,000", "100,000")
    released = labels[table3.RELEASED]
    assert (released["trials, paper"], released["trials, ours"]) == ("", "100,000")


@pytest.mark.slow
def test_table_3_clusters_both_dictionaries_into_as_many_words() -> None:
    defenses = {row.name: row.defense for row in table3.build_rows(SETTING)}
    ours, other = defenses["Aachen Ref."], defenses["Places365"]
    assert isinstance(ours, LDP)
    assert isinstance(other, LDP)
    assert (ours.dictionary, other.dictionary) == ("references", "shipped-clustered")
    assert dataclasses.replace(other, dictionary=ours.dictionary) == ours


@pytest.mark.slow
def test_table_3_shares_the_row_of_its_point_with_table_2() -> None:
    point = next(row for row in table2.build_rows(SETTING) if row.name == "|K| 256k, ε 10, m 2")
    own = {row.name: row for row in table3.build_rows(SETTING)}
    assert (own["1M"].defense, own["1M"].task) == (point.defense, point.task)
    for name in ("voc-match", "Aachen Ref."):
        assert (own[name].defense, own[name].task) == (own["10M"].defense, own["10M"].task)
    assert own["mutual-nn"].task != own["10M"].task
