"""What may stand on one board, and how defenses are ranked there."""

from pathlib import Path
from typing import Any

import fabricated
import pytest
from fabricated import DIA, ENVIRONMENT, GALLERY, PHOTOGRAPHS, SETTINGS, inapplicable, ldp, localizations, reconstructions

from bench.core.errors import UserError
from leaderboard import comparison, group_tables
from leaderboard.comparison import ComparisonGroup
from leaderboard.measures import list_measures
from leaderboard.ranking import Standing, rank_defenses

NONE = {"name": "none"}
NEAREST = {"name": "nearest"}


def made(tmp_path: Path, *groups: list[dict[str, Any]]) -> list[ComparisonGroup]:
    return comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, [record for group in groups for record in group])))


def by_defense(board: ComparisonGroup) -> dict[str, Standing]:
    return {standing.defense: standing for standing in rank_defenses(board)}


# ---- what is told apart


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
def test_what_cannot_be_compared_has_a_board_of_its_own(tmp_path: Path, other: dict[str, Any]) -> None:
    found = made(tmp_path, reconstructions(NONE, [0.5]), reconstructions(NONE, [0.9], **other))
    assert len(found) == 2
    assert len({board.key for board in found}) == 2
    assert [len(board.experiments) for board in found] == [1, 1]


def test_the_name_of_a_dataset_tells_nothing(tmp_path: Path) -> None:
    renamed = PHOTOGRAPHS | {"name": "copy", "spec": None}
    (board,) = made(tmp_path, reconstructions(NONE, [0.5]), reconstructions(ldp(8.0), [0.4], dataset=renamed))
    assert len(board.experiments) == 2


def test_environments_stay_apart_on_one_board(tmp_path: Path) -> None:
    gpu = ENVIRONMENT | {"device": "cuda"}
    (board,) = made(tmp_path, reconstructions(NONE, [0.5]), reconstructions(NONE, [0.6], environment=gpu))
    assert [cell.attack for cell in board.experiments] == ["dia (device cpu)", "dia (device cuda)"]
    (standing,) = rank_defenses(board)  # the defense is one, and the stronger run counts
    assert standing.score is not None
    assert standing.score.mean == 0.6


def test_seeds_have_boards_of_their_own_and_one_of_their_mean(tmp_path: Path) -> None:
    averaged, first, second = made(
        tmp_path,
        reconstructions(NONE, [0.5, 0.7], seed=1),
        reconstructions(NONE, [0.3, 0.5], seed=2),
        reconstructions(ldp(8.0), [0.1, 0.1], seed=2),
    )
    assert [board.seeds for board in (averaged, first, second)] == [(1, 2), (1,), (2,)]
    assert [len(board.experiments) for board in (averaged, first, second)] == [1, 1, 2]  # ldp lacks a seed, and is not averaged
    (ssim,) = list_measures(["ssim"])
    assert averaged.list_values(averaged.experiments[0], "ssim") == [pytest.approx(0.4), pytest.approx(0.6)]
    interval = averaged.average(averaged.experiments[0], ssim)
    assert interval is not None
    assert interval.count == 2  # photographs, not photographs times seeds
    assert "mean over seeds 1, 2" in averaged.facts


def test_a_unit_that_one_seed_lacks_is_not_averaged(tmp_path: Path) -> None:
    other = reconstructions(ldp(8.0), [0.3, 0.5], seed=1), reconstructions(ldp(8.0), [0.3, 0.5], seed=2)
    averaged, *_ = made(tmp_path, reconstructions(NONE, [0.5, 0.9], seed=1), reconstructions(NONE, [0.3], seed=2), *other)
    assert averaged.list_values(averaged.experiments[0], "ssim") == [pytest.approx(0.4)]
    assert averaged.count_missing(averaged.experiments[0]) == 1
    assert by_defense(averaged)["none"].unranked_reason == "dia has done 1 of 2"


def test_records_of_many_folders_are_found_and_the_latest_counts(tmp_path: Path) -> None:
    fabricated.write(tmp_path / "b" / "deep", reconstructions(NONE, [0.8]))
    fabricated.write(tmp_path / "a", reconstructions(NONE, [0.1]))
    (found,) = comparison.load_records(tmp_path)
    assert found.record["metrics"]["ssim"] == 0.8
    assert found.folder == tmp_path / "b" / "deep"


def test_no_record_is_a_mistake(tmp_path: Path) -> None:
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
    (board,) = made(
        tmp_path,
        reconstructions(NONE, [0.8, 0.8]),
        reconstructions(affine, [0.2, 0.3]),
        reconstructions(affine, [0.6, 0.7], attack=NEAREST),
        reconstructions(ldp(8.0), [0.4, 0.5]),
    )
    ranked = rank_defenses(board)
    assert [(one.rank, one.defense) for one in ranked] == [(1, "ldp:epsilon=8,subset_size=2"), (2, "affine:dim=4"), (3, "none")]
    assert ranked[1].strongest is not None
    assert ranked[1].strongest.attack == "nearest"  # by dia alone affine would be first
    shown = group_tables.ranking(board).rows
    assert [row.values["attack"] for row in shown] == ["dia", "nearest", "dia"]


def test_equal_scores_share_a_rank(tmp_path: Path) -> None:
    (board,) = made(tmp_path, *(reconstructions(ldp(eps), [score]) for eps, score in ((1.0, 0.3), (2.0, 0.3), (3.0, 0.4))))
    assert [one.rank for one in rank_defenses(board)] == [1, 1, 3]


def test_without_an_adapted_attacker_a_defense_is_unranked_and_last(tmp_path: Path) -> None:
    reason = "no adapted attacker; `bench train` makes one"
    (board,) = made(
        tmp_path,
        [inapplicable(ldp(1.0), DIA, reason)],
        reconstructions(ldp(1.0), [0.01, 0.01], attack=NEAREST),
        reconstructions({"name": "other"}, [0.02, 0.02], attack=NEAREST),
        reconstructions(NONE, [0.9, 0.9]),
    )
    assert [(one.rank, one.unranked_reason) for one in rank_defenses(board)] == [
        (1, None),
        (None, reason),
        (None, "no adapted attacker was run (dia)"),
    ]
    rows = group_tables.ranking(board).rows
    assert [row.values["rank"] for row in rows] == [1, None, None]
    assert f"unranked: {reason}" in rows[1].note


@pytest.mark.parametrize("attack", [DIA, NEAREST])
def test_the_mean_of_what_was_left_over_ranks_nobody(tmp_path: Path, attack: dict[str, Any]) -> None:
    """A defense on which an attack failed at the photographs that leak most must not gain by it."""
    failed = fabricated.record("1.png", {}, defense=ldp(8.0), attack=attack, status="failed", reason="too dark")
    (board,) = made(
        tmp_path,
        reconstructions(NONE, [0.5, 0.9]),
        reconstructions(ldp(8.0), [0.1], attack=attack),
        [failed],
        reconstructions(ldp(8.0), [0.2, 0.3], attack={"name": "dia", "weights": "sha256:other"}),
    )
    found = by_defense(board)
    assert found["none"].rank == 1
    standing = next(one for name, one in found.items() if name.startswith("ldp"))
    assert standing.rank is None
    assert "has done 1 of 2" in str(standing.unranked_reason)
    notes = [row.note for row in group_tables.pairs(board).rows]
    assert any("1 failed: 1.png: too dark" in note for note in notes)


def test_a_photograph_that_nobody_could_do_holds_against_nobody(tmp_path: Path) -> None:
    broken = [fabricated.record("bad.jpg", {}, defense=d, status="failed", reason="truncated") for d in (NONE, ldp(8.0))]
    (board,) = made(tmp_path, reconstructions(NONE, [0.5]), reconstructions(ldp(8.0), [0.4]), broken)
    assert [one.rank for one in rank_defenses(board)] == [1, 2]


# ---- what a server can do


def test_recall_is_told_by_day_and_by_night_with_wilsons_interval(tmp_path: Path) -> None:
    from scipy.stats import binomtest

    hits = [1, 1, 1, 0, 1, 0, 0]
    (board,) = made(tmp_path, localizations(NONE, hits, ["day"] * 4 + ["night"] * 3))
    assert board.conditions == ("day", "night")
    assert not board.has_attacks
    (row,) = group_tables.pairs(board).rows
    for condition, (successes, trials) in {"day": (3, 4), "night": (1, 3)}.items():
        value = row.values[f"recall_0.25m_2deg_{condition}"]
        expected = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
        assert (value.mean, value.low, value.high) == pytest.approx((successes / trials, expected.low, expected.high))  # type: ignore[union-attr]
    assert "7 queries" in board.facts


def test_older_records_without_a_condition_are_one_group(tmp_path: Path) -> None:
    records = localizations(NONE, [1, 0], [None, None])
    for record in records:
        del record["condition"]
    (board,) = made(tmp_path, records)
    assert board.conditions == (None,)
    assert "recall_0.25m_2deg" in group_tables.pairs(board).rows[0].values


def test_a_query_that_was_not_localized_counts_in_the_median(tmp_path: Path) -> None:
    (board,) = made(tmp_path, localizations(NONE, [1, 0, 0], ["day"] * 3), localizations(ldp(8.0), [1, 1, 0], ["day"] * 3))
    errors = {row.values["defense"]: row.values["translation_error_day"].mean for row in group_tables.pairs(board).rows}  # type: ignore[union-attr]
    assert errors == {"none": float("inf"), "ldp:epsilon=8,subset_size=2": 0.1}


def test_boards_of_attacks_come_first(tmp_path: Path) -> None:
    found = made(tmp_path, localizations(NONE, [1], [None]), reconstructions(NONE, [0.5]))
    assert [board.has_attacks for board in found] == [True, False]
    assert found[1].metadata["dataset"]["name"] == GALLERY["name"]
