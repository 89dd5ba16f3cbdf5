"""Worst cases over a suite of attacks: the claim of a version, the worst case, and the flags of attacks that failed."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fabricated
import pytest
from fabricated import SCORES, STANDARD, inapplicable, ldp, localizations, reconstructions, run_suite

from bench.core.table import Row, to_csv, to_markdown
from bench.registry import discovery
from bench.runner import attack_suite
from bench.runner.attack_suite import AttackSuite
from leaderboard import attack_cost, comparison, run_report, site
from leaderboard.attack_flags import NOT_MONOTONE, WEAKER, flag_attacks, knows_less
from leaderboard.comparison import ComparisonGroup
from leaderboard.provenance import read_digests
from leaderboard.suite_table import NOT_STATED, build_group_tables, build_run_tables
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


def find_row(group: ComparisonGroup, groups: Sequence[ComparisonGroup] = ()) -> Row:
    (row,) = build_group_tables(group, groups)["defenses"].rows
    return row


def test_the_row_of_a_defense(tmp_path: Path) -> None:
    digests, scores = read_digests(), {**SCORES, "repeat": 0.3}
    weights = {"name": "dia", "weights": digests["inversion-ldp.safetensors"]}
    records = [rebuild(one, attack=weights) if one["attack"]["name"] == "dia" else one for one in run_suite(scores)]
    row = find_row(build_group(tmp_path, records))
    stages = 73_600 + 24_000 + 44_800 + 12_000 + 24_000 + 134_400
    cells = [STANDARD, "n/a", "0.5 [0.4852, 0.5148] by dia, to 0.7 by oracle", "n/a", "ε-LDP, ε = 10 per descriptor"]
    cost = [f"{stages + 175_000:,}", "1"]  # with the context model; half a second with two threads
    assert row.texts[1:] == (*cells, *cost, f"{WEAKER}: repeat:releases=2 than dia")
    assert [row.values[name] for name in ("ssim_attack", "ssim_training_samples", "identified")] == [
        "dia",
        stages + 175_000,
        None,
    ]
    assert row.values["ssim_oracle"].mean == pytest.approx(0.7)


def test_training_samples_of_other_networks_are_not_stated(tmp_path: Path) -> None:
    other = {"name": "dia", "weights": "sha256:" + "e" * 64}
    records = [
        rebuild(one, attack=other) if one["attack"]["name"] == "dia" else one for one in run_suite({**SCORES, "repeat": 0.3})
    ]
    assert NOT_STATED in find_row(build_group(tmp_path, records)).texts
    assert attack_cost.count_training_samples(other) is None
    assert attack_cost.count_training_samples({"name": "dia", "weights": "shipped"}) is None
    assert attack_cost.count_training_samples({"name": "repeat", "releases": 2, "inversion": other}) is None


def test_training_samples_of_shipped_files() -> None:
    """Networks of every kind state them. Dictionaries are no networks."""
    networks = ("inversion", "context", "flow", "neighbours", "positions", "line")
    for name, digest in read_digests().items():
        count = attack_cost.count_training_samples({"name": "any", "file": digest})
        assert count is not None
        assert (count > 0) == name.startswith(networks), name
    assert attack_cost.count_training_samples({"name": "density", "width": 8.0}) == 0


def test_core_seconds_are_those_of_processors() -> None:
    environments = [{"threads": 2, "device": "cpu"}, {"threads": 2, "device": "cuda"}, {"device": "cpu"}]
    records = [{"seconds": seconds, "environment": environment} for environment in environments for seconds in (1.0, 3.0, None)]
    assert attack_cost.measure_core_seconds(records) == 4.0
    assert attack_cost.measure_core_seconds(records[3:]) is None


@pytest.mark.parametrize(("oracle", "bracket"), [(0.7, ", to 0.7 by oracle"), (0.55, ""), (None, "")])
def test_a_bracket_needs_an_oracle_that_scores_higher(tmp_path: Path, oracle: float | None, bracket: str) -> None:
    scores = {name: score for name, score in {**SCORES, "oracle": oracle}.items() if score is not None}
    row = find_row(build_group(tmp_path, run_suite(scores)))
    assert row.texts[3] == f"0.6 [0.5852, 0.6148] by repeat:releases=2{bracket}"
    assert (row.values["ssim_oracle"] is None) == (oracle is None)


def test_the_setting_nearest_to_the_fixed_recall_is_marked(tmp_path: Path) -> None:
    hits = {8.0: [0, 0, 0, 0, 1], 10.0: [0, 0, 1, 1, 1], 12.0: [1] * 5}
    attacked = {epsilon: run_suite(epsilon=epsilon) for epsilon in hits}
    served = {epsilon: localizations(ldp(epsilon), each, [None] * 5) for epsilon, each in hits.items()}

    def list_utilities(folder: str, *epsilons: float) -> list[str]:
        records = [one for epsilon in epsilons for one in (*attacked[epsilon], *served[epsilon])]
        groups = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path / folder, records)))
        return [row.texts[4] for row in build_group_tables(groups[0], groups)["defenses"].rows]

    texts = [f"recall (0.25 m, 2°) {recall} on gallery" for recall in ("0.2", "0.6", "1")]
    assert list_utilities("several", *hits) == [texts[0], f"{texts[1]}, nearest to 0.5", texts[2]]
    assert list_utilities("one", 10.0) == [texts[1]]  # there is no choice


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


def list_flags_by_measure(group: ComparisonGroup) -> dict[str, str]:
    table = build_group_tables(group)["worst-case"]
    return {row.values["measure"]: row.values["flags"] for row in table.rows}


def test_flags_that_hold_by_all_measures_are_on_all_rows(tmp_path: Path) -> None:
    """The comparisons with less knowledge and with other ε are of SSIM and `identified`. Other rows say so."""
    scores, untested = {**SCORES, "context": 0.2, "repeat": 0.3}, f"not tested: {WEAKER}, {NOT_MONOTONE}"
    records = [rebuild(one, notes=["not converged: x"]) if one["attack"]["name"] == "dia" else one for one in run_suite(scores)]
    flags = "at baseline: context:estimate=word; not converged: dia in 6 of 6 samples; "
    flagged = list_flags_by_measure(build_group(tmp_path / "flagged", records))
    assert flagged == {"ssim": f"{flags}{WEAKER}: repeat:releases=2 than dia", "mae": flags + untested}
    assert list_flags_by_measure(build_group(tmp_path / "none", run_suite())) == {"ssim": "", "mae": untested}
    few = [one for one in run_suite() if one["sample"] in ("0.png", "*")]
    assert list_flags_by_measure(build_group(tmp_path / "few", few)) == {"ssim": untested, "mae": untested}


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
    table = build_group_tables(build_group(tmp_path, run_suite({**SCORES, "repeat": 0.3})))["worst-case"]
    (row,) = (row for row in table.rows if row.values["measure"] == "ssim")
    assert [row.values[name] for name in ("suite", "attack", "signal")] == [STANDARD, "dia", "yes"]
    assert row.values["flags"] == f"{WEAKER}: repeat:releases=2 than dia"
    assert STANDARD in to_markdown(table)
    assert "worst_case_low" in to_csv(table)


def test_a_run_of_the_newest_version_has_the_older_one_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it can be compared with the rows of the older version."""
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: [STANDARD, NEWEST])
    group = build_group(tmp_path / "new", run_suite(suite=NEWEST))
    assert [result.version for result in list_results(group)] == [STANDARD, NEWEST]
    shown, terminal = (build_group_tables(group, brief=brief)["worst-case"] for brief in (False, True))
    assert {row.values["suite"] for row in shown.rows} == {STANDARD, NEWEST}
    assert {row.values["suite"] for row in terminal.rows} == {NEWEST}
    assert {row.values["suite"]: row.values["latest"] for row in shown.rows} == {STANDARD: False, NEWEST: True}
    (older,) = list_results(build_group(tmp_path / "old", run_suite()))
    assert older.version == STANDARD


def test_table_of_an_incomplete_run_lists_what_is_missing(tmp_path: Path) -> None:
    records = run_suite(without=["lattice"])
    table = build_group_tables(build_group(tmp_path, records))["worst-case"]
    assert {row.values["suite"] for row in table.rows} == {f"incomplete: {STANDARD}"}
    assert {row.note for row in table.rows} == {"missing: lattice:longest=520 (not run)"}
    assert build_run_tables(records) == []  # the report of a run of single attacks is as before
    (defenses, report), (_, terminal) = build_run_tables(run_suite()), build_run_tables(run_suite(), brief=True)
    assert [row.values["suite"] for row in defenses.rows] == [STANDARD]
    assert [row.values["measure"] for row in report.rows] == ["ssim", "mae"]
    assert [row.values["measure"] for row in terminal.rows] == ["ssim"]


def test_the_report_lists_what_is_missing(tmp_path: Path) -> None:
    reason = "no adapted attacker; train one with `bench train`"
    scores = {name: score for name, score in SCORES.items() if name != "dia"}
    records = [inapplicable(ldp(10.0), {"name": "dia", "weights": "shipped"}, reason), *run_suite(scores, without=["dia"])]
    run_report.write(records, tmp_path, "bench run")
    assert (tmp_path / "report.md").read_text(encoding="utf-8").count("[1] missing: dia (no adapted attacker") == 2


@pytest.mark.slow
def test_the_page_shows_the_worst_cases(tmp_path: Path) -> None:
    fabricated.write(tmp_path / "results", run_suite())
    page = site.write([tmp_path / "results"], tmp_path / "site").page.read_text(encoding="utf-8")
    assert "Worst case over a suite of attacks" in page
    assert page.index("Worst case of each defense") < page.index(f"<td>{STANDARD}</td>") < page.index("<details")
    assert page.index("<details") < page.index('class="frame"')  # the table of pairs
    for kind in ("defenses", "worst-case"):
        (table,) = (tmp_path / "site" / "tables").glob(f"*-{kind}.csv")
        assert STANDARD in table.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_shows_rows_of_older_versions_in_a_collapsed_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack_suite, "list_attack_suites", lambda: [STANDARD, NEWEST])

    def list_rows(name: str, records: Sequence[dict[str, Any]]) -> list[tuple[str, int, int]]:
        """Return the table, and the rows of the older and of the newest version in it, for each table of worst cases."""
        fabricated.write(tmp_path / name / "results", records)
        written = site.write([tmp_path / name / "results"], tmp_path / name / "site")
        parts = re.findall(
            r'role="region" aria-label="(Worst case.*?)">(.*?)</table>', written.page.read_text("utf-8"), re.DOTALL
        )
        return [(label, *(part.count(f"<td>{suite}</td>") for suite in (STANDARD, NEWEST))) for label, part in parts]

    title, older = "Reconstruction on photos", ", older versions of the suite"
    defenses, measures = f"Worst case of each defense, {title}", f"Worst cases of {title}"
    both = [*run_suite(suite=NEWEST), *run_suite(epsilon=12.0)]
    assert list_rows("both", both) == [(defenses, 1, 1), (defenses + older, 1, 0), (measures, 2, 2), (measures + older, 2, 0)]
    page = (tmp_path / "both" / "site" / "index.html").read_text(encoding="utf-8")
    assert page.index("<summary>Older versions of the suite") < page.index(older)
    assert "<details open" not in page
    (table,) = (tmp_path / "both" / "site" / "tables").glob("*-defenses.csv")  # files hold the rows of all versions
    assert [table.read_text(encoding="utf-8").count(suite) for suite in (STANDARD, NEWEST)] == [2, 1]
    assert list_rows("old", run_suite()) == [(defenses, 1, 0), (measures, 2, 0)]  # the control: one version alone
