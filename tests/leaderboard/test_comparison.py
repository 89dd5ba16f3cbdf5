"""Comparison groups, and the ranking of defenses within a group."""

from pathlib import Path
from typing import Any

import fabricated
import pytest
from fabricated import (
    DIA,
    ENVIRONMENT,
    GALLERY,
    PHOTOGRAPHS,
    SETTINGS,
    baselines,
    inapplicable,
    ldp,
    localizations,
    reconstructions,
)

from bench.core.errors import UserError
from leaderboard import comparison, group_tables
from leaderboard.comparison import ComparisonGroup
from leaderboard.measures import list_measures
from leaderboard.ranking import Standing, rank_defenses

NONE = {"name": "none"}
NEAREST = {"name": "nearest"}


def build(tmp_path: Path, *parts: list[dict[str, Any]]) -> list[ComparisonGroup]:
    records = [record for part in parts for record in part]
    return comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))


def by_defense(group: ComparisonGroup) -> dict[str, Standing]:
    return {standing.defense: standing for standing in rank_defenses(group)}


# ---- separate groups


@pytest.mark.parametrize(
    "other",
    [
        {"dataset": PHOTOGRAPHS | {"hash": "sha256:" + "e" * 64}},  # another split
        {"dataset": PHOTOGRAPHS | {"extractor": {"name": "sift", "upright": False}}},
        {"settings": SETTINGS | {"ssim": {"sigma": 1.0}}},
        {"environment": ENVIRONMENT | {"source": "sha256:" + "6" * 64}},
        {"task": "collisions"},
        {"task_settings": {"inverter": "other"}},
    ],
    ids=["split", "extractor", "metrics", "source", "task", "settings"],
)
def test_incomparable_records_have_separate_groups(tmp_path: Path, other: dict[str, Any]) -> None:
    groups = build(tmp_path, reconstructions(NONE, [0.5]), reconstructions(NONE, [0.9], **other))
    assert len(groups) == 2
    assert len({group.key for group in groups}) == 2
    assert [len(group.experiments) for group in groups] == [1, 1]


def test_the_name_of_a_dataset_does_not_matter(tmp_path: Path) -> None:
    renamed = PHOTOGRAPHS | {"name": "copy", "spec": None}
    (group,) = build(tmp_path, reconstructions(NONE, [0.5]), reconstructions(ldp(8.0), [0.4], dataset=renamed))
    assert len(group.experiments) == 2


def test_environments_are_separate_experiments_of_one_group(tmp_path: Path) -> None:
    gpu = ENVIRONMENT | {"device": "cuda"}
    (group,) = build(tmp_path, reconstructions(NONE, [0.5]), reconstructions(NONE, [0.6], environment=gpu))
    assert [experiment.attack for experiment in group.experiments] == ["dia (device cpu)", "dia (device cuda)"]
    (standing,) = rank_defenses(group)  # the defense is one, and the stronger run counts
    assert standing.score is not None
    assert standing.score.mean == 0.6


def test_each_seed_has_a_group_and_their_mean_has_one(tmp_path: Path) -> None:
    averaged, first, second = build(
        tmp_path,
        reconstructions(NONE, [0.5, 0.7], seed=1),
        reconstructions(NONE, [0.3, 0.5], seed=2),
        reconstructions(ldp(8.0), [0.1, 0.1], seed=2),
    )
    assert [group.seeds for group in (averaged, first, second)] == [(1, 2), (1,), (2,)]
    assert [len(group.experiments) for group in (averaged, first, second)] == [1, 1, 2]  # ldp lacks a seed, and is not averaged
    (ssim,) = list_measures(["ssim"])
    assert averaged.list_values(averaged.experiments[0], ssim) == [pytest.approx(0.4), pytest.approx(0.6)]
    interval = averaged.average(averaged.experiments[0], ssim)
    assert interval is not None
    assert interval.count == 2  # photographs, not photographs times seeds
    assert "mean over seeds 1, 2" in averaged.facts


def test_a_sample_that_one_seed_lacks_is_not_averaged(tmp_path: Path) -> None:
    other = reconstructions(ldp(8.0), [0.3, 0.5], seed=1), reconstructions(ldp(8.0), [0.3, 0.5], seed=2)
    averaged, *_ = build(tmp_path, reconstructions(NONE, [0.5, 0.9], seed=1), reconstructions(NONE, [0.3], seed=2), *other)
    assert averaged.list_values(averaged.experiments[0], *list_measures(["ssim"])) == [pytest.approx(0.4)]
    assert averaged.count_missing(averaged.experiments[0]) == 1
    assert by_defense(averaged)["none"].unranked_reason == "dia has completed 1 of 2 samples"


def test_records_of_many_folders_are_found_and_the_latest_counts(tmp_path: Path) -> None:
    fabricated.write(tmp_path / "b" / "deep", reconstructions(NONE, [0.8]))
    fabricated.write(tmp_path / "a", reconstructions(NONE, [0.1]))
    (groups,) = comparison.load_records(tmp_path)
    assert groups.record["metrics"]["ssim"] == 0.8
    assert groups.folder == tmp_path / "b" / "deep"


def test_missing_and_damaged_records_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no record in it \(looked for files called records.jsonl\)"):
        comparison.load_records(tmp_path)
    with pytest.raises(UserError, match="absent: no such file"):
        comparison.load_records(tmp_path / "absent")
    (tmp_path / "records.jsonl").write_text("{}\n")
    with pytest.raises(UserError, match=r"records.jsonl, line 1: not a record"):
        comparison.load_records(tmp_path)


# ---- ranking


def test_a_defense_is_judged_by_the_strongest_attack(tmp_path: Path) -> None:
    affine = {"name": "affine", "dim": 4}
    (group,) = build(
        tmp_path,
        reconstructions(NONE, [0.8, 0.8] * 3),
        reconstructions(affine, [0.2, 0.3] * 3),
        reconstructions(affine, [0.6, 0.7] * 3, attack=NEAREST),
        reconstructions(ldp(8.0), [0.4, 0.5] * 3),
        baselines(NONE, 6),
    )
    ranked = rank_defenses(group)
    assert [(one.rank, one.defense) for one in ranked] == [(1, "ldp:epsilon=8,subset_size=2"), (2, "affine:dim=4"), (3, "none")]
    assert ranked[1].strongest is not None
    assert ranked[1].strongest.attack == "nearest"  # by dia alone affine would be first
    shown = group_tables.build_ranking_table(group).rows
    assert [row.values["attack"] for row in shown] == ["dia", "nearest", "dia"]


def test_equal_scores_share_a_rank(tmp_path: Path) -> None:
    scores = ((1.0, 0.3), (2.0, 0.3), (3.0, 0.4))
    (group,) = build(tmp_path, *(reconstructions(ldp(eps), [score] * 6) for eps, score in scores), baselines(ldp(1.0), 6))
    assert [one.rank for one in rank_defenses(group)] == [1, 1, 3]


def identify(records: list[dict[str, Any]], reciprocals: list[float]) -> list[dict[str, Any]]:
    """Return the records with these values of `identified`."""
    for one, value in zip(records, reciprocals, strict=True):
        one["metrics"]["identified"] = value
    return records


def rank_by_both(folder: Path, scores: dict[float, tuple[float, float]], *others: list[dict[str, Any]]) -> ComparisonGroup:
    """Return a group of LDP at each ε with a mean SSIM and a reciprocal rank, and of the baselines."""
    parts = [
        identify(reconstructions(ldp(epsilon), [ssim] * 6), [reciprocal] * 6) for epsilon, (ssim, reciprocal) in scores.items()
    ]
    (group,) = build(folder, *parts, identify(baselines(ldp(1.0), 6), [1 / 128.5] * 12), *others)
    return group


def list_ranks(group: ComparisonGroup) -> dict[float, int | None]:
    return {one.configuration["epsilon"]: one.rank for one in rank_defenses(group)}


def test_identification_ranks_beside_ssim(tmp_path: Path) -> None:
    # Positions in SSIM and in identified, equal sums: the lower identified comes first.
    group = rank_by_both(tmp_path / "a", {1.0: (0.38, 0.5), 2.0: (0.39, 0.1), 3.0: (0.6, 1.0)})
    assert list_ranks(group) == {2.0: 1, 1.0: 2, 3.0: 3}
    # SSIM decides where all are identified, and equal scores share a rank.
    group = rank_by_both(tmp_path / "b", {1.0: (0.5, 1.0), 2.0: (0.6, 1.0), 3.0: (0.6, 1.0)})
    assert list_ranks(group) == {1.0: 1, 2.0: 2, 3.0: 2}
    # The sum of positions decides: 0 + 2, 1 + 0, 2 + 1.
    group = rank_by_both(tmp_path / "c", {1.0: (0.1, 0.3), 2.0: (0.2, 0.1), 3.0: (0.3, 0.2)})
    assert list_ranks(group) == {2.0: 1, 1.0: 2, 3.0: 3}


def test_each_score_is_of_its_own_strongest_attack(tmp_path: Path) -> None:
    """An attack that identifies more than the one with the greatest SSIM counts, and a note names it."""
    other = identify(reconstructions(ldp(1.0), [0.2] * 6, attack=NEAREST), [0.9] * 6)
    scores = {1.0: (0.3, 0.2), 2.0: (0.31, 0.4)}
    assert list_ranks(rank_by_both(tmp_path / "a", scores)) == {1.0: 1, 2.0: 2}
    group = rank_by_both(tmp_path / "b", scores, other)
    assert list_ranks(group) == {2.0: 1, 1.0: 2}
    notes = {row.values["epsilon_descriptor"]: row.note for row in group_tables.build_ranking_table(group).rows}
    assert notes == {1.0: "ranked by 0.9 identified by nearest", 2.0: ""}


def test_an_attack_without_a_signal_identifies_nothing(tmp_path: Path) -> None:
    """Negative control: the reciprocal rank of one lucky photograph is no evidence."""
    other = identify(reconstructions(ldp(1.0), [0.002] * 6, attack=NEAREST), [1.0, *[1 / 200] * 5])
    group = rank_by_both(tmp_path, {1.0: (0.3, 0.1), 2.0: (0.31, 0.12)}, other)
    assert list_ranks(group) == {1.0: 1, 2.0: 2}


def test_without_an_adapted_attacker_a_defense_is_unranked_and_last(tmp_path: Path) -> None:
    reason = "no adapted attacker; `bench train` makes one"
    (group,) = build(
        tmp_path,
        [inapplicable(ldp(1.0), DIA, reason)],
        reconstructions(ldp(1.0), [0.01] * 6, attack=NEAREST),
        reconstructions({"name": "other"}, [0.02] * 6, attack=NEAREST),
        reconstructions(NONE, [0.9] * 6),
        baselines(NONE, 6),
    )
    assert [(one.rank, one.unranked_reason) for one in rank_defenses(group)] == [
        (1, None),
        (None, reason),
        (None, "no adapted attacker was run (dia)"),
    ]
    rows = group_tables.build_ranking_table(group).rows
    assert [row.values["rank"] for row in rows] == [1, None, None]
    assert f"unranked: {reason}" in rows[1].note


@pytest.mark.parametrize("attack", [DIA, NEAREST])
def test_an_incomplete_experiment_ranks_no_defense(tmp_path: Path, attack: dict[str, Any]) -> None:
    """A defense must not gain if an attack failed on the photographs that leak most."""
    failed = fabricated.record("1.png", {}, defense=ldp(8.0), attack=attack, status="failed", reason="too dark")
    (group,) = build(
        tmp_path,
        reconstructions(NONE, [0.5, 0.9] * 3),
        reconstructions(ldp(8.0), [0.1], attack=attack),
        [failed],
        reconstructions(ldp(8.0), [0.2, 0.3] * 3, attack={"name": "dia", "weights": "sha256:other"}),
        baselines(NONE, 6),
    )
    groups = by_defense(group)
    assert groups["none"].rank == 1
    standing = next(one for name, one in groups.items() if name.startswith("ldp"))
    assert standing.rank is None
    assert "has completed 1 of 6 samples" in str(standing.unranked_reason)
    notes = [row.note for row in group_tables.build_pairs_table(group).rows]
    assert any("1 failed: 1.png: too dark" in note for note in notes)


def test_a_photograph_that_fails_everywhere_is_ignored(tmp_path: Path) -> None:
    broken = [fabricated.record("bad.jpg", {}, defense=d, status="failed", reason="truncated") for d in (NONE, ldp(8.0))]
    (group,) = build(tmp_path, reconstructions(NONE, [0.5] * 6), reconstructions(ldp(8.0), [0.4] * 6), baselines(NONE, 6), broken)
    assert [one.rank for one in rank_defenses(group)] == [1, 2]


# ---- utility


def test_recall_has_wilsons_interval_by_day_and_by_night(tmp_path: Path) -> None:
    from scipy.stats import binomtest

    hits = [1, 1, 1, 0, 1, 0, 0]
    (group,) = build(tmp_path, localizations(NONE, hits, ["day"] * 4 + ["night"] * 3))
    assert group.conditions == ("day", "night")
    assert not group.has_attacks
    (row,) = group_tables.build_pairs_table(group).rows
    for condition, (successes, trials) in {"day": (3, 4), "night": (1, 3)}.items():
        value = row.values[f"recall_0.25m_2deg_{condition}"]
        expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
        assert (value.mean, value.low, value.high) == pytest.approx((successes / trials, expected.low, expected.high))  # type: ignore[union-attr]
    assert "7 queries" in group.facts


def test_older_records_without_a_condition_are_one_group(tmp_path: Path) -> None:
    records = localizations(NONE, [1, 0], [None, None])
    for record in records:
        del record["condition"]
    (group,) = build(tmp_path, records)
    assert group.conditions == (None,)
    assert "recall_0.25m_2deg" in group_tables.build_pairs_table(group).rows[0].values


def test_a_query_that_was_not_localized_counts_in_the_median(tmp_path: Path) -> None:
    (group,) = build(tmp_path, localizations(NONE, [1, 0, 0], ["day"] * 3), localizations(ldp(8.0), [1, 1, 0], ["day"] * 3))
    errors = {
        row.values["defense"]: row.values["translation_error_day"].mean for row in group_tables.build_pairs_table(group).rows
    }  # type: ignore[union-attr]
    assert errors == {"none": float("inf"), "ldp:epsilon=8,subset_size=2": 0.1}


def test_groups_with_attacks_come_first(tmp_path: Path) -> None:
    groups = build(tmp_path, localizations(NONE, [1], [None]), reconstructions(NONE, [0.5]))
    assert [group.has_attacks for group in groups] == [True, False]
    assert groups[1].metadata["dataset"]["name"] == GALLERY["name"]
