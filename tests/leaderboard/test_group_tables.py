"""Tables of boards, as Markdown, CSV and LaTeX."""

import csv
import io
import re
from pathlib import Path

import fabricated
import pytest
from fabricated import DIA, inapplicable, ldp, localizations, reconstructions

from leaderboard import comparison, group_tables
from leaderboard.comparison import ComparisonGroup
from leaderboard.group_tables import Sheet
from leaderboard.intervals import interval

NONE = {"name": "none"}
NEAREST = {"name": "nearest"}
HOSTILE = "<script>alert(1)</script> | *b* [x](javascript:y) $\\input{z}$ & 50% #1 ~^_`{}\n\nnext"


@pytest.fixture
def board(tmp_path: Path) -> ComparisonGroup:
    records = [
        *reconstructions(NONE, [0.7, 0.9]),
        *reconstructions(ldp(8.0), [0.3, 0.4]),
        *reconstructions(ldp(8.0), [0.1, 0.2], attack=NEAREST),
        inapplicable(NONE, NEAREST, "nearest attacks Subspaces; none releases Descriptors"),
    ]
    (found,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    return found


def cells(line: str, bar: str) -> list[str]:
    return [cell.strip() for cell in re.split(bar, line)]


def test_numbers_stand_with_their_bootstrap_intervals(board: ComparisonGroup) -> None:
    row = group_tables.ranking(board).rows[0]
    assert row.values["ssim"] == interval([0.3, 0.4])
    assert row.values["epsilon_descriptor"] == 8.0
    assert row.values["epsilon_image"] == pytest.approx(8.0 * 100.5 * 0.9)  # the smaller composition, the median photograph
    assert row.values["guarantee"] == "ε-LDP"
    assert "| **0.35 [0.3, 0.4]** |" in group_tables.to_markdown(group_tables.ranking(board))


def test_the_best_is_bold_among_the_strongest_attacks_alone(board: ComparisonGroup) -> None:
    """A weak attack on a defense makes no column's best: it says little of the defense."""
    every = group_tables.pairs(board)
    (ssim,) = (column for column in every.columns if column.name == "ssim")
    bold = [(row.values["defense"], row.values["attack"]) for row in every.rows if every.is_best(ssim, row)]
    assert bold == [("ldp:epsilon=8,subset_size=2", "dia")]
    assert r"\textbf{0.35 {[}0.3, 0.4{]}}" in group_tables.to_latex(every)


def test_what_does_not_apply_is_told_why(board: ComparisonGroup) -> None:
    every = group_tables.pairs(board)
    (row,) = (row for row in every.rows if row.cell.reason)
    assert row.values["ssim"] is None
    written = group_tables.to_markdown(every)
    (line,) = (line for line in written.splitlines() if line.startswith("|") and "nearest" in line and "none" in line)
    mark = re.search(r"none \[(\d)\]", line)
    assert mark
    assert line.count("n/a") >= 4
    assert f"[{mark[1]}] nearest attacks Subspaces; none releases Descriptors" in written


def test_csv_has_full_precision_and_the_ends_of_intervals(board: ComparisonGroup) -> None:
    first, *_ = csv.DictReader(io.StringIO(group_tables.to_csv(group_tables.ranking(board))))
    expected = interval([0.3, 0.4])
    assert [float(first[name]) for name in ("ssim", "ssim_low", "ssim_high")] == [expected.mean, expected.low, expected.high]
    assert first["rank"] == "1"
    (inapplicable,) = (
        row for row in csv.DictReader(io.StringIO(group_tables.to_csv(group_tables.pairs(board)))) if row["units"] == "n/a"
    )
    assert [inapplicable[name] for name in ("ssim", "ssim_low", "ssim_high")] == ["n/a"] * 3
    assert "nearest attacks" in inapplicable["note"]


def test_a_single_photograph_has_no_interval(tmp_path: Path) -> None:
    (found,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, reconstructions(NONE, [0.5]))))
    assert "| 0.5 |" in group_tables.to_markdown(group_tables.ranking(found))
    (row,) = csv.DictReader(io.StringIO(group_tables.to_csv(group_tables.ranking(found))))
    assert (row["ssim"], row["ssim_low"]) == ("0.5", "n/a")


def test_what_only_some_photographs_have_tells_how_many(tmp_path: Path) -> None:
    """Such as the share of faces that are found again, where few photographs show one."""
    records = reconstructions(NONE, [0.5, 0.6, 0.7])
    for record, face in zip(records, (None, 1.0, 0.0), strict=True):
        record["metrics"]["face"] = face
    (found,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    (row,) = group_tables.pairs(found).rows
    (column,) = (column for column in group_tables.pairs(found).columns if column.name == "face")
    assert group_tables.shown(column, row) == "0.5 [0, 1] (n = 2)"


def test_latex_is_booktabs_of_even_rows(board: ComparisonGroup) -> None:
    written = group_tables.to_latex(group_tables.pairs(board))
    assert all(rule in written for rule in (r"\toprule", r"\midrule", r"\bottomrule"))
    layout = re.search(r"\\begin\{tabular\}\{(\w+)\}", written)
    assert layout
    rows = [line for line in written.splitlines() if line.endswith(r" \\")]
    assert {len(re.findall(r"(?<!\\)&", row)) + 1 for row in rows} == {len(layout[1])}
    assert len(rows) == 5
    assert r"$\varepsilon$-LDP" in written


def test_strings_of_users_are_text_in_every_format(tmp_path: Path) -> None:
    hostile = {"name": HOSTILE, "field": HOSTILE}
    dataset = fabricated.PHOTOGRAPHS | {"name": HOSTILE}
    records = reconstructions(hostile, [0.5, 0.6], dataset=dataset, attack=DIA | {"name": HOSTILE})
    (found,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    sheet = group_tables.pairs(found)
    check_rows(sheet)
    (row,) = csv.DictReader(io.StringIO(group_tables.to_csv(sheet)))
    assert row["attack"].startswith(HOSTILE)
    body = group_tables.to_latex(sheet).split(r"\midrule")[1]
    for special in "&#$%_":
        allowed = {"&": r"(?<!\\)&", "$": r"(?<!\\)\$(?!\\varepsilon|\\delta)"}.get(special, rf"(?<!\\){re.escape(special)}")
        line = body.splitlines()[1]
        count = len(re.findall(allowed, line))
        assert count == (len(sheet.columns) - 1 if special == "&" else 0), (special, line)
    assert r"\input" not in body
    assert r"\textbackslash{}input\{z\}" in body


def check_rows(sheet: Sheet) -> None:
    """Markdown keeps one line a row, with as many cells as there are columns, and starts no markup."""
    written = group_tables.to_markdown(sheet)
    rows = [line for line in written.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + len(sheet.rows)
    assert {len(cells(line, r"(?<!\\)\|")) for line in rows} == {len(sheet.columns) + 2}
    assert not re.search(r"(?<!\\)[<`]", written)
    assert not re.search(r"(?<!\\)\]\(javascript", written)


def test_a_broken_escape_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(group_tables, "markdown", lambda text: text)
    with pytest.raises(AssertionError):
        test_strings_of_users_are_text_in_every_format(tmp_path)


def test_tables_of_a_server_are_led_by_what_it_is_judged_by(tmp_path: Path) -> None:
    records = [*localizations(NONE, [1, 1], ["day"] * 2), *localizations(ldp(8.0), [1, 0], ["day"] * 2)]
    (found,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    sheet = group_tables.pairs(found)
    names = [column.name for column in sheet.columns]
    assert "rank" not in names
    assert "attack" not in names
    assert names.index("recall_0.25m_2deg_day") < names.index("translation_error_day") < names.index("inliers")
    assert [row.values["defense"] for row in sheet.rows] == ["none", "ldp:epsilon=8,subset_size=2"]
    assert [sheet.is_best(next(c for c in sheet.columns if c.name == "recall_0.25m_2deg_day"), row) for row in sheet.rows] == [
        True,
        False,
    ]
