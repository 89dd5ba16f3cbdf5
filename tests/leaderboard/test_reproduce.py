"""`bench reproduce` from end to end in its smallest form: files, verdicts from records, and going on after an interruption."""

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from fakes import texture
from PIL import Image

from bench import cli
from bench.api import Asset, Attack, Defense
from bench.cache import store
from bench.codebook.public import ASSETS, Public
from bench.core import progress
from bench.extractors.sift import Sift
from bench.registry import discovery
from bench.runner.records import FILE, Record
from bench.tasks.reconstruction import Reconstruction
from leaderboard.reproduce import command, figures, page, run, tables
from leaderboard.reproduce.claims import Claim, Verdict, falling, same_order
from leaderboard.reproduce.profiles import CPU, SMOKE, Materials, Setting
from leaderboard.reproduce.run import Judged, Ran
from leaderboard.reproduce.study import Measure, Row, Table, build

TABLES = sorted(tables.everything())


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pictures of some 30 keypoints."""
    folder = tmp_path_factory.mktemp("reproduce")
    for number in range(2):
        texture(number, (56, 48)).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that tables share."""
    return tmp_path_factory.mktemp("reproduce") / "out"


PLACE = "gallery:views=8,queries=3,width=320,height=240,rooms=1,detail=0.3"
WALK = "walk:views=4,others=6,steps=60,width=320,height=240,detail=0.3"


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(store.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


def reproduce(name: str, images: Path, out: Path, *more: str) -> int:
    of_place = name in command.of_places()
    place = WALK if name == "tableS2" else PLACE  # which of its queries are of one camera
    judged = ("--dataset", place, "--workers", "1") if of_place else ("--images", str(images))
    return cli.main(["reproduce", name, "--profile", "smoke", *judged, "--out", str(out), *more])


def lines(out: Path) -> list[bytes]:
    return (out / FILE).read_bytes().splitlines()


# ---- from end to end


@pytest.mark.parametrize("name", TABLES)
def test_smoke(name: str, images: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce(name, images, out) == 0
    printed = capsys.readouterr().out
    found = json.loads((out / f"{name}.json").read_text())
    measured = [row for row in found["rows"] if any(value["ours"] is not None for value in row["ours"].values())]
    assert measured
    assert all(row["note"].startswith("n/a") for row in found["rows"] if row not in measured)
    written = (out / f"{name}.md").read_text()
    for claim in found["claims"]:
        assert claim["claim"] in written
        assert claim["verdict"] == "cannot tell"  # of two photographs nothing can be told
        assert claim["statements"]
    assert found["title"] in printed
    if tables.everything()[name].draw is not None:
        drawn = sorted((out / "figures").glob(f"{name}-*"))
        assert {file.suffix for file in drawn} == {".png", ".pdf"}
        assert all(str(file) in printed for file in drawn)
        assert np.asarray(Image.open(drawn[1]).convert("L")).std() > 5  # something is drawn
    cells = list(csv.DictReader((out / f"{name}.csv").open(encoding="utf-8")))
    assert len(cells) == len(found["rows"]) * len(tables.everything()[name].measures)
    statements = list(csv.DictReader((out / f"{name}-claims.csv").open(encoding="utf-8")))
    assert len(statements) == sum(len(claim["statements"]) for claim in found["claims"])


def test_done_again_nothing_runs_and_all_stays(images: Path, out: Path) -> None:
    """And Table 4 takes what it compares with from Table 1's records."""
    for name in ("table1", "table4"):
        if not (out / f"{name}.json").is_file():  # as it is after `test_smoke`
            assert reproduce(name, images, out) == 0
    before, text = lines(out), (out / "table4.json").read_bytes()
    assert reproduce("table4", images, out) == 0
    assert lines(out) == before
    assert (out / "table4.json").read_bytes() == text
    first, fourth = (
        {cell for row in json.loads((out / f"{name}.json").read_text())["rows"] for cell in row["cell_ids"]}
        for name in ("table1", "table4")
    )
    assert len(first & fourth) == 12


def unanswered(setting: Setting) -> dict[str, str | None]:
    """Rows of tables about photographs that no attack as configured answers -> why."""
    public = Public()
    every = [row for table in tables.everything().values() if not table.place for row in table.rows(setting)]
    reasons = {row.name: row.task.explain_not_applicable(row.defense, row.attack, setting.extractor, public) for row in every}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def test_what_is_shipped_answers_every_row() -> None:
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=7)
    assert unanswered(setting) == {}
    another = Materials(ldp_network=Asset(str(ASSETS / "inversion-none.safetensors")))
    assert len(unanswered(replace(setting, materials=another))) == 16


@pytest.mark.parametrize("name", ["figures", "figure-inlier"])
def test_figures(name: str, images: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce(name, images, out) == 0
    printed = capsys.readouterr().out
    drawings = [drawing for drawing in figures.everything() if drawing.place == (name != "figures")]
    assert drawings
    for drawing in drawings:
        files = sorted((out / "figures").rglob(f"{drawing.name}*"))
        assert {file.suffix for file in files} == {".png", ".pdf"}
        for file in files:
            assert str(file) in printed
            if file.suffix == ".png":
                assert np.asarray(Image.open(file).convert("L")).std() > 5  # something is drawn


def test_interrupted_reproduction_goes_on_and_ends_as_if_it_had_not_been(
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
    assert len(lines(broken)) == 1
    assert not (broken / "tableS3.json").exists()
    assert reproduce("tableS3", images, broken) == 0
    assert len(lines(broken)) == len(lines(whole)) == 4
    for name in ("tableS3.json", "tableS3.md", "tableS3.csv", "tableS3-claims.csv"):
        assert (broken / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("table7",), "unknown table 'table7'; did you mean"),
        (("table1", "--profile", "big"), "unknown profile 'big'; there is cpu, paper, smoke"),
        (("table4", "--profile", "paper"), "has 256,000 words, and profile paper needs 512,000"),
        (("tableS3", "--images", "nowhere"), "no such folder"),
        (("tableS3", "--database", "nowhere.safetensors"), "nowhere.safetensors"),
        (("tableS3", "--size", "3"), "unknown option '--size'"),
        (("table2", "--images", "nowhere"), "table2 is about a place: name it with --dataset"),
        (("table1", "--dataset", "gallery"), "table1 is about photographs: name them with --images"),
        ((), "--what is missing"),
    ],
)
def test_mistakes(words: tuple[str, ...], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["reproduce", *words, *(("--out", str(tmp_path / "out")) if words else ())]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ---- from records to verdicts, on made-up records

PAPER = {"raw": 0.7, "two": 0.5, "four": 0.4, "none": 0.1}


def made_up_rows(setting: Setting) -> tuple[Row, ...]:
    defense: Defense = build(discovery.DEFENSE, "none", {})
    attack: Attack = build(discovery.ATTACK, "dia", {})
    return tuple(
        Row(name=name, labels={"row": name}, paper={"ssim": ssim}, defense=defense, attack=attack, task=Reconstruction())
        for name, ssim in PAPER.items()
    )


TABLE = Table(
    name="made-up",
    title="A table",
    measures={"ssim": Measure(metric="ssim", times=2.0), "other": Measure(metric="other")},
    rows=made_up_rows,
    claims=lambda paper: (
        same_order(paper, 0.03, "SSIM"),
        Claim(text="It falls.", statements=falling([("two", "ssim"), ("four", "ssim")])),
    ),
    ordered="ssim",
)


def made_up(ssim: dict[str, list[float | None]]) -> run.Rebuilt:
    """A table from records that hold half the given values; None for a photograph that failed, and no values for n/a."""
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=8)
    records: dict[str, tuple[Record, ...]] = {
        name: tuple(
            {"unit": str(unit), "seed": 0, "status": "failed", "reason": "broken", "metrics": {}, "notes": []}
            if value is None
            else {
                "unit": str(unit),
                "seed": 0,
                "status": "ok",
                "reason": None,
                "metrics": {"ssim": value / 2},
                "notes": ["small"],
            }
            for unit, value in enumerate(values)
        )
        or ({"unit": "*", "seed": 0, "status": "n/a", "reason": "no network", "metrics": {}, "notes": []},)
        for name, values in ssim.items()
    }
    ran = Ran(rows=made_up_rows(setting), cells={name: (name,) for name in ssim}, records=records)
    return run.weigh(TABLE, setting, Judged(name="photographs", names=("0",) * 8, available=8), ran)


def around(mean: float, count: int = 8) -> list[float | None]:
    return [mean + 0.01 * (number % 2) for number in range(count)]


def test_means_verdicts_and_correlation_from_records() -> None:
    rebuilt = made_up({"raw": around(0.6), "two": around(0.3), "four": around(0.4), "none": []})
    ours = rebuilt.ours["raw", "ssim"]
    assert (ours.mean, ours.count) == (pytest.approx(0.605), 8)
    assert ("none", "ssim") not in rebuilt.ours
    assert ("raw", "other") not in rebuilt.ours
    assert rebuilt.correlation == pytest.approx(0.5)  # raw, two, four against raw, four, two
    order, falls = rebuilt.findings
    assert falls.verdict is Verdict.FAILS
    assert order.verdict is Verdict.FAILS
    verdicts = [evidence.verdict for evidence in order.evidence]
    assert (verdicts.count(Verdict.HOLDS), verdicts.count(Verdict.FAILS), verdicts.count(Verdict.OPEN)) == (2, 1, 3)


def test_what_fails_or_does_not_apply_is_said_in_every_form() -> None:
    rebuilt = made_up({"raw": [None, *around(0.6, 7)], "two": around(0.3), "four": around(0.4), "none": []})
    assert rebuilt.notes == {"raw": "1 failed; small", "two": "small", "four": "small", "none": "n/a: no network"}
    assert run.failures(rebuilt.ran) == 1
    written = page.markdown(rebuilt)
    assert "does not hold: [two] ssim > [four] ssim: paper 0.1, ours -0.1 [-0.1, -0.1]" in written
    assert "cannot tell: [raw] ssim > [none] ssim: paper 0.6, nothing measured (none: n/a: no network)" in written
    assert "(Of 6: 2 hold, 1 do not hold, 3 cannot be told.)" in written
    shown = page.side_by_side(rebuilt)
    assert list(shown["n"]) == ["7", "8", "8", "0"]
    assert shown["ssim, ours"].iloc[3] == "n/a"
    assert "0.605" in shown["ssim, ours"].iloc[1] or "0.305" in shown["ssim, ours"].iloc[1]
    plain = page.plain(rebuilt)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert [claim["verdict"] for claim in plain["claims"]] == ["does not hold", "does not hold"]
    numbers = page.numbers(rebuilt).set_index(["row", "measure"])
    assert pd.isna(numbers.loc[("none", "ssim"), "ours"])
    assert numbers.loc[("two", "ssim"), "photographs"] == 8


def test_a_median_takes_a_unit_without_a_value_for_the_worst() -> None:
    """And a mean leaves it out. A table that is repeated counts each seed as a unit."""
    measures = {"mean": Measure(metric="off"), "median": Measure(metric="off", median=True)}
    table = replace(TABLE, measures=measures, claims=lambda paper: (), ordered=None, repeated=True)
    setting = Setting(profile=CPU, materials=Materials(), extractor=Sift(), photographs=1)
    values = {0: 1.0, 1: None, 2: 2.0, 3: None, 4: None}
    records: dict[str, tuple[Record, ...]] = {
        f"seed {seed}": ({"unit": "a", "seed": seed, "status": "ok", "reason": None, "metrics": {"off": off}, "notes": []},)
        for seed, off in values.items()
    }
    row = made_up_rows(setting)[0]
    ran = Ran(rows=(row,), cells={row.name: tuple(records)}, records=records)
    rebuilt = run.weigh(table, setting, Judged(name="place", names=("a",), available=1), ran)
    assert rebuilt.ours["raw", "mean"].mean == 1.5
    assert rebuilt.ours["raw", "mean"].count == 2
    assert rebuilt.ours["raw", "median"].mean == float("inf")
    shown = page.side_by_side(rebuilt).iloc[0]
    assert shown["median"] == "∞"
    assert shown["n"] == "2/5"
    assert "seeds 0 to 5" in page.heading(rebuilt)
    assert json.loads(json.dumps(page.plain(rebuilt), allow_nan=False))["rows"][0]["ours"]["median"]["ours"] == "inf"


def test_the_order_of_the_paper_is_confirmed_where_it_is_there() -> None:
    rebuilt = made_up({name: around(value) for name, value in PAPER.items()})
    assert [finding.verdict for finding in rebuilt.findings] == [Verdict.HOLDS, Verdict.HOLDS]
    assert rebuilt.correlation == pytest.approx(1)


def test_smoke_is_small() -> None:
    assert SMOKE.photographs <= 2
    assert SMOKE.builtin is not None
    assert len(SMOKE.builtin) <= 2
