"""`bench reproduce` from end to end in its smallest form: files, verdicts from records, and resuming after an interruption."""

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import fabricated
import numpy as np
import pandas as pd
import pytest
from fakes import draw_texture
from PIL import Image
from scipy.stats import binomtest

from attacks.dia import DIA
from attacks.oracle import Oracle
from bench import cli
from bench.api import Attack, Defense
from bench.cache import store
from bench.codebook.public import ASSETS, Public
from bench.core import progress
from bench.core.table import Table as PrintedTable
from bench.core.table import write_csv
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.inversion import weights
from bench.registry import discovery, spec
from bench.runner import suite
from bench.runner.records import FILE, Record
from bench.settings import Asset
from bench.tasks.reconstruction import Reconstruction
from leaderboard.chance import RECIPROCAL_RANK
from leaderboard.identification import measure_bits
from leaderboard.reproduce import command, figures, page, run, study, tables
from leaderboard.reproduce.claims import Claim, Verdict, falling, same_order
from leaderboard.reproduce.profiles import CPU, SMOKE, Materials, Setting
from leaderboard.reproduce.run import EvaluationSet, RunResult
from leaderboard.reproduce.study import Measure, Row, Table, build_plugin

LONG = ("table1", "table2", "table3", "table4", "tableS1", "tableS2", "figures", "figure-inlier")  # ten seconds or more each
TABLES = sorted(tables.load_tables())


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pictures of some 30 keypoints."""
    folder = tmp_path_factory.mktemp("reproduce")
    for number in range(2):
        draw_texture(number, (56, 48)).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that tables share."""
    return tmp_path_factory.mktemp("reproduce") / "out"


GALLERY = "gallery:views=8,queries=3,width=320,height=240,rooms=1,detail=0.3"
WALK = "walk:views=4,others=6,steps=60,width=320,height=240,detail=0.3"


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(store.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


def reproduce(name: str, images: Path, out: Path, *more: str) -> int:
    dataset = WALK if name == "tableS2" else GALLERY  # all of its images are of one camera
    source = ("--dataset", dataset, "--workers", "1") if command.takes_dataset(name) else ("--images", str(images))
    return cli.main(["reproduce", name, "--profile", "smoke", *source, "--out", str(out), *more])


def read_lines(out: Path) -> list[bytes]:
    return (out / FILE).read_bytes().splitlines()


# ---- from end to end


def mark_long(names: list[str]) -> list[Any]:
    return [pytest.param(name, marks=pytest.mark.exhaustive if name in LONG else pytest.mark.slow) for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(TABLES))
def test_smoke(name: str, images: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce(name, images, out) == 0
    output = capsys.readouterr().out
    report = json.loads((out / f"{name}.json").read_text())
    measured = [row for row in report["rows"] if any(value["ours"] is not None for value in row["ours"].values())]
    assert measured
    assert all(row["note"].startswith("n/a") for row in report["rows"] if row not in measured)
    markdown = (out / f"{name}.md").read_text()
    for claim in report["claims"]:
        assert claim["claim"] in markdown
        assert claim["verdict"] == "cannot tell"  # two photographs are too few
        assert claim["statements"]
    assert report["title"] in output
    if tables.load_tables()[name].draw is not None:
        files = sorted((out / "figures").glob(f"{name}-*"))
        assert {file.suffix for file in files} == {".png", ".pdf"}
        assert all(str(file) in output for file in files)
        assert np.asarray(Image.open(files[1]).convert("L")).std() > 5  # something is drawn
    entries = list(csv.DictReader((out / f"{name}.csv").open(encoding="utf-8")))
    assert len(entries) == len(report["rows"]) * len(tables.load_tables()[name].measures)
    statements = list(csv.DictReader((out / f"{name}-claims.csv").open(encoding="utf-8")))
    assert len(statements) == sum(len(claim["statements"]) for claim in report["claims"])


@pytest.mark.exhaustive
def test_repeated_reproduction_runs_nothing_and_changes_nothing(images: Path, out: Path) -> None:
    """Table 4 reuses Table 1's records for its reference rows."""
    for name in ("table1", "table4"):
        if not (out / f"{name}.json").is_file():  # as it is after `test_smoke`
            assert reproduce(name, images, out) == 0
    before, text = read_lines(out), (out / "table4.json").read_bytes()
    assert reproduce("table4", images, out) == 0
    assert read_lines(out) == before
    assert (out / "table4.json").read_bytes() == text
    first, fourth = (
        {key for row in json.loads((out / f"{name}.json").read_text())["rows"] for key in row["cell_ids"]}
        for name in ("table1", "table4")
    )
    assert len(first & fourth) == 14


def find_unsupported_rows(setting: Setting) -> dict[str, str | None]:
    """Return the rows of photograph tables whose attack as configured does not apply -> why."""
    public = Public()
    rows = [row for table in tables.load_tables().values() if not table.dataset for row in table.build_rows(setting)]
    reasons = {row.name: row.task.explain_not_applicable(row.defense, row.attack, setting.extractor, public) for row in rows}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def write_network_as_printed(folder: Path, defense: str, encoding: str = "released") -> Asset:
    """Write the metadata of the shipped network for that defense with another encoding, and no weights."""
    meta = weights.load(ASSETS / f"inversion-{defense}.safetensors").meta
    path = folder / f"{defense}-{encoding}.safetensors"
    tensor_file.save(path, weights.KIND, {"weight": np.zeros(1, np.float16)}, {**meta, "encoding": encoding})
    return Asset(path)


@pytest.mark.slow
def test_shipped_files_support_every_row(tmp_path: Path) -> None:
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=7)
    printed = Materials(
        as_printed_affine=write_network_as_printed(tmp_path, "affine"), as_printed_ldp=write_network_as_printed(tmp_path, "ldp")
    )
    assert find_unsupported_rows(replace(setting, materials=printed)) == {}
    assert find_unsupported_rows(setting) == {}
    another = replace(printed, ldp_network=Asset(str(ASSETS / "inversion-none.safetensors")))
    assert len(find_unsupported_rows(replace(setting, materials=another))) == 16


@pytest.mark.slow
def test_rows_as_printed_stand_beside_ours(tmp_path: Path) -> None:
    """Each has the release of one of our rows, a network of its own, and no value of the paper. None without a network."""
    materials = Materials(
        as_printed_affine=write_network_as_printed(tmp_path, "affine"), as_printed_ldp=write_network_as_printed(tmp_path, "ldp")
    )
    setting = Setting(profile=CPU, materials=materials, extractor=Sift(), photographs=7)
    for name, count, network in (("table1", 4, materials.as_printed_affine), ("table4", 16, materials.as_printed_ldp)):
        build_rows = tables.load_tables()[name].build_rows
        rows = build_rows(setting)
        assert len(build_rows(replace(setting, materials=Materials()))) == len(rows) - count
        by_name = {row.name: row for row in rows}
        printed = [row for row in rows if row.labels["attack"] == study.AS_PRINTED]
        pairs = [(by_name[row.name.removesuffix(", as printed")], row) for row in printed]
        assert len(pairs) == count
        for ours, row in pairs:
            assert (row.defense, row.task, row.paper) == (ours.defense, ours.task, {})
            assert (ours.labels["attack"], row.attack) == ("dia", DIA(weights=network))
            assert row.attack != ours.attack


@pytest.mark.slow
def test_an_oracle_stands_beside_each_row_of_word_sets() -> None:
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=7)
    by_name = {row.name: row for row in tables.load_tables()["table4"].build_rows(setting)}
    oracles = {name.removesuffix(", oracle"): row for name, row in by_name.items() if isinstance(row.attack, Oracle)}
    assert len(oracles) == 16
    for name, row in oracles.items():
        assert (row.defense, row.task, row.paper) == (by_name[name].defense, by_name[name].task, {})
        assert (by_name[name].labels["attack"], row.labels["attack"]) == ("dia", "oracle")


def test_a_network_with_another_input_is_no_network_as_printed(
    images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = write_network_as_printed(tmp_path, "affine", "invariant")
    assert reproduce("table1", images, tmp_path / "out", "--as-printed-affine", network) == 2
    assert f"{network}: its input is invariant; pass a network of `bench train --encoding released`" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", mark_long(["figures", "figure-inlier"]))
def test_figures(name: str, images: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce(name, images, out) == 0
    output = capsys.readouterr().out
    drawings = [drawing for drawing in figures.load_figures() if drawing.uses_queries == (name != "figures")]
    assert drawings
    for drawing in drawings:
        files = sorted((out / "figures").rglob(f"{drawing.name}*"))
        assert {file.suffix for file in files} == {".png", ".pdf"}
        for file in files:
            assert str(file) in output
            if file.suffix == ".png":
                assert np.asarray(Image.open(file).convert("L")).std() > 5  # something is drawn


@pytest.mark.slow
def test_interrupted_reproduction_resumes_with_the_same_result(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert reproduce("tableS3", images, whole) == 0
    with monkeypatch.context() as interrupted:
        advance: Callable[..., None] = progress.Progress.advance

        def once(self: progress.Progress, *args: Any, **more: Any) -> None:
            advance(self, *args, **more)
            raise KeyboardInterrupt

        interrupted.setattr(progress.Progress, "advance", once)
        assert reproduce("tableS3", images, broken) == 130
    assert len(read_lines(broken)) == 1
    assert not (broken / "tableS3.json").exists()
    assert reproduce("tableS3", images, broken) == 0
    assert len(read_lines(broken)) == len(read_lines(whole)) == 4
    for name in ("tableS3.json", "tableS3.md", "tableS3.csv", "tableS3-claims.csv"):
        assert (broken / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("table7",), "unknown table 'table7'; did you mean"),
        (("table1", "--profile", "big"), "unknown profile 'big'; available: cpu, dense, paper, smoke"),
        (("table4", "--profile", "paper"), "has 256,000 words, and profile paper needs 512,000"),
        (("tableS3", "--images", "nowhere"), "no such folder"),
        (("tableS3", "--database", "nowhere.safetensors"), "nowhere.safetensors"),
        (("tableS3", "--size", "3"), "unknown option '--size'"),
        (("table2", "--images", "nowhere"), "table2 uses a dataset: pass it with --dataset"),
        (("table1", "--dataset", "gallery"), "table1 uses photographs: pass them with --images"),
        ((), "--what is missing"),
    ],
)
def test_mistakes(words: tuple[str, ...], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["reproduce", *words, *(("--out", str(tmp_path / "out")) if words else ())]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ---- from records to verdicts, on made-up records

PAPER = {"raw": 0.7, "two": 0.5, "four": 0.4, "none": 0.1}


def build_rows(setting: Setting) -> tuple[Row, ...]:
    defense: Defense = build_plugin(discovery.DEFENSE, "none", {})
    attack: Attack = build_plugin(discovery.ATTACK, "dia", {})
    return tuple(
        Row(name=name, labels={"row": name}, paper={"ssim": ssim}, defense=defense, attack=attack, task=Reconstruction())
        for name, ssim in PAPER.items()
    )


TABLE = Table(
    name="made-up",
    title="A table",
    measures={"ssim": Measure(metric="ssim", factor=2.0), "other": Measure(metric="other")},
    build_rows=build_rows,
    build_claims=lambda paper: (
        same_order(paper, 0.03, "SSIM"),
        Claim(text="It falls.", statements=falling([("two", "ssim"), ("four", "ssim")])),
    ),
    rank_measure="ssim",
)


def build_record(sample: str, metrics: dict[str, Any], **more: Any) -> Record:
    fields = {"sample": sample, "seed": 0, "status": "ok", "reason": None, "attack": None, "metrics": metrics, "notes": []}
    return fields | more


def reproduce_table(ssim: dict[str, list[float | None]]) -> run.ReproducedTable:
    """Return a table from records with half the given values; None: a failed photograph, no values: n/a.

    The records have no attack, so no signal is judged.
    """
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=8)
    records: dict[str, tuple[Record, ...]] = {
        name: tuple(
            build_record(str(number), {}, status="failed", reason="broken")
            if value is None
            else build_record(str(number), {"ssim": value / 2}, notes=["small"])
            for number, value in enumerate(values)
        )
        or (build_record("*", {}, status="n/a", reason="no network"),)
        for name, values in ssim.items()
    }
    result = RunResult(rows=build_rows(setting), experiment_ids={name: (name,) for name in ssim}, records=records)
    return run.compare_with_paper(TABLE, setting, EvaluationSet(name="photographs", names=("0",) * 8, available=8), result)


def build_values(mean: float, count: int = 8) -> list[float | None]:
    return [mean + 0.01 * (number % 2) for number in range(count)]


def test_means_verdicts_and_correlation_from_records() -> None:
    table = reproduce_table({"raw": build_values(0.6), "two": build_values(0.3), "four": build_values(0.4), "none": []})
    ours = table.ours["raw", "ssim"]
    assert (ours.mean, ours.count) == (pytest.approx(0.605), 8)
    assert ("none", "ssim") not in table.ours
    assert ("raw", "other") not in table.ours
    assert table.correlation == pytest.approx(0.5)  # raw, two, four against raw, four, two
    order, falls = table.claim_results
    assert falls.verdict is Verdict.FAILS
    assert order.verdict is Verdict.FAILS
    verdicts = [evidence.verdict for evidence in order.evidence]
    assert (verdicts.count(Verdict.HOLDS), verdicts.count(Verdict.FAILS), verdicts.count(Verdict.OPEN)) == (2, 1, 3)


def list_texts(table: PrintedTable) -> list[dict[str, str]]:
    """Return the texts of each row by the column's label."""
    return [dict(zip((column.label for column in table.columns), row.texts, strict=True)) for row in table.rows]


def test_failures_and_not_applicable_rows_are_in_every_output() -> None:
    ssim = {"raw": [None, *build_values(0.6, 7)], "two": build_values(0.3), "four": build_values(0.4), "none": []}
    table = reproduce_table(ssim)
    assert table.notes == {"raw": "1 failed; small", "two": "small", "four": "small", "none": "n/a: no network"}
    assert run.count_failures(table.result) == 1
    markdown = page.to_markdown(table)
    assert "does not hold: [two] ssim > [four] ssim: paper 0.1, ours -0.1 [-0.1, -0.1]" in markdown
    assert "cannot tell: [raw] ssim > [none] ssim: paper 0.6, nothing measured (none: n/a: no network)" in markdown
    assert "(Of 6: 2 hold, 1 do not hold, 3 cannot be decided.)" in markdown
    values = list_texts(page.compare_values(table))
    assert [row["n"] for row in values] == ["7", "8", "8", "0"]
    assert values[3]["ssim, ours"] == "n/a"
    assert "0.605" in values[1]["ssim, ours"] or "0.305" in values[1]["ssim, ours"]
    report = page.to_json(table)
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert [claim["verdict"] for claim in report["claims"]] == ["does not hold", "does not hold"]
    frame = pd.read_csv(StringIO(write_csv(page.tabulate_values(table)))).set_index(["row", "measure"])
    assert pd.isna(frame.loc[("none", "ssim"), "ours"])
    assert frame.loc[("two", "ssim"), "photographs"] == 8
    assert frame.loc[("raw", "ssim"), "paper"] == PAPER["raw"]


def test_median_counts_a_sample_without_a_value_as_the_worst() -> None:
    """A mean omits it. A table with several seeds counts each seed as a sample."""
    measures = {"mean": Measure(metric="off"), "median": Measure(metric="off", median=True)}
    definition = replace(TABLE, measures=measures, build_claims=lambda paper: (), rank_measure=None, multiple_seeds=True)
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=1)
    values = {0: 1.0, 1: None, 2: 2.0, 3: None, 4: None}
    records: dict[str, tuple[Record, ...]] = {
        f"seed {seed}": (build_record("a", {"off": off}, seed=seed),) for seed, off in values.items()
    }
    row = build_rows(setting)[0]
    result = RunResult(rows=(row,), experiment_ids={row.name: tuple(records)}, records=records)
    table = run.compare_with_paper(definition, setting, EvaluationSet(name="scene", names=("a",), available=1), result)
    assert table.ours["raw", "mean"].mean == 1.5
    assert table.ours["raw", "mean"].count == 2
    assert table.ours["raw", "median"].mean == float("inf")
    (values,) = list_texts(page.compare_values(table))
    assert values["median"] == "∞"
    assert values["n"] == "2/5"
    assert "seeds 0 to 5" in page.format_heading(table)
    assert json.loads(json.dumps(page.to_json(table), allow_nan=False))["rows"][0]["ours"]["median"]["ours"] == "inf"


@pytest.mark.parametrize("name", ["table1", "table4"])
def test_identification_has_rank_1_and_bits_in_tables_1_and_4(name: str) -> None:
    measures = tables.load_tables()[name].measures
    definition = replace(TABLE, measures=measures, build_claims=lambda paper: (), rank_measure=None)
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=8)
    values = [1.0, 1.0, 1.0, 0.5, 1 / 9, 1 / 60, 1 / 128.5, 1 / 2]
    records = tuple(build_record(str(number), {"identified": value}) for number, value in enumerate(values))
    row = build_rows(setting)[0]
    result = RunResult(rows=(row,), experiment_ids={row.name: ("id",)}, records={"id": records})
    table = run.compare_with_paper(definition, setting, EvaluationSet(name="photographs", names=("0",) * 8, available=8), result)
    (texts,) = list_texts(page.compare_values(table))
    labels = list(texts)
    first = labels.index("ssim, ours") + 1
    assert all(label.startswith("identified") for label in labels[first : first + 3])
    wilson, bits = binomtest(3, 8).proportion_ci(0.95, method="wilson"), measure_bits(values)
    assert texts["identified, rank 1 (chance 0.0039)"] == f"0.38 [{wilson.low:.2f}, {wilson.high:.2f}] (3 of 8)"
    assert texts["identified, bits of 8 (chance 0)"] == f"{bits.mean:.1f} [{bits.low:.1f}, {bits.high:.1f}]"
    mean = (3 + 0.5 + 1 / 9 + 1 / 60 + RECIPROCAL_RANK + 0.5) / 8
    assert texts["identified (chance 0.024)"].startswith(f"{mean:.3f} [")
    assert any("rank 1 for 1 of 256, and 0 bits" in remark for remark in page.list_remarks(table))


SIGNAL_ROWS = {"raw": build_values(0.6), "two": build_values(0.4), "four": build_values(0.11)}


def reproduce_signals(baselines: dict[str, list[float | None]]) -> run.ReproducedTable:
    """Return a table of these rows and baselines."""
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=8)
    rows = (*build_rows(setting)[:3], *study.build_baseline_rows(Reconstruction()))
    records = {
        row.name: tuple(
            fabricated.record(str(number), {"ssim": value}, defense={"name": "none"}, attack=spec.to_json(row.attack))
            for number, value in enumerate((SIGNAL_ROWS | baselines).get(row.name, ()))
        )
        for row in rows
        if row.attack is not None
    }
    result = RunResult(rows=rows, experiment_ids={row.name: (row.name,) for row in rows}, records=records)
    return run.compare_with_paper(TABLE, setting, EvaluationSet(name="photographs", names=("0",) * 8, available=8), result)


def test_a_claim_about_a_row_without_a_signal_cannot_be_decided() -> None:
    table = reproduce_signals({"blank": build_values(0.1), "keypoints": build_values(0.2)})
    assert {name: signal.word for name, signal in table.signals.items()} == {
        "raw": "yes",
        "two": "yes",
        "four": "no",
        "blank": "baseline",
        "keypoints": "baseline",
    }
    order, falls = table.claim_results
    assert falls.verdict is order.verdict is Verdict.OPEN
    assert falls.evidence[0].reason == "four: no signal: attack at baseline"
    assert {evidence.statement.text: evidence.verdict for evidence in order.evidence}["[raw] ssim > [two] ssim"] is Verdict.HOLDS
    markdown = page.to_markdown(table)
    assert "(four: no signal: attack at baseline)" in markdown
    shown = {row["row"] if row.get("row") else row["attack"]: row["signal"] for row in list_texts(page.compare_values(table))}
    assert shown == {"raw": "yes", "two": "yes", "four": "no", "blank": "baseline", "keypoints": "baseline"}
    report = page.to_json(table)
    assert [row["signal"] for row in report["rows"]][2] == "no signal: attack at baseline"
    entries = pd.read_csv(StringIO(write_csv(page.tabulate_values(table)))).set_index(["row", "measure"])
    assert entries.loc[("four", "ssim"), "signal"] == "no signal: attack at baseline"


def test_without_baselines_no_claim_is_decided() -> None:
    table = reproduce_signals({"blank": build_values(0.1)})
    assert {result.verdict for result in table.claim_results} == {Verdict.OPEN}
    assert "Add --attack keypoints." in page.to_markdown(table)
    control = reproduce_signals({"blank": build_values(0.05), "keypoints": build_values(0.06)})
    assert control.claim_results[1].verdict is Verdict.HOLDS


def test_tables_and_suites_of_reconstructions_have_both_baselines() -> None:
    for name in ("table1", "table4"):
        table = tables.load_tables()[name]
        setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=7)
        references = table.build_reference_rows(setting)
        assert {"blank", "keypoints"} <= {row.name for row in references}
        assert all(row.paper or row.name in ("blank", "keypoints") for row in references)
    attacks = {
        name: {spec.to_json(attack)["name"] for part in suite.find(name).parts for _, attack in part.pairs if attack is not None}
        for name in suite.list_suites()
    }
    assert [name for name, names in attacks.items() if names and not {"blank", "keypoints"} <= names] == []


def test_the_order_of_the_paper_is_confirmed() -> None:
    table = reproduce_table({name: build_values(value) for name, value in PAPER.items()})
    assert [result.verdict for result in table.claim_results] == [Verdict.HOLDS, Verdict.HOLDS]
    assert table.correlation == pytest.approx(1)


def test_smoke_is_small() -> None:
    assert SMOKE.photographs <= 2
    assert SMOKE.builtin is not None
    assert len(SMOKE.builtin) <= 2
