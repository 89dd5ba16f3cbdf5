"""Worst cases over a suite of attacks: the claim of a version, the worst case, and the flags of attacks that failed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fabricated
import pytest
from fabricated import SCORES, STANDARD, inapplicable, ldp, reconstructions, run_suite

from bench.core.table import to_csv, to_markdown
from bench.registry import discovery
from bench.runner import attack_suite
from bench.runner.attack_suite import AttackSuite
from leaderboard import comparison, site
from leaderboard.attack_flags import NOT_MONOTONE, WEAKER, flag_attacks, knows_less
from leaderboard.comparison import ComparisonGroup
from leaderboard.suite_table import build_run_tables, build_suite_table
from leaderboard.worst_case import SuiteResult, list_results

NEWEST = attack_suite.list_attack_suites()[-1]


@pytest.fixture(autouse=True)
def _one_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: [STANDARD])


def build_group(folder: Path, records: Sequence[dict[str, Any]]) -> ComparisonGroup:
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(folder, records)))
    return group


def find_result(group: ComparisonGroup) -> SuiteResult:
    (result,) = list_results(group)
    return result


def list_flags(group: ComparisonGroup) -> list[str]:
    return [flag.text for flag in flag_attacks(group, list_results(group))]


def test_a_complete_run_has_the_version_and_the_worst_case(tmp_path: Path) -> None:
    result = find_result(build_group(tmp_path, run_suite()))
    assert result.version == STANDARD
    worst = {one.measure.name: one for one in result.worst_cases}
    assert worst["ssim"].experiment.metadata["attack"]["name"] == "repeat"  # not the oracle, which is a reference
    assert worst["ssim"].score.mean == pytest.approx(0.6)
    assert worst["mae"].score.mean == pytest.approx(0.6 - 0.6 / 2)  # the least error
    assert {name: score.mean for name, score in worst["ssim"].baselines.items()} == pytest.approx(
        {"blank": 0.1, "keypoints": 0.2}
    )
    assert worst["ssim"].oracle
    assert worst["ssim"].oracle.mean == pytest.approx(0.7)


def rebuild(one: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return a record of another experiment, with the same result."""
    more = {name: one[name] for name in ("defense", "attack", "status", "reason")}
    return fabricated.record(one["sample"], one["metrics"], **{**more, **changes})


def test_a_run_without_an_attack_may_not_claim_the_version(tmp_path: Path) -> None:
    result = find_result(build_group(tmp_path, run_suite(without=["lattice"])))
    assert result.version is None
    assert result.missing == ("lattice:longest=520 (not run)",)
    assert not result.is_complete_run


def test_a_run_with_other_settings_may_not_claim_the_version(tmp_path: Path) -> None:
    records = [
        rebuild(one, attack=one["attack"] | {"releases": 3}) if one["attack"]["name"] == "repeat" else one for one in run_suite()
    ]
    result = find_result(build_group(tmp_path, records))
    assert result.version is None
    assert result.missing == ("repeat:releases=2 (not run)",)
    assert {one.measure.name: one.score.mean for one in result.worst_cases}["ssim"] == pytest.approx(0.5)  # by dia


def test_a_run_with_missing_samples_may_not_claim_the_version(tmp_path: Path) -> None:
    records = [one for one in run_suite() if (one["attack"]["name"], one["sample"]) != ("context", "0.png")]
    result = find_result(build_group(tmp_path, records))
    assert result.version is None
    assert result.missing == ("context:estimate=word (1 of 6 samples missing)",)


def test_an_attack_without_a_network_is_missing_until_one_is_trained(tmp_path: Path) -> None:
    scores = {name: score for name, score in SCORES.items() if name != "dia"}
    untrained = inapplicable(
        ldp(10.0), {"name": "dia", "weights": "shipped"}, "no adapted attacker; train one with `bench train`"
    )
    records = [untrained, *run_suite(scores, without=["dia"])]
    assert find_result(build_group(tmp_path / "untrained", records)).missing == (f"dia ({untrained['reason']})",)
    trained = reconstructions(ldp(10.0), [0.3] * 6, attack={"name": "dia", "weights": "sha256:" + "e" * 64})
    assert find_result(build_group(tmp_path / "trained", [*records, *trained])).version == STANDARD


def test_old_rows_keep_their_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = attack_suite.find(STANDARD)
    specs = tuple("repeat:releases=3" if text == "repeat:releases=2" else text for text in old.specs)
    suites = {one.name: one for one in (old, AttackSuite(name="standard-2026.2", summary="", specs=specs))}
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: list(suites))
    monkeypatch.setattr(attack_suite, "find", suites.__getitem__)
    records = run_suite()
    assert find_result(build_group(tmp_path / "old", records)).version == STANDARD
    partial = find_result(build_group(tmp_path / "partial", run_suite(without=["lattice"])))
    assert (partial.version, partial.suite) == (None, "standard-2026.2")
    again = [rebuild(one, attack=one["attack"] | {"releases": 3}) for one in records if one["attack"]["name"] == "repeat"]
    results = list_results(build_group(tmp_path / "both", [*records, *again]))
    assert [result.version for result in results] == list(suites)


def test_flags_only_of_attacks_that_failed(tmp_path: Path) -> None:
    assert list_flags(build_group(tmp_path, run_suite())) == []


def test_an_attack_at_the_baselines_is_flagged(tmp_path: Path) -> None:
    flags = list_flags(build_group(tmp_path, run_suite({**SCORES, "context": 0.2})))
    assert set(flags) == {"at baseline: context:estimate=word"}


def test_an_attack_that_reached_its_budget_is_flagged(tmp_path: Path) -> None:
    notes = {"0.png": ["not converged: coverage below 0.95"], "1.png": ["coverage 0.96", "it converged"]}
    records = [
        rebuild(one, notes=notes.get(one["sample"], [])) if one["attack"]["name"] == "repeat" else one for one in run_suite()
    ]
    assert set(list_flags(build_group(tmp_path, records))) == {"not converged: repeat:releases=2 in 1 of 6 samples"}


def test_an_attack_with_more_knowledge_that_scores_lower_is_flagged(tmp_path: Path) -> None:
    flags = list_flags(build_group(tmp_path, run_suite({**SCORES, "repeat": 0.3})))
    assert flags == [f"{WEAKER}: repeat:releases=2 than dia"]  # once, by the strongest
    noise = list_flags(build_group(tmp_path / "noise", run_suite({**SCORES, "repeat": 0.499})))
    assert noise == []  # within the noise of the photographs


@pytest.mark.parametrize(
    ("less", "more", "expected"),
    [
        ("blank", "keypoints", True),
        ("keypoints", "dia", True),
        ("dia", "oracle", True),
        ("lattice", "database", True),
        ("nearest", "clustering", True),
        ("neighbourhood", "snap", True),
        ("dia", "context", False),  # equal knowledge
        ("database", "lattice", False),
        ("nearest", "database", False),  # neither contains the other
        ("oracle", "repeat", False),
    ],
)
def test_order_of_knowledge(less: str, more: str, expected: bool) -> None:
    one, other = (discovery.load_plugin(discovery.ATTACK, name) for name in (less, more))
    assert knows_less(one, other) is expected
    assert not (expected and knows_less(other, one))


@pytest.mark.parametrize(("scores", "flagged"), [((0.3, 0.5, 0.6), []), ((0.3, 0.6, 0.5), [12.0]), ((0.5, 0.5, 0.5), [])])
def test_scores_that_fall_with_epsilon_are_flagged(tmp_path: Path, scores: tuple[float, ...], flagged: list[float]) -> None:
    epsilons = (8.0, 10.0, 12.0)
    records = [
        one
        for epsilon, score in zip(epsilons, scores, strict=True)
        for one in run_suite({**SCORES, "dia": score, "repeat": 0.8, "oracle": 0.9, "context": 0.4}, epsilon=epsilon)
    ]
    group = build_group(tmp_path, records)
    flags = [flag for flag in flag_attacks(group, list_results(group)) if flag.text.startswith(NOT_MONOTONE)]
    assert [flag.experiment.metadata["defense"]["epsilon"] for flag in flags] == flagged
    assert all("dia scores lower at 12 than at 10" in flag.text for flag in flags)


def test_defenses_that_differ_in_more_than_epsilon_are_not_compared(tmp_path: Path) -> None:
    other = ldp(12.0) | {"subset_size": 4}
    records = run_suite({**SCORES, "dia": 0.55}, epsilon=10.0)
    records += [
        fabricated.record(
            one["sample"], one["metrics"], defense=other, attack=one["attack"], status=one["status"], reason=one["reason"]
        )
        for one in run_suite({**SCORES, "dia": 0.45}, epsilon=12.0)
    ]
    assert list_flags(build_group(tmp_path, records)) == []


def test_table_shows_version_attack_baselines_and_flags(tmp_path: Path) -> None:
    table = build_suite_table(build_group(tmp_path, run_suite({**SCORES, "repeat": 0.3})))
    assert table
    (row,) = (row for row in table.rows if row.values["measure"] == "ssim")
    assert [row.values[name] for name in ("suite", "attack", "signal")] == [STANDARD, "dia", "yes"]
    assert row.values["flags"] == f"{WEAKER}: repeat:releases=2 than dia"
    assert STANDARD in to_markdown(table)
    assert "worst_case_low" in to_csv(table)


def test_a_run_of_the_newest_version_has_the_older_one_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it can be compared with the rows of the older version."""
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: [STANDARD, NEWEST])
    results = list_results(build_group(tmp_path / "new", run_suite(suite=NEWEST)))
    assert [result.version for result in results] == [STANDARD, NEWEST]
    (older,) = list_results(build_group(tmp_path / "old", run_suite()))
    assert older.version == STANDARD


def test_table_of_an_incomplete_run_lists_what_is_missing(tmp_path: Path) -> None:
    records = run_suite(without=["lattice"])
    table = build_suite_table(build_group(tmp_path, records))
    assert table
    assert {row.values["suite"] for row in table.rows} == {f"incomplete: {STANDARD}"}
    assert {row.note for row in table.rows} == {"missing: lattice:longest=520 (not run)"}
    assert build_run_tables(records) == []  # the report of a run of single attacks is as before
    (report,), (terminal,) = build_run_tables(run_suite()), build_run_tables(run_suite(), brief=True)
    assert [row.values["measure"] for row in report.rows] == ["ssim", "mae"]
    assert [row.values["measure"] for row in terminal.rows] == ["ssim"]


@pytest.mark.slow
def test_the_page_shows_the_worst_cases(tmp_path: Path) -> None:
    fabricated.write(tmp_path / "results", run_suite())
    page = site.write([tmp_path / "results"], tmp_path / "site").page.read_text(encoding="utf-8")
    assert "Worst case over a suite of attacks" in page
    assert f"<td>{STANDARD}</td>" in page
    (table,) = (tmp_path / "site" / "tables").glob("*-worst-case.csv")
    assert STANDARD in table.read_text(encoding="utf-8")
