"""Tables and figures of records."""

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image
from record_lines import record
from rich.console import Console
from scipy import stats

from bench.core.errors import UserError
from bench.core.table import Table, to_csv, to_markdown, to_terminal
from leaderboard import figures, tables
from leaderboard.chance import RECIPROCAL_RANK
from leaderboard.identification import measure_bits
from leaderboard.reproduce import drawing

SIFT = {"name": "sift", "upright": True}


def show(table: Table, row: int) -> dict[str, str]:
    """Return the texts of a row by the labels of their columns."""
    return dict(zip((column.label for column in table.columns), table.rows[row].texts, strict=True))


def show_markdown(table: Table) -> str:
    return to_markdown(table, plain=True)


NA = record("*", run_hash="n", attack={"name": "nearest"}, status="n/a", reason="nearest attacks Subspaces", metrics={})


def test_metrics_are_averaged_over_photographs() -> None:
    metrics = {"mae": 0.3, "psnr": None, "ssim": 0.7, "keypoints": 300}
    other = record("b", metrics=metrics, privacy=record()["privacy"] | {"epsilon_image": 3000.0})
    (table,) = tables.build_tables([record(), other])
    row = table.rows[0].values
    assert row["photographs"] == 2
    assert row["mae"] == pytest.approx(0.2)
    assert row["psnr"] == 20.0  # of the photographs that have one
    assert row["epsilon_image"] == 2000.0
    assert list(show(table, 0))[3:7] == ["keypoints", "MAE", "SSIM", "PSNR"]
    assert "angle" not in row  # no record has one


def test_a_metric_of_an_extra_states_the_photographs_that_have_a_value() -> None:
    """They are those with a face. Without them, the mean would look like that of all photographs."""
    values = [{"ssim": 0.5, "identity": value} for value in (1.0, 0.0, None)]
    (table,) = tables.build_tables([record(sample=str(number), metrics=each) for number, each in enumerate(values)])
    remark = "identity: over the 2 of 3 photographs that have a value."
    assert remark in table.remarks
    (table,) = tables.build_tables([record(sample=str(number), metrics=each) for number, each in enumerate(values[:2])])
    assert not any("that have a value" in other for other in table.remarks)


def test_the_remark_on_identity_states_the_number_of_faces() -> None:
    """Each photograph counts once, however many attacks were run on it."""
    faces = "identity: faces in the photograph:"
    notes = [[f"{faces} 2"], [f"{faces} 3", "reads: words in the photograph: 9"], [f"{faces} 0"]]
    values = [{"ssim": 0.5, "identity": value} for value in (1.0, 0.5, None)]
    records = [record(str(number), metrics=each, notes=notes[number]) for number, each in enumerate(values)]
    other = [one | {"run_hash": f"other {one['sample']}", "attack": {"name": "blank"}} for one in records]
    (table,) = tables.build_tables([*records, *other])
    assert "identity: over the 2 of 3 photographs that have a value, with 5 faces." in table.remarks


def localized(sample: str, recall: float, error: float | None) -> dict[str, Any]:
    metrics = {"recall_0.25m_2deg": recall, "translation_error": error}
    return record(sample, task="localization", attack=None, metrics=metrics)


def test_a_query_that_was_not_localized_is_the_worst_of_the_median() -> None:
    """Negative control: the average over the localized queries alone would be 0.2."""
    queries = [localized("a", 1.0, 0.1), localized("b", 1.0, 0.3), localized("c", 0.0, None), localized("d", 0.0, None)]
    (half,) = tables.build_tables(queries)
    (most,) = tables.build_tables([*queries, localized("e", 1.0, 0.2)])
    assert half.rows[0].values["translation_error"] == math.inf
    assert most.rows[0].values["translation_error"] == pytest.approx(0.3)
    assert "| median translation_error |" in show_markdown(half)
    assert "| ∞ |" in show_markdown(half)


def test_fractions_have_wilsons_interval() -> None:
    (table,) = tables.build_tables(
        [localized(str(number), float(number < 7), 0.1) for number in range(10)] + [NA | {"task": "localization"}]
    )
    expected = stats.binomtest(7, 10).proportion_ci(0.95, "wilson")
    row = table.rows[0].values
    recall = row["recall_0.25m_2deg"]
    assert (recall.low, recall.high) == pytest.approx((expected.low, expected.high))
    assert [show(table, index)["recall_0.25m_2deg"] for index in range(2)] == [
        f"0.7 [{expected.low:.4g}, {expected.high:.4g}]",
        "n/a",
    ]


def test_identification_has_rank_1_and_bits_beside_ssim() -> None:
    values = [1.0] * 7 + [0.5, 1 / 30, 1 / 128.5]
    records = [
        record(str(number), metrics={"ssim": 0.5, "psnr": 9.0, "identified": value}) for number, value in enumerate(values)
    ]
    (table,) = tables.build_tables([*records, NA])
    labels = [column.label for column in table.columns]
    first = labels.index("SSIM")
    assert labels[first + 1 : first + 5] == [
        "identified (chance 0.024)",
        "identified, rank 1 (chance 0.0039)",
        "identified, bits of 8 (chance 0)",
        "PSNR",
    ]
    wilson, bits = stats.binomtest(7, 10).proportion_ci(0.95, "wilson"), measure_bits(values)
    mean = (7 + 0.5 + 1 / 30 + RECIPROCAL_RANK) / 10
    assert table.rows[0].texts[first + 1 : first + 4] == (
        f"{mean:.4g}",
        f"0.7 [{wilson.low:.4g}, {wilson.high:.4g}] (7 of 10)",
        f"{bits.mean:.4g} [{bits.low:.4g}, {bits.high:.4g}]",
    )
    assert table.rows[1].texts[first + 1 : first + 4] == ("n/a",) * 3
    (brief,) = tables.build_tables([*records, NA], brief=True)
    shown = [show(brief, index)["identified (chance 0.024)"] for index in range(2)]
    assert shown == [f"{mean:.2f}, 7 of 10\n{bits.mean:.1f} bits [{bits.low:.1f}, {bits.high:.1f}]", "n/a"]


def test_an_impossible_reciprocal_rank_is_an_error() -> None:
    with pytest.raises(UserError, match="reciprocal rank 2"):
        tables.build_tables([record(metrics={"identified": 2.0})])


def test_the_smaller_of_two_compositions_is_shown() -> None:
    optimal = record("b", privacy=record()["privacy"] | {"epsilon_image": 3000.0, "epsilon_image_optimal": 2500.0})
    (table,) = tables.build_tables([optimal])
    assert table.rows[0].values["epsilon_image"] == 2500.0
    shown = show_markdown(table)
    assert "2500" in shown
    assert "δ = 1e-06" in shown
    assert "Not covered: the keypoints' positions, the number of keypoints." in shown


def test_further_uncovered_parts_are_noted() -> None:
    linked = record()["privacy"] | {"uncovered": ["the keypoints' positions", "which keypoints share a word"]}
    (table,) = tables.build_tables([record(privacy=linked)])
    assert table.rows[0].values["note"] == "also not covered: which keypoints share a word"
    assert tables.build_tables([record()])[0].rows[0].values["note"] == ""


def test_a_terminal_shows_how_many_keypoints_there_are() -> None:
    (table,) = tables.build_tables([record()], brief=True)
    assert "keypoints" in show(table, 0)


def test_heading_states_task_dataset_features_and_seed() -> None:
    (table,) = tables.build_tables([record()])
    assert table.heading == "Reconstruction on photos (1 photograph), sift upright features, seed 0"
    oriented = record(run_hash="o", dataset={"name": "photos", "extractor": {"name": "sift", "upright": False}})
    assert [table.heading.count("oriented") for table in tables.build_tables([record(), oriented])] == [0, 1]
    assert "not private" in show_markdown(table)


def test_values_that_do_not_apply_are_neither_blank_nor_zero() -> None:
    (table,) = tables.build_tables([record(), NA])
    texts = show(table, 1)
    assert [texts[label] for label in ("n", "MAE", "SSIM", "PSNR")] == ["n/a"] * 4
    assert texts["note"] == "nearest attacks Subspaces"
    first, second = csv.DictReader(io.StringIO(to_csv(table)))
    assert (second["ssim"], second["photographs"]) == ("n/a", "n/a")
    assert first["ssim"] == "0.5"


def test_failures_are_counted_and_listed() -> None:
    failed = record("b", status="failed", reason="b.jpg: truncated", metrics={})
    (table,) = tables.build_tables([record(), failed])
    assert (table.rows[0].values["photographs"], table.rows[0].values["failed"]) == (1, 1)
    assert "failed: b, ldp:epsilon=10, dia: b.jpg: truncated" in show_markdown(table)
    (all_failed,) = tables.build_tables([failed])
    assert all_failed.rows[0].values["note"] == "every sample failed"


def test_later_record_of_a_sample_replaces_the_earlier() -> None:
    failed = record(status="failed", reason="x", metrics={})
    (table,) = tables.build_tables([failed, record()])
    assert (table.rows[0].values["photographs"], table.rows[0].values["failed"]) == (1, 0)


def test_labels_show_digests_only_where_they_would_be_equal() -> None:
    one, other = record(), record(defense=record()["defense"] | {"dictionary": "sha256:fedcba9876"}, run_hash="o")
    (table,) = tables.build_tables([one, other])
    assert [row.values["defense"] for row in table.rows] == [
        "ldp:epsilon=10,dictionary=01234567",
        "ldp:epsilon=10,dictionary=fedcba98",
    ]
    (table,) = tables.build_tables([one, NA])
    assert [row.values["defense"] for row in table.rows] == ["ldp:epsilon=10"] * 2


@pytest.mark.parametrize(("log10", "shown"), [(-0.8332, "0.1468"), (0.0, "1"), (-612.25, "10^-612.2"), (None, "n/a")])
def test_chances_too_small_for_a_float_are_shown(log10: float | None, shown: str) -> None:
    (table,) = tables.build_tables([record(privacy=record()["privacy"] | {"log10_true": log10})])
    assert show(table, 0)["Pr(true)"] == shown


def test_infinite_epsilon_is_shown() -> None:
    privacy = record()["privacy"] | {"epsilon_descriptor": "inf", "epsilon_image": "inf"}
    (table,) = tables.build_tables([record(privacy=privacy)])
    assert show(table, 0)["ε/descriptor"] == "∞"
    assert show(table, 0)["ε/image"] == "∞"


def test_terminal_and_markdown_show_the_same_values() -> None:
    (table,) = tables.build_tables([record(), NA])
    (brief,) = tables.build_tables([record(), NA], brief=True)
    console = Console(file=io.StringIO(), width=300)
    console.print(to_terminal(brief))
    terminal = console.file.getvalue()  # type: ignore[attr-defined]
    for text in (text for row in table.rows for text in row.texts):
        assert text in terminal
        assert text in show_markdown(table)


def test_pipe_in_a_reason_does_not_break_markdown() -> None:
    (table,) = tables.build_tables([NA | {"reason": "a|b\nc"}])
    assert r"a\|b c" in show_markdown(table)


@pytest.mark.slow
def test_figure_has_a_panel_for_each_record(tmp_path: Path) -> None:
    image = tmp_path / "image.png"
    Image.fromarray(np.zeros((256, 256, 3), np.uint8)).save(image)
    failed = record(status="failed", reason="too $dark$ " * 20, run_hash="f", metrics={})
    shown = figures.build_panels(np.zeros((256, 256, 3), np.uint8), [record(), failed], [image, tmp_path / "absent"])
    assert [panel.title for panel in shown] == ["original", "ldp:epsilon=10\ndia", "ldp:epsilon=10\ndia"]
    assert [panel.caption[:10] for panel in shown] == ["", "SSIM 0.500", "failed: to"]
    assert shown[2].pixels is None
    for panels in (shown, shown * 3):
        figures.draw(panels, "a").savefig(tmp_path / "figure.png")
        assert (tmp_path / "figure.png").stat().st_size > 1000
        picture = figures.draw_picture(panels, "a \udcff")  # of a name that is not UTF-8
        assert picture.width == figures.PIXELS * min(len(panels), figures.COLUMNS)
        black = (np.asarray(picture).max(axis=2) == 0).sum()  # mostly those of the two images
        assert black > 2 * (figures.PIXELS - 2 * figures.MARGIN) ** 2 * (len(panels) // 3)


def test_a_figure_is_laid_out_once_for_all_formats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture is the same, bit for bit. Control: without the layout it is another."""
    layouts = []
    execute = ConstrainedLayoutEngine.execute
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda *given: layouts.append(execute(*given)))

    def draw() -> Figure:
        return figures.draw([figures.Panel(np.zeros((30, 40, 3), np.uint8), "title\nof two lines", "caption")] * 2, "heading")

    plain, unplaced = draw(), draw()
    plain.savefig(tmp_path / "plain.png")
    unplaced.set_layout_engine(None)
    unplaced.savefig(tmp_path / "unplaced.png")
    layouts.clear()
    png, _ = drawing.save(draw(), tmp_path / "once", "")
    assert len(layouts) == 1
    once, expected, other = (np.asarray(Image.open(path)) for path in (png, tmp_path / "plain.png", tmp_path / "unplaced.png"))
    assert np.array_equal(once, expected)
    assert not np.array_equal(once, other)
