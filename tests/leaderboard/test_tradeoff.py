"""The privacy–utility plot: what is joined, what is on the Pareto front, and how it is drawn."""

from pathlib import Path
from typing import Any

import fabricated
import numpy as np
import pytest
from fabricated import DIA, ENVIRONMENT, GALLERY, PHOTOGRAPHS, inapplicable, ldp, localizations, reconstructions, record

from leaderboard import comparison, plots
from leaderboard.comparison import ComparisonGroup
from leaderboard.plot_style import STYLES, choose_styles, place_labels
from leaderboard.site.chart import build_charts
from leaderboard.tradeoff import Tradeoff, build_tradeoffs, pareto

NONE = {"name": "none"}
DAYS = ["day", "day", "night", "night"]


def joined(tmp_path: Path, *groups: list[dict[str, Any]]) -> list[Tradeoff]:
    found = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, [record for group in groups for record in group])))
    attacked: ComparisonGroup = next(board for board in found if board.attacked)
    return build_tradeoffs(attacked, found)


def dominated(cost: np.ndarray, gain: np.ndarray) -> list[bool]:
    """Looked up pair by pair."""
    pairs = list(zip(cost, gain, strict=True))
    return [any((c <= a and g >= b) and (c, g) != (a, b) for c, g in pairs) for a, b in pairs]


@pytest.mark.parametrize("seed", range(5))
def test_the_front_is_what_nothing_dominates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost, gain = rng.integers(0, 8, (2, 40)) / 8  # with ties
    assert list(pareto(cost, gain)) == [not one for one in dominated(cost, gain)]
    assert list(pareto([], [])) == []
    assert list(pareto([1, 1], [2, 2])) == [True, True]  # equal ones do not dominate each other


def test_points_join_the_two_boards_under_each_condition(tmp_path: Path) -> None:
    day, night = joined(
        tmp_path,
        reconstructions(NONE, [0.8, 0.8]),
        reconstructions(ldp(8.0), [0.3, 0.3]),
        reconstructions(ldp(8.0), [0.5, 0.5], attack={"name": "nearest"}),
        reconstructions(ldp(1.0), [0.2, 0.2]),  # has no recall
        localizations(NONE, [1, 1, 1, 0], DAYS),
        localizations(ldp(8.0), [1, 0, 0, 0], DAYS),
    )
    assert [one.condition for one in (day, night)] == ["day", "night"]
    assert {(p.standing.defense, p.utility.mean, p.privacy.mean) for p in day.points} == {
        ("none", 1.0, 0.8),
        ("ldp:epsilon=8,subset_size=2", 0.5, 0.5),  # of the strongest attack
    }
    assert {p.utility.mean for p in night.points} == {0.5, 0.0}
    assert day.caption == "Day: SSIM on photos, recall (0.25 m, 2°) on gallery"
    assert all(point.best for point in day.points)


def test_the_same_photographs_come_before_others(tmp_path: Path) -> None:
    (one,) = joined(
        tmp_path,
        reconstructions(NONE, [0.8]),
        localizations(NONE, [0], [None]),
        localizations(NONE, [1], [None], dataset=PHOTOGRAPHS | {"name": "again"}),
    )
    assert one.points[0].utility.mean == 1.0
    assert one.caption == "SSIM and recall (0.25 m, 2°) on photos"


def test_on_other_data_the_words_may_be_that_places_own(tmp_path: Path) -> None:
    own = ldp(8.0) | {"dictionary": "sha256:" + "9" * 64}
    (one,) = joined(tmp_path, reconstructions(ldp(8.0), [0.3]), localizations(own, [1], [None]))
    assert one.caption.endswith("words of a dictionary are those of each")
    other = own | {"dictionary": "sha256:" + "8" * 64}
    assert not joined(
        tmp_path / "two", reconstructions(ldp(8.0), [0.3]), localizations(own, [1], [None]), localizations(other, [0], [None])
    )
    same = PHOTOGRAPHS | {"name": "again"}
    assert not joined(tmp_path / "same", reconstructions(ldp(8.0), [0.3]), localizations(own, [1], [None], dataset=same))


def test_a_server_that_works_otherwise_has_a_plot_of_its_own(tmp_path: Path) -> None:
    raw, released = ({"task_settings": {"retrieval": how}} for how in ("raw", "released"))
    records = reconstructions(NONE, [0.8]), localizations(NONE, [1], [None], **raw), localizations(NONE, [0], [None], **released)
    found = joined(tmp_path, *records)
    assert {one.caption: one.points[0].utility.mean for one in found} == {
        "SSIM on photos, recall (0.25 m, 2°) on gallery (retrieval raw)": 1.0,
        "SSIM on photos, recall (0.25 m, 2°) on gallery (retrieval released)": 0.0,
    }
    names = [name for name, _ in plots.draw_plots(found[0].attacked, found)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    "other",
    [
        {"dataset": GALLERY | {"extractor": {"name": "sift", "upright": False}}},
        {"seed": 1},
        {"environment": ENVIRONMENT | {"source": "sha256:" + "6" * 64}},
    ],
    ids=["extractor", "seed", "source"],
)
def test_what_cannot_be_compared_is_not_joined(tmp_path: Path, other: dict[str, Any]) -> None:
    assert not joined(tmp_path, reconstructions(NONE, [0.8]), localizations(NONE, [1], [None], **other))


def test_matching_stands_in_where_there_is_no_localization(tmp_path: Path) -> None:
    pair = record("a-b", {"accuracy_3px": 0.7, "precision": 0.9}, defense=NONE, task="matching", attack=None, dataset=GALLERY)
    (one,) = joined(tmp_path / "m", reconstructions(NONE, [0.8]), [pair])
    assert one.utility.label == "accuracy (3 px)"
    (one,) = joined(tmp_path / "l", reconstructions(NONE, [0.8]), [pair], localizations(NONE, [1], [None]))
    assert one.utility.label == "recall (0.25 m, 2°)"


def test_an_unranked_defense_is_shown_and_is_on_no_front(tmp_path: Path) -> None:
    (one,) = joined(
        tmp_path,
        [inapplicable(ldp(1.0), DIA, "no adapted attacker")],
        reconstructions(ldp(1.0), [0.01, 0.01], attack={"name": "nearest"}),
        reconstructions(NONE, [0.8, 0.8]),
        localizations(ldp(1.0), [1, 1], [None, None]),
        localizations(NONE, [1, 0], [None, None]),
    )
    assert {(p.standing.defense.partition(":")[0], p.best) for p in one.points} == {("ldp", False), ("none", True)}


# ---- drawing


def test_families_differ_without_colour() -> None:
    assert (
        len({mark.marker for mark in STYLES})
        == len({mark.path for mark in STYLES})
        == len({str(mark.line) for mark in STYLES})
        == len(STYLES)
    )
    assert list(choose_styles(["b", "a", "b"])) == ["b", "a"]


def test_labels_cover_nothing() -> None:
    rng = np.random.default_rng(0)
    points = [(float(x), float(y)) for x, y in rng.uniform(0, 300, (12, 2))]
    sizes = [(60.0, 12.0)] * len(points)
    placed = place_labels(points, sizes, (300.0, 300.0))
    boxes = [(x, y - 6, x + 60, y + 6) for place in placed if place for x, y in [place]]
    assert len(boxes) > 6
    for number, (left, top, right, bottom) in enumerate(boxes):
        assert left >= 0
        assert top >= 0
        assert right <= 300
        assert bottom <= 300
        assert not any(left < x < right and top < y < bottom for x, y in points)
        for a, b, c, d in boxes[number + 1 :]:
            assert right <= a or c <= left or bottom <= b or d <= top
    assert place_labels([(5.0, 5.0)], [(400.0, 12.0)], (300.0, 300.0)) == [None]


def test_labels_are_read_as_their_points() -> None:
    """Also where points lie together: some of them have none then."""
    points = [(150.0, 150.0), (150.0, 157.0), (150.0, 164.0), (40.0, 40.0)]
    placed = place_labels(points, [(60.0, 12.0)] * 4, (300.0, 300.0))
    assert placed[3] is not None
    for number, place in enumerate(placed):
        if place:
            away = [np.hypot(max(place[0] - x, 0, x - place[0] - 60), max(abs(y - place[1]) - 6, 0)) for x, y in points]
            assert np.argmin(away) == number


def test_plots_are_drawn_of_what_there_is(tmp_path: Path) -> None:
    records = [
        *reconstructions(NONE, [0.8, 0.7]),
        *reconstructions(ldp(8.0), [0.5, 0.4]),
        *reconstructions(ldp(2.0), [0.3, 0.2]),
        *localizations(NONE, [1, 1], [None, None]),
        *localizations(ldp(8.0), [1, 0], [None, None]),
    ]
    found = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    drawn = dict(plots.draw_plots(found[0], build_tradeoffs(found[0], found)))
    assert list(drawn) == ["attacks", "epsilon", "tradeoff"]
    (axes,) = drawn["tradeoff"].axes
    assert {text.get_text() for text in axes.texts} == {"none", "ldp"}
    front = next(line for line in axes.lines if line.get_label() == "Pareto front")
    np.testing.assert_allclose(front.get_xydata(), [[0.5, 0.45], [1.0, 0.75]])
    assert [tick.get_text()[:8] for tick in drawn["attacks"].axes[0].get_yticklabels()] == ["1  ldp:e", "2  ldp:e", "3  none"]


def test_the_pages_plot_lies_where_the_numbers_say(tmp_path: Path) -> None:
    found = joined(
        tmp_path,
        reconstructions(NONE, [0.8, 0.6]),
        reconstructions(ldp(8.0), [0.5, 0.3]),
        localizations(NONE, [1, 1, 1, 0], DAYS),
        localizations(ldp(8.0), [1, 0, 0, 0], DAYS),
    )
    day, night = build_charts(found)
    for chart in (day, night):
        left, top, right, bottom = chart.box
        undefended, defended = sorted(chart.spots, key=lambda spot: spot.y)
        assert undefended.point.standing.defense == "none"  # more is seen of it, so it is further up,
        assert undefended.x > defended.x  # and to the right
        for spot in chart.spots:
            assert all(left <= x <= right for x1, _, x2, _ in spot.bars for x in (x1, x2))
            assert all(top <= y <= bottom for _, y1, _, y2 in spot.bars for y in (y1, y2))
    assert day.across == night.across  # one scale
    at = {float(tick.text): tick.at for tick in day.across}
    spot = next(spot for spot in day.spots if spot.point.utility.mean == 1.0)
    assert spot.x == pytest.approx(at[1.0], abs=0.1)
