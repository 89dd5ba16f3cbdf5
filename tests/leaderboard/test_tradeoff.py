"""The privacy–utility plot: the join of two groups, the Pareto front, and the drawing."""

from pathlib import Path
from typing import Any

import fabricated
import numpy as np
import pytest
from fabricated import (
    DIA,
    ENVIRONMENT,
    GALLERY,
    PHOTOGRAPHS,
    baselines,
    inapplicable,
    ldp,
    localizations,
    reconstructions,
    record,
)

from leaderboard import comparison, plots
from leaderboard.comparison import ComparisonGroup
from leaderboard.plot_style import STYLES, choose_styles, position_labels
from leaderboard.site.chart import build_charts
from leaderboard.tradeoff import Tradeoff, build_tradeoffs, pareto

NONE = {"name": "none"}
DAYS = ["day", "day", "night", "night"]


def build(tmp_path: Path, *parts: list[dict[str, Any]]) -> list[Tradeoff]:
    records = [record for part in parts for record in part]
    groups = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    attacked: ComparisonGroup = next(group for group in groups if group.has_attacks)
    return build_tradeoffs(attacked, groups)


def dominated(cost: np.ndarray, gain: np.ndarray) -> list[bool]:
    """Return whether each point is dominated, by comparison of all pairs."""
    pairs = list(zip(cost, gain, strict=True))
    return [any((c <= a and g >= b) and (c, g) != (a, b) for c, g in pairs) for a, b in pairs]


@pytest.mark.parametrize("seed", range(5))
def test_the_front_has_no_dominated_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost, gain = rng.integers(0, 8, (2, 40)) / 8  # with ties
    assert list(pareto(cost, gain)) == [not one for one in dominated(cost, gain)]
    assert list(pareto([], [])) == []
    assert list(pareto([1, 1], [2, 2])) == [True, True]  # equal ones do not dominate each other


def test_points_join_the_two_groups_under_each_condition(tmp_path: Path) -> None:
    day, night = build(
        tmp_path,
        reconstructions(NONE, [0.8] * 8),
        reconstructions(ldp(8.0), [0.3] * 8),
        reconstructions(ldp(8.0), [0.5] * 8, attack={"name": "nearest"}),
        reconstructions(ldp(1.0), [0.2] * 8),  # has no recall
        baselines(NONE, 8, 0.1),
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
    assert all(point.on_front for point in day.points)
    assert day.baselines == {"blank": pytest.approx(0.1), "keypoints": pytest.approx(0.1)}


def test_the_same_photographs_come_before_others(tmp_path: Path) -> None:
    (one,) = build(
        tmp_path,
        reconstructions(NONE, [0.8]),
        localizations(NONE, [0], [None]),
        localizations(NONE, [1], [None], dataset=PHOTOGRAPHS | {"name": "again"}),
    )
    assert one.points[0].utility.mean == 1.0
    assert one.caption == "SSIM and recall (0.25 m, 2°) on photos"


def test_on_another_dataset_the_dictionary_may_differ(tmp_path: Path) -> None:
    own = ldp(8.0) | {"dictionary": "sha256:" + "9" * 64}
    (one,) = build(tmp_path, reconstructions(ldp(8.0), [0.3]), localizations(own, [1], [None]))
    assert one.caption.endswith("; each with its own dictionary")
    other = own | {"dictionary": "sha256:" + "8" * 64}
    assert not build(
        tmp_path / "two", reconstructions(ldp(8.0), [0.3]), localizations(own, [1], [None]), localizations(other, [0], [None])
    )
    same = PHOTOGRAPHS | {"name": "again"}
    assert not build(tmp_path / "same", reconstructions(ldp(8.0), [0.3]), localizations(own, [1], [None], dataset=same))


@pytest.mark.slow
def test_each_setting_of_the_server_has_a_plot(tmp_path: Path) -> None:
    raw, released = ({"task_settings": {"retrieval": how}} for how in ("raw", "released"))
    records = reconstructions(NONE, [0.8]), localizations(NONE, [1], [None], **raw), localizations(NONE, [0], [None], **released)
    tradeoffs = build(tmp_path, *records)
    assert {one.caption: one.points[0].utility.mean for one in tradeoffs} == {
        "SSIM on photos, recall (0.25 m, 2°) on gallery (retrieval raw)": 1.0,
        "SSIM on photos, recall (0.25 m, 2°) on gallery (retrieval released)": 0.0,
    }
    names = [name for name, _ in plots.draw_plots(tradeoffs[0].attack_group, tradeoffs)]
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
def test_groups_that_cannot_be_compared_have_no_tradeoff(tmp_path: Path, other: dict[str, Any]) -> None:
    assert not build(tmp_path, reconstructions(NONE, [0.8]), localizations(NONE, [1], [None], **other))


def test_matching_replaces_missing_localization(tmp_path: Path) -> None:
    pair = record("a-b", {"recall": 0.7, "precision": 0.9}, defense=NONE, task="matching", attack=None, dataset=GALLERY)
    (one,) = build(tmp_path / "m", reconstructions(NONE, [0.8]), [pair])
    assert one.utility.label == "recall"
    (one,) = build(tmp_path / "l", reconstructions(NONE, [0.8]), [pair], localizations(NONE, [1], [None]))
    assert one.utility.label == "recall (0.25 m, 2°)"


def test_an_unranked_defense_is_shown_but_not_on_the_front(tmp_path: Path) -> None:
    (one,) = build(
        tmp_path,
        [inapplicable(ldp(1.0), DIA, "no adapted attacker")],
        reconstructions(ldp(1.0), [0.01] * 6, attack={"name": "nearest"}),
        reconstructions(NONE, [0.8] * 6),
        baselines(NONE, 6),
        localizations(ldp(1.0), [1, 1], [None, None]),
        localizations(NONE, [1, 0], [None, None]),
    )
    assert {(p.standing.defense.partition(":")[0], p.on_front) for p in one.points} == {("ldp", False), ("none", True)}


# ---- drawing


def test_families_differ_without_colour() -> None:
    assert (
        len({style.marker for style in STYLES})
        == len({style.path for style in STYLES})
        == len({str(style.line) for style in STYLES})
        == len(STYLES)
    )
    assert list(choose_styles(["b", "a", "b"])) == ["b", "a"]


def test_labels_cover_no_point_label_or_border() -> None:
    rng = np.random.default_rng(0)
    points = [(float(x), float(y)) for x, y in rng.uniform(0, 300, (12, 2))]
    sizes = [(60.0, 12.0)] * len(points)
    positions = position_labels(points, sizes, (300.0, 300.0))
    boxes = [(x, y - 6, x + 60, y + 6) for position in positions if position for x, y in [position]]
    assert len(boxes) > 6
    for number, (left, top, right, bottom) in enumerate(boxes):
        assert left >= 0
        assert top >= 0
        assert right <= 300
        assert bottom <= 300
        assert not any(left < x < right and top < y < bottom for x, y in points)
        for a, b, c, d in boxes[number + 1 :]:
            assert right <= a or c <= left or bottom <= b or d <= top
    assert position_labels([(5.0, 5.0)], [(400.0, 12.0)], (300.0, 300.0)) == [None]


def test_labels_are_nearest_to_their_own_points() -> None:
    """This includes points that are close together, some of which then have no label."""
    points = [(150.0, 150.0), (150.0, 157.0), (150.0, 164.0), (40.0, 40.0)]
    positions = position_labels(points, [(60.0, 12.0)] * 4, (300.0, 300.0))
    assert positions[3] is not None
    for number, position in enumerate(positions):
        if position:
            left, middle = position
            distances = [np.hypot(max(left - x, 0, x - left - 60), max(abs(y - middle) - 6, 0)) for x, y in points]
            assert np.argmin(distances) == number


@pytest.mark.slow
def test_identification_has_plots_of_its_own(tmp_path: Path) -> None:
    """At `ldp` no attack has more SSIM than the baselines, but `nearest` identifies the photographs."""

    def reconstruct(defense: dict[str, Any], attack: str, ssim: float, identified: float) -> list[dict[str, Any]]:
        return [
            record(f"{number}.png", {"ssim": ssim, "identified": identified}, defense=defense, attack={"name": attack})
            for number in range(8)
        ]

    records = [
        *(one for attack in ("blank", "keypoints") for one in reconstruct(NONE, attack, 0.2, 1 / 128)),
        *reconstruct(NONE, "dia", 0.8, 1.0),
        *reconstruct(ldp(8.0), "dia", 0.3, 1 / 8),
        *reconstruct(ldp(8.0), "nearest", 0.2, 1.0),
        *localizations(NONE, [1, 1], [None, None]),
        *localizations(ldp(8.0), [1, 0], [None, None]),
    ]
    similarity, identification = build(tmp_path, records)
    scores = {point.standing.configuration["name"]: point for point in identification.points}
    assert (scores["ldp"].privacy.mean, scores["ldp"].attack_experiment.attack) == (1.0, "nearest")
    assert {point.attack_experiment.attack for point in similarity.points} == {"dia"}
    assert identification.baselines == {"blank": pytest.approx(1 / 128), "keypoints": pytest.approx(1 / 128)}
    assert [chart.up for chart in build_charts([similarity])] != [chart.up for chart in build_charts([identification])]
    names = [name for name, _ in plots.draw_plots(similarity.attack_group, [similarity, identification])]
    assert names == ["attacks", "attacks-identified", "tradeoff", "tradeoff-identified"]


@pytest.mark.slow
def test_plots_are_drawn_of_the_available_records(tmp_path: Path) -> None:
    records = [
        *reconstructions(NONE, [0.8, 0.7] * 3),
        *reconstructions(ldp(8.0), [0.5, 0.4] * 3),
        *reconstructions(ldp(2.0), [0.3, 0.2] * 3),
        *reconstructions(ldp(1.0), [0.1, 0.1] * 3),
        *baselines(NONE, 6, 0.1),
        *localizations(ldp(1.0), [0, 0], [None, None]),
        *localizations(NONE, [1, 1], [None, None]),
        *localizations(ldp(8.0), [1, 0], [None, None]),
    ]
    groups = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    figures = dict(plots.draw_plots(groups[0], build_tradeoffs(groups[0], groups)))
    assert list(figures) == ["attacks", "epsilon", "tradeoff"]
    (axes,) = figures["tradeoff"].axes
    assert {text.get_text() for text in axes.texts} == {"none", "ldp ε 8", "ldp ε 1"}
    for plot, axis in (("tradeoff", 1), ("epsilon", 1), ("attacks", 0)):
        (drawn,) = figures[plot].axes
        lines = {str(line.get_label()): line for line in drawn.lines}
        for name in ("blank", "keypoints"):
            data = (lines[f"baseline {name}"].get_xdata(), lines[f"baseline {name}"].get_ydata())[axis]
            np.testing.assert_allclose(data, 0.1)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert "ldp, no signal" in labels
    markers = {str(drawn.get_label()): drawn.lines[0] for drawn in axes.containers}
    assert markers["ldp, no signal"].get_markerfacecolor() == "white"
    assert markers["ldp"].get_markerfacecolor() != "white"
    (curve,) = figures["epsilon"].axes
    (hollow,) = (line for line in curve.lines if line.get_markerfacecolor() == "white" and len(line.get_xdata()))
    np.testing.assert_allclose(hollow.get_xydata(), [[1.0, 0.1]])
    front = next(line for line in axes.lines if line.get_label() == "Pareto front")
    np.testing.assert_allclose(front.get_xydata(), [[0.5, 0.45], [1.0, 0.75]])
    assert [tick.get_text()[:8] for tick in figures["attacks"].axes[0].get_yticklabels()] == [
        "1  ldp:e",
        "2  ldp:e",
        "3  none",
        "unranked",
    ]


def test_points_of_the_pages_plot_are_at_their_values(tmp_path: Path) -> None:
    tradeoffs = build(
        tmp_path,
        reconstructions(NONE, [0.8, 0.6]),
        reconstructions(ldp(8.0), [0.5, 0.3]),
        localizations(NONE, [1, 1, 1, 0], DAYS),
        localizations(ldp(8.0), [1, 0, 0, 0], DAYS),
    )
    day, night = build_charts(tradeoffs)
    for chart in (day, night):
        left, top, right, bottom = chart.box
        undefended, defended = sorted(chart.spots, key=lambda spot: spot.y)
        assert undefended.point.standing.defense == "none"  # more is seen of it, so it is further up,
        assert undefended.x > defended.x  # and to the right
        for spot in chart.spots:
            assert all(left <= x <= right for x1, _, x2, _ in spot.bars for x in (x1, x2))
            assert all(top <= y <= bottom for _, y1, _, y2 in spot.bars for y in (y1, y2))
    assert day.across == night.across  # one scale
    at = {float(tick.text): tick.position for tick in day.across}
    spot = next(spot for spot in day.spots if spot.point.utility.mean == 1.0)
    assert spot.x == pytest.approx(at[1.0], abs=0.1)
