"""The signal of experiments: the rule against SciPy's tests, its error rate, and its marks in every table."""

import csv
import io
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fabricated
import numpy as np
import pytest
from fabricated import DIA, baselines, ldp, reconstructions
from scipy import stats

from bench import cli
from bench.codebook.public import ASSETS
from bench.core.table import to_csv, to_latex, to_markdown
from bench.formats import tensor_file
from bench.inversion import weights
from bench.types import Lines
from leaderboard import chance, comparison, site, tables
from leaderboard.group_tables import build_pairs_table, build_ranking_table
from leaderboard.intervals import MIN_SAMPLES
from leaderboard.ranking import rank_defenses
from leaderboard.signal import (
    BASELINES,
    METRICS,
    SIGNIFICANCE,
    SampleValues,
    Verdict,
    explain_untested,
    judge_experiments,
    judge_signal,
)

NONE, AFFINE = {"name": "none"}, {"name": "affine", "dim": 4}
TEXT = "no signal: attack at baseline"
COUNT = 40


def build_values(rng: np.random.Generator, ssim: float, bits: float, spread: float = 0.05) -> SampleValues:
    """Return values of both metrics around these means. `bits` is the logarithm of the reciprocal rank."""
    means = {"ssim": (ssim, spread), "identified": (bits, 10 * spread)}
    return {
        metric: {str(sample): float(value) for sample, value in enumerate(rng.normal(mean, deviation, COUNT))}
        for metric, (mean, deviation) in means.items()
    }


# ---- the rule


def test_p_values_are_those_of_scipys_paired_tests(rng: np.random.Generator) -> None:
    attack, blank, keypoints = (build_values(rng, mean, -6 + mean) for mean in (0.42, 0.4, 0.41))
    signal = judge_signal(attack, [("blank", blank), ("keypoints", keypoints)])
    own = {}
    for metric in METRICS:
        mine = list(attack[metric].values())
        others = [list(values[metric].values()) for values in (blank, keypoints)]
        if metric == "identified":
            others.append([chance.LOG_RECIPROCAL_RANK] * COUNT)
        own[metric] = max(stats.ttest_rel(mine, other, alternative="greater").pvalue for other in others)
    first, second = sorted(own, key=own.__getitem__)
    expected = {first: min(1.0, 2 * own[first]), second: max(2 * own[first], own[second])}
    assert {test.metric: test.p_value for test in signal.tests} == pytest.approx(expected)
    assert signal.verdict is (Verdict.SIGNAL if min(expected.values()) < SIGNIFICANCE else Verdict.ABSENT)


@pytest.mark.parametrize(
    ("ssim", "bits", "expected"),
    [
        ((0.5, 0.4, 0.4), (-3.0, -6.0, -6.0), Verdict.SIGNAL),
        ((0.4, 0.4, 0.4), (-3.0, -6.0, -6.0), Verdict.SIGNAL),  # identification alone
        ((0.5, 0.4, 0.4), (-6.0, -6.0, -6.0), Verdict.SIGNAL),  # SSIM alone
        ((0.4, 0.4, 0.4), (-6.0, -6.0, -6.0), Verdict.ABSENT),
        ((0.5, 0.4, 0.5), (-6.0, -7.0, -6.0), Verdict.ABSENT),  # beats blank alone
        ((0.5, 0.5, 0.4), (-6.0, -6.0, -7.0), Verdict.ABSENT),  # beats keypoints alone
        ((0.5, 0.4, 0.6), (-6.0, -7.0, -6.0), Verdict.ABSENT),
        ((0.3, 0.4, 0.4), (-7.5, -7.0, -7.0), Verdict.ABSENT),
        ((0.4, 0.4, 0.4), (-7.0, -8.0, -8.0), Verdict.ABSENT),  # beats both, but not chance
    ],
)
def test_both_baselines_must_be_exceeded(
    rng: np.random.Generator, ssim: Sequence[float], bits: Sequence[float], expected: Verdict
) -> None:
    attack, blank, keypoints = (build_values(rng, *pair, spread=0.02) for pair in zip(ssim, bits, strict=True))
    signal = judge_signal(attack, [("blank", blank), ("keypoints", keypoints)])
    assert signal.verdict is expected
    assert signal.word == ("yes" if expected is Verdict.SIGNAL else "no")


def test_an_attack_at_its_baselines_seldom_has_a_signal(rng: np.random.Generator) -> None:
    """The error rate is at most 2.5%. The control has no pairs of baselines and no correction, and errs more often."""
    verdicts, uncorrected = [], []
    for _ in range(400):
        attack, blank, keypoints = (build_values(rng, 0.4, -6.0) for _ in range(3))
        signal = judge_signal(attack, [("blank", blank), ("keypoints", keypoints)])
        verdicts.append(signal.verdict is Verdict.SIGNAL)
        pairs = itertools.product(METRICS, (blank, keypoints))
        tests = [
            stats.ttest_rel(list(attack[metric].values()), list(other[metric].values()), alternative="greater").pvalue
            for metric, other in pairs
        ]
        uncorrected.append(min(tests) < SIGNIFICANCE)
    assert np.mean(verdicts) <= 0.04
    assert np.mean(uncorrected) > 0.05


def test_a_random_order_beats_a_constant_image_in_bits_and_has_no_signal(rng: np.random.Generator) -> None:
    """A constant image has the mean rank of a tie, whose logarithm is less than the mean logarithm of random ranks."""
    samples = [str(number) for number in range(2000)]
    tied = {"identified": dict.fromkeys(samples, -math.log2((chance.PHOTOGRAPHS + 1) / 2))}
    ranks = rng.integers(1, chance.PHOTOGRAPHS + 1, len(samples))
    random = {"identified": dict(zip(samples, -np.log2(ranks), strict=True))}
    signal = judge_signal(random, [("blank", tied), ("keypoints", tied)])
    assert signal.verdict is Verdict.ABSENT
    (test,) = signal.tests
    assert test.differences["blank"].low > 0  # the control: against the constant image alone it would have one
    assert test.differences["chance"].low < 0 < test.differences["chance"].high
    assert float(np.mean(1 / ranks)) == pytest.approx(chance.RECIPROCAL_RANK, abs=0.01)
    expected = sum(1 / rank for rank in range(1, 257)) / 256
    assert pytest.approx(expected) == chance.RECIPROCAL_RANK


def test_without_both_baselines_nothing_is_tested(rng: np.random.Generator) -> None:
    values = build_values(rng, 0.9, -1.0)
    low = build_values(rng, 0.1, -7.0)
    for given in itertools.chain.from_iterable(itertools.combinations(BASELINES, count) for count in (0, 1)):
        signal = judge_signal(values, [(name, low) for name in given])
        missing = [name for name in BASELINES if name not in given]
        assert signal.verdict is Verdict.UNTESTED
        assert signal.text == f"not tested: no {' and no '.join(missing)} records"
        advice = explain_untested([signal])
        assert advice is not None
        assert [f"--attack {name}" in advice for name in BASELINES] == [name in missing for name in BASELINES]
    few = {"ssim": dict(list(values["ssim"].items())[: MIN_SAMPLES - 1])}
    assert judge_signal(few, [(name, low) for name in BASELINES]).text == (
        f"not tested: {MIN_SAMPLES - 1} samples with blank and keypoints; at least {MIN_SAMPLES} are needed"
    )
    assert explain_untested([judge_signal(values, [(name, low) for name in BASELINES]), None]) is None


# ---- records

HIGH, LOW = [0.5, 0.6, 0.55, 0.62, 0.48, 0.57, 0.6], [0.4, 0.41, 0.38, 0.42, 0.4, 0.39, 0.41]


def judge(records: Sequence[dict[str, Any]]) -> list[str | None]:
    """Return the verdicts of experiments, in the order of their first records."""
    experiments: dict[str, list[dict[str, Any]]] = {}
    for one in records:
        experiments.setdefault(one["run_hash"], []).append(one)
    return [signal and signal.text for signal in judge_experiments(list(experiments.values()))]


def test_baselines_of_another_defense_serve_where_the_positions_are_equal() -> None:
    given = [*reconstructions(ldp(8.0), HIGH), *baselines(NONE, 7, 0.4)]
    assert judge(given) == ["signal", "baseline", "baseline"]
    fewer = [one | {"privacy": one["privacy"] | {"keypoints": 50}} for one in baselines(NONE, 7, 0.4)]
    assert judge([*reconstructions(ldp(8.0), HIGH), *fewer])[0] == "not tested: no keypoints records"
    hidden = [one | {"privacy": one["privacy"] | {"uncovered": []}} for one in reconstructions(ldp(8.0), HIGH)]
    assert judge([*hidden, *baselines(NONE, 7, 0.4)])[0] == "not tested: no keypoints records"
    # A defense's own baselines come first.
    own = [*given, *reconstructions(ldp(8.0), [0.7] * 7, attack={"name": "keypoints"})]
    assert judge(own)[0] == TEXT


def test_hidden_positions_have_no_baseline_of_positions() -> None:
    """`blank` of another defense serves, and a `keypoints` of clear positions is not compared, however strong."""

    def hide(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
        hidden = {"uncovered": [Lines.disclosed, *fabricated.UNCOVERED[1:]]}
        return [one | {"privacy": one["privacy"] | hidden} for one in records]

    lines, guess = {"name": "lines"}, {"name": "neighbourhood"}
    blank, clear = baselines(NONE, 7, 0.4)[:7], reconstructions(NONE, [0.9] * 7, attack={"name": "keypoints"})
    for scores, expected in ((HIGH, "signal"), (LOW, TEXT)):
        records = reconstructions(lines, scores, attack=guess)
        assert judge([*hide(records), *blank, *clear])[0] == expected
        assert judge([*hide(records), *clear])[0] == "not tested: no blank records"
        assert judge([*records, *blank])[0] == "not tested: no keypoints records"  # the control: positions in the clear


def test_a_weaker_copy_of_a_baseline_does_not_help() -> None:
    weak = {"name": "keypoints", "weights": "sha256:" + "0" * 64}
    records = [*reconstructions(NONE, LOW), *baselines(NONE, 7, 0.45)]
    assert judge([*records, *reconstructions(NONE, [0.1] * 7, attack=weak)])[0] == TEXT


def test_identification_is_compared_in_bits() -> None:
    """Here SSIM is at the baseline, and the ranks are not."""
    records = [*reconstructions(NONE, LOW), *baselines(NONE, 7, 0.4)]
    for one in records:
        one["metrics"]["identified"] = 1 / 2 if one["attack"] == DIA else 1 / 128.5
    assert judge(records)[0] == "signal"
    for one in records:
        one["metrics"]["identified"] = 1 / 128.5
    assert judge(records)[0] == TEXT


def test_experiments_without_images_have_no_signal_to_judge() -> None:
    pair = fabricated.record("a-b", {"accuracy_3px": 0.7}, defense=NONE, task="matching", attack=None)
    angle = fabricated.record("0.png", {"angle": 40.0}, defense=NONE, attack={"name": "nearest"})
    missing = fabricated.inapplicable(NONE, DIA, "no network")
    assert judge([pair, angle, missing]) == [None, None, None]


# ---- marks


def list_records() -> list[dict[str, Any]]:
    """`none` has a signal, and `ldp` has none. Without its mark `ldp` would have rank 1."""
    return [*reconstructions(NONE, HIGH), *reconstructions(ldp(8.0), LOW), *baselines(NONE, 7, 0.4)]


def build_group(folder: Path, records: Sequence[dict[str, Any]]) -> comparison.ComparisonGroup:
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(folder, records)))
    return group


def test_a_defense_without_a_signal_is_listed_but_has_no_rank(tmp_path: Path) -> None:
    standings = rank_defenses(build_group(tmp_path / "a", list_records()))
    assert [(one.defense.partition(":")[0], one.rank, one.unranked_reason) for one in standings] == [
        ("none", 1, None),
        ("ldp", None, TEXT),
    ]
    untested = rank_defenses(build_group(tmp_path / "b", list_records()[:14]))
    assert {one.unranked_reason for one in untested} == {"not tested: no blank and no keypoints records"}


def test_the_strongest_attack_has_a_signal_if_any_has(tmp_path: Path) -> None:
    """An attack without a signal can have the greater mean by chance. A baseline is not the strongest attack."""
    noisy = reconstructions(ldp(8.0), [0.95, 0.05] * 3 + [0.97], attack={"name": "noisy"})
    records = [*reconstructions(ldp(8.0), HIGH), *noisy, *baselines(ldp(8.0), 7, 0.4)]
    (standing,) = rank_defenses(build_group(tmp_path / "a", records))
    assert standing.strongest is not None
    assert (standing.strongest.attack, standing.rank) == ("dia", 1)
    records = [*reconstructions(ldp(8.0), LOW), *baselines(ldp(8.0), 7, 0.5)]
    (standing,) = rank_defenses(build_group(tmp_path / "b", records))
    assert standing.strongest is not None
    assert (standing.strongest.attack, standing.rank) == ("dia", None)


def test_an_oracle_is_a_reference_and_never_the_strongest_attack(tmp_path: Path) -> None:
    """Control: with the same scores under another name, it is the strongest."""
    records = [*reconstructions(NONE, [0.5 + number / 100 for number in range(7)]), *baselines(NONE, 7)]
    for name, strongest, verdict in (("oracle", "dia", Verdict.REFERENCE), ("other", "other", Verdict.SIGNAL)):
        better = reconstructions(NONE, [0.8 + number / 100 for number in range(7)], attack={"name": name})
        group = build_group(tmp_path / name, [*records, *better])
        (standing,) = rank_defenses(group)
        assert standing.strongest is not None
        assert standing.strongest.metadata["attack"]["name"] == strongest
        (own,) = [one for one in group.experiments if one.metadata["attack"]["name"] == name]
        assert group.signals[own].verdict is verdict


def test_tables_of_the_leaderboard_mark_it_in_every_format(tmp_path: Path) -> None:
    group = build_group(tmp_path, list_records())
    table, ranking = build_pairs_table(group), build_ranking_table(group)
    words = {(row.values["defense"], row.values["attack"]): row.values["signal"] for row in table.rows}
    assert words == {
        ("none", "dia"): "yes",
        ("none", "blank"): "baseline",
        ("none", "keypoints"): "baseline",
        ("ldp:epsilon=8,subset_size=2", "dia"): "no",
    }
    for written in (to_markdown(table), to_markdown(ranking), to_latex(table), to_latex(ranking)):
        assert f"unranked: {TEXT}" in written
    assert "not tested" not in to_markdown(table)
    rows = list(csv.DictReader(io.StringIO(to_csv(ranking))))
    assert [(row["rank"], row["signal"]) for row in rows] == [("1", "yes"), ("n/a", "no")]
    assert not table.rows[-1].best
    assert "Add --attack blank --attack keypoints." in to_markdown(
        build_pairs_table(build_group(tmp_path / "b", list_records()[:14]))
    )


@pytest.mark.parametrize("brief", [False, True])
def test_the_report_of_a_run_marks_it_and_says_which_baselines_are_missing(brief: bool) -> None:
    (table,) = tables.build_tables(list_records(), brief=brief)
    notes = [row.values["note"] for row in table.rows]
    assert [note.startswith(TEXT) for note in notes] == [False, True, False, False]
    assert [row.note for row in table.rows] == (notes if brief else [""] * 4)
    signals = [row["signal"] for row in csv.DictReader(io.StringIO(to_csv(table)))]
    assert signals == ["signal", TEXT, "baseline", "baseline"]
    assert not any("--attack" in remark for remark in table.remarks)
    (table,) = tables.build_tables(list_records()[:21], brief=brief)  # without keypoints
    assert any("no keypoints records" in remark and "Add --attack keypoints." in remark for remark in table.remarks)
    assert [row.values["signal"] for row in table.rows][:2] == ["not tested: no keypoints records"] * 2


def test_chance_is_beside_identification(tmp_path: Path) -> None:
    records = list_records()
    for one in records:
        one["metrics"]["identified"] = 0.01
    (table,) = tables.build_tables(records)
    for written in (to_markdown(table, plain=True), to_markdown(build_pairs_table(build_group(tmp_path, records)))):
        assert "identified (chance 0.024)" in written
        assert "rank 1 for 1 of 256" in written


@pytest.mark.slow
def test_the_site_marks_it(tmp_path: Path) -> None:
    localized = [
        *fabricated.localizations(NONE, [1, 1], [None, None]),
        *fabricated.localizations(ldp(8.0), [1, 0], [None, None]),
    ]
    folder = fabricated.write(tmp_path / "runs", [*list_records(), *localized])
    page = site.write([folder], tmp_path / "site").page.read_text(encoding="utf-8")
    assert page.count('class="strongest unranked no-signal"') == 1
    assert f"unranked: {TEXT}" in page
    assert page.count('<g class="baseline blank"><title>') == page.count('<g class="baseline keypoints"><title>') == 1
    assert f"ldp:epsilon=8,subset_size=2, unranked: {TEXT}" in page  # of the point in the plot


# ---- a network that has learned nothing


@pytest.mark.exhaustive
def test_a_network_with_shuffled_weights_is_marked(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """The built-in photographs without a defense: the shipped network has a signal, and its shuffled copy has none."""
    arrays, meta, _ = tensor_file.load(ASSETS / "inversion-none.safetensors", weights.KIND)
    shuffled = tmp_path / "shuffled.safetensors"
    permuted = {name: rng.permutation(array.ravel()).reshape(array.shape) for name, array in arrays.items()}
    tensor_file.save(shuffled, weights.KIND, permuted, meta)
    attacks = ("dia", f"dia:weights={shuffled}", *BASELINES)
    options = [word for attack in attacks for word in ("--attack", attack)]
    assert cli.main(["run", "--defense", "none", *options, "--out", str(tmp_path / "run")]) == 0
    (group,) = comparison.build_groups(comparison.load_records(tmp_path / "run"))
    rows = build_pairs_table(group).rows
    assert [row.values["signal"] for row in rows] == ["yes", "no", "baseline", "baseline"]
    assert TEXT in capsys.readouterr().out
    assert TEXT in (tmp_path / "run" / "report.md").read_text(encoding="utf-8")
    others = [row.experiment for row in rows if row.values["signal"] != "yes"]
    (alone,) = comparison.build_groups([located for one in others for located in one.records])
    assert [(one.rank, one.unranked_reason) for one in rank_defenses(alone)] == [(None, TEXT)]
