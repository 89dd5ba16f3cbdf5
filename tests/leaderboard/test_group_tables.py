"""Tables of comparison groups, as Markdown, CSV and LaTeX."""

import csv
import io
import re
from pathlib import Path

import fabricated
import pytest
from fabricated import DIA, baselines, inapplicable, ldp, localizations, reconstructions
from scipy import stats

from bench.core import table as core_table
from bench.core.table import to_csv, to_latex, to_markdown
from leaderboard import comparison, tables
from leaderboard.comparison import ComparisonGroup
from leaderboard.group_tables import GroupTable, build_pairs_table, build_ranking_table
from leaderboard.identification import measure_bits
from leaderboard.intervals import interval

NONE = {"name": "none"}
NEAREST = {"name": "nearest"}
HOSTILE = "<script>alert(1)</script> | *b* [x](javascript:y) $\\input{z}$ & 50% #1 ~^_`{}\n\nnext"


@pytest.fixture
def group(tmp_path: Path) -> ComparisonGroup:
    records = [
        *reconstructions(NONE, [0.7, 0.9] * 3),
        *reconstructions(ldp(8.0), [0.3, 0.4] * 3),
        *reconstructions(ldp(8.0), [0.1, 0.2] * 3, attack=NEAREST),
        *baselines(NONE, 6),
        inapplicable(NONE, NEAREST, "nearest attacks Subspaces; none releases Descriptors"),
    ]
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    return group


def cells(line: str, bar: str) -> list[str]:
    return [cell.strip() for cell in re.split(bar, line)]


def test_numbers_have_students_intervals(group: ComparisonGroup) -> None:
    row = build_ranking_table(group).rows[0]
    assert row.values["ssim"] == interval([0.3, 0.4] * 3)
    assert row.values["epsilon_descriptor"] == 8.0
    assert row.values["epsilon_image"] == pytest.approx(8.0 * 102.5 * 0.9)  # the smaller composition, the median photograph
    assert row.values["guarantee"] == "ε-LDP"
    assert "| **0.35 [0.2925, 0.4075]** |" in to_markdown(build_ranking_table(group))


def test_the_best_is_bold_among_the_strongest_attacks_alone(group: ComparisonGroup) -> None:
    """The values of a weak attack are not the best of a column, since they say little about the defense."""
    table = build_pairs_table(group)
    (ssim,) = (column for column in table.columns if column.name == "ssim")
    index = table.columns.index(ssim)
    bold = [(row.values["defense"], row.values["attack"]) for row in table.rows if index in row.best]
    assert bold == [("ldp:epsilon=8,subset_size=2", "dia")]
    assert r"\textbf{0.35 {[}0.2925, 0.4075{]}}" in to_latex(table)


def test_rows_that_do_not_apply_state_the_reason(group: ComparisonGroup) -> None:
    table = build_pairs_table(group)
    (row,) = (row for row in table.rows if row.experiment.reason)
    assert row.values["ssim"] is None
    written = to_markdown(table)
    (line,) = (line for line in written.splitlines() if line.startswith("|") and "nearest" in line and "none" in line)
    mark = re.search(r"none \[(\d)\]", line)
    assert mark
    assert line.count("n/a") >= 4
    assert f"[{mark[1]}] nearest attacks Subspaces; none releases Descriptors" in written


def test_csv_has_full_precision_and_the_ends_of_intervals(group: ComparisonGroup) -> None:
    first, *_ = csv.DictReader(io.StringIO(to_csv(build_ranking_table(group))))
    expected = interval([0.3, 0.4] * 3)
    assert [float(first[name]) for name in ("ssim", "ssim_low", "ssim_high")] == [expected.mean, expected.low, expected.high]
    assert first["rank"] == "1"
    (inapplicable,) = (row for row in csv.DictReader(io.StringIO(to_csv(build_pairs_table(group)))) if row["units"] == "n/a")
    assert [inapplicable[name] for name in ("ssim", "ssim_low", "ssim_high")] == ["n/a"] * 3
    assert "nearest attacks" in inapplicable["note"]


def test_a_single_photograph_has_no_interval(tmp_path: Path) -> None:
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, reconstructions(NONE, [0.5]))))
    assert "| 0.5 |" in to_markdown(build_ranking_table(group))
    (row,) = csv.DictReader(io.StringIO(to_csv(build_ranking_table(group))))
    assert (row["ssim"], row["ssim_low"]) == ("0.5", "n/a")


def test_a_metric_of_some_photographs_shows_their_number(tmp_path: Path) -> None:
    """An example is the fraction of faces that are detected again, since few photographs show a face."""
    records = reconstructions(NONE, [0.5, 0.6, 0.7])
    for record, face in zip(records, (None, 1.0, 0.0), strict=True):
        record["metrics"]["face"] = face
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    table = build_pairs_table(group)
    (row,) = table.rows
    (column,) = (column for column in table.columns if column.name == "face")
    assert row.texts[table.columns.index(column)] == "0.5 [0.09453, 0.9055] (n = 2)"


def test_identification_is_shown_in_three_columns_beside_ssim(tmp_path: Path) -> None:
    values = [1.0, 1.0, 0.5, 1 / 40, 1 / 9, 1 / 128.5]
    records = [*reconstructions(NONE, [0.7, 0.9] * 3), *baselines(NONE, 6)]
    for record, value in zip(records, [*values, *[1 / 128.5] * 12], strict=True):
        record["metrics"]["identified"] = value
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    table = build_pairs_table(group)
    names = [column.name for column in table.columns]
    first = names.index("ssim")
    assert names[first : first + 4] == ["ssim", "identified", "identified_rank_1", "identified_bits"]
    row, blank = (table.rows[index].texts[first + 1 : first + 4] for index in (0, 1))
    wilson = stats.binomtest(2, 6).proportion_ci(0.95, method="wilson")
    assert row[1] == f"0.3333 [{wilson.low:.4g}, {wilson.high:.4g}] (2 of 6)"
    bits = measure_bits(values)
    assert row[2] == f"{bits.mean:.4g} [{bits.low:.4g}, {bits.high:.4g}]"
    assert blank[0].startswith("0.02392 "), "a constant image has the mean of a random order"
    assert blank[1:] == (f"0 [0, {stats.binomtest(0, 6).proportion_ci(0.95, method='wilson').high:.4g}] (0 of 6)", "0 [0, 0]")
    for written in (to_markdown(table), to_latex(table)):
        assert "identified, bits of 8 (chance 0)" in written
    (line, *_) = csv.DictReader(io.StringIO(to_csv(table)))
    assert float(line["identified_bits_high"]) == bits.high


def test_seeds_are_averaged_before_the_photographs(tmp_path: Path) -> None:
    records = [one for seed in (0, 1) for one in reconstructions(NONE, [0.7] * 6, seed=seed)]
    by_seed = [[1.0] * 6, [0.5, 1.0] * 3]
    for record, value in zip(records, [*by_seed[0], *by_seed[1]], strict=True):
        record["metrics"]["identified"] = value
    groups = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    (group,) = (group for group in groups if group.seeds == (0, 1))
    (row,) = build_pairs_table(group).rows
    assert row.values["identified_rank_1"] == interval([0.5, 1.0] * 3)
    assert row.values["identified_bits"] == measure_bits(list(zip(*by_seed, strict=True)))
    assert "(4.5 of 6)" in to_markdown(build_pairs_table(group))


def test_latex_is_booktabs_of_even_rows(group: ComparisonGroup) -> None:
    written = to_latex(build_pairs_table(group))
    assert all(rule in written for rule in (r"\toprule", r"\midrule", r"\bottomrule"))
    layout = re.search(r"\\begin\{tabular\}\{(\w+)\}", written)
    assert layout
    rows = [line for line in written.splitlines() if line.endswith(r" \\")]
    assert {len(re.findall(r"(?<!\\)&", row)) + 1 for row in rows} == {len(layout[1])}
    assert len(rows) == 7
    assert r"$\varepsilon$-LDP" in written


def test_strings_of_users_are_text_in_every_format(tmp_path: Path) -> None:
    hostile = {"name": HOSTILE, "field": HOSTILE}
    dataset = fabricated.PHOTOGRAPHS | {"name": HOSTILE}
    records = reconstructions(hostile, [0.5, 0.6], dataset=dataset, attack=DIA | {"name": HOSTILE})
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    table = build_pairs_table(group)
    check_rows(table)
    (row,) = csv.DictReader(io.StringIO(to_csv(table)))
    assert row["attack"].startswith(HOSTILE)
    body = to_latex(table).split(r"\midrule")[1]
    for special in "&#$%_":
        allowed = {"&": r"(?<!\\)&", "$": r"(?<!\\)\$(?!\\varepsilon|\\delta)"}.get(special, rf"(?<!\\){re.escape(special)}")
        line = body.splitlines()[1]
        count = len(re.findall(allowed, line))
        assert count == (len(table.columns) - 1 if special == "&" else 0), (special, line)
    assert r"\input" not in body
    assert r"\textbackslash{}input\{z\}" in body


def test_names_of_plugins_are_text_in_reports(tmp_path: Path) -> None:
    """Also in headings of columns, in notes and in the source of report.md, where words keep their underscores."""
    metrics = {"<img src=x>": 0.5, "[a](javascript:b)": 0.5, "my_own": 0.5, "*bold*": 0.5, "`code`|": 0.5, "_under": 0.5}
    records = [fabricated.record("a", {"ssim": 0.5, "keypoints": 9} | metrics, defense=ldp(8.0))]
    records.append(fabricated.record(HOSTILE, {}, defense=ldp(8.0), status="failed", reason=HOSTILE))
    (plain,) = tables.build_tables(records)
    assert {"<img src=x>", "my_own"} <= {column.label for column in plain.columns}
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    for written in (to_markdown(plain, plain=True), to_markdown(plain), to_markdown(build_pairs_table(group))):
        rows = [line for line in written.splitlines() if line.startswith("|")]
        assert len({len(cells(line, r"(?<!\\)\|")) for line in rows}) == 1
        assert not re.search(r"(?<!\\)[<`]", written)
        assert not re.search(r"(?<!\\)\]\(javascript", written)
        assert r"\*bold\*" in rows[0]
        assert r"\_under" in rows[0]
    assert "my_own" in to_markdown(plain, plain=True)


def check_rows(table: GroupTable) -> None:
    """Check that Markdown has one line per row with one cell per column, and that no text starts markup."""
    written = to_markdown(table)
    rows = [line for line in written.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + len(table.rows)
    assert {len(cells(line, r"(?<!\\)\|")) for line in rows} == {len(table.columns) + 2}
    assert not re.search(r"(?<!\\)[<`]", written)
    assert not re.search(r"(?<!\\)\]\(javascript", written)


def test_a_broken_escape_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core_table, "escape_markdown", lambda text: text)
    with pytest.raises(AssertionError):
        test_strings_of_users_are_text_in_every_format(tmp_path)


def test_utility_tables_begin_with_the_judged_measures(tmp_path: Path) -> None:
    records = [*localizations(NONE, [1, 1], ["day"] * 2), *localizations(ldp(8.0), [1, 0], ["day"] * 2)]
    (group,) = comparison.build_groups(comparison.load_records(fabricated.write(tmp_path, records)))
    table = build_pairs_table(group)
    names = [column.name for column in table.columns]
    assert "rank" not in names
    assert "attack" not in names
    assert names.index("recall_0.25m_2deg_day") < names.index("translation_error_day") < names.index("inliers")
    assert [row.values["defense"] for row in table.rows] == ["none", "ldp:epsilon=8,subset_size=2"]
    assert [names.index("recall_0.25m_2deg_day") in row.best for row in table.rows] == [True, False]
