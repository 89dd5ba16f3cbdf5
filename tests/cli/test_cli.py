"""The command line: output, exit status and files, as scripts rely on them."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_plugins.sketch import Sketch
from fakes import FAKES, install_plugins

from bench import cli
from bench.api import View
from bench.cli import terminal
from bench.codebook.examples import write_dictionary
from bench.datasets import colmap
from bench.datasets.gallery import Gallery
from bench.registry import discovery
from bench.runner.records import Log

Bench = Callable[..., tuple[int, str, str]]
RECONSTRUCTION = ("--task", "reconstruction:inverter=sketch")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Bench:
    """Run `bench` in an empty folder with fake plugins. Returns the exit status, stdout and stderr."""
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def run(*arguments: object) -> tuple[int, str, str]:
        status = cli.main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return status, out, err

    return run


@pytest.mark.slow
def test_run_writes_everything_and_prints_the_table(bench: Bench, images: Path, tmp_path: Path) -> None:
    ldp = f"ldp:epsilon=12,dictionary={write_dictionary(tmp_path)}"
    out = tmp_path / "x"
    defenses, attacks = ("--defense", ldp, "--defense", "none"), ("--attack", "sketch", "--attack", "guess")
    command = ("run", *defenses, *attacks, "--images", images, "--out", out, *RECONSTRUCTION)
    status, shown, err = bench(*command)
    assert status == 0
    assert "ldp:epsilon=12,subset_size=2" in shown
    assert "n/a" in shown
    assert "guess attacks WordSets or Subspaces" in shown
    assert f"written to {out}" in err
    assert "\x1b" not in shown + err
    assert {path.name for path in out.iterdir()} == {
        ".records.jsonl.lock",
        "plan.json",
        "records.jsonl",
        "report.md",
        "report.csv",
        "figures",
        "photographs",
        "reconstructions",
    }
    assert {path.name for path in (out / "figures").iterdir()} == {"0.png.png", "1.png.png"}
    assert "sift upright" in (out / "report.md").read_text()
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    again = bench(*command)
    assert again[:2] == (0, shown)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_default_folder_is_named_after_the_run(bench: Bench, images: Path) -> None:
    assert bench("run", "--defense", "none", "--attack", "sketch", "--images", images)[0] == 0
    assert bench("run", "--defense", "none", "--attack", "sketch", "--images", images, "--seed", 7)[0] == 0
    names = sorted(path.name for path in Path("runs").iterdir())
    assert len(names) == 2
    assert all(name.startswith("none-sketch-") and len(name) == len("none-sketch-") + 8 for name in names)


@pytest.mark.slow
def test_json_prints_the_records(bench: Bench, images: Path) -> None:
    status, shown, _ = bench("run", "--defense", "none", "--attack", "sketch", "--images", images, "--json", "--out", "x")
    assert status == 0
    printed = [json.loads(line) for line in shown.splitlines()]
    assert [record["sample"] for record in printed] == ["0.png", "1.png"]
    assert shown == Path("x/records.jsonl").read_text()


@pytest.mark.slow
def test_failed_photograph_gives_status_1_and_the_others_are_written(bench: Bench, images: Path) -> None:
    (images / "bad.jpg").write_bytes(b"no photograph")
    status, shown, err = bench("run", "--defense", "none", "--attack", "sketch", "--images", images, "--out", "x")
    assert status == 1
    assert "failed: bad.jpg, none: bad.jpg: cannot be read as an image" in err
    assert "bad.jpg" in shown
    assert len(list(Path("x/figures").iterdir())) == 2


RUN = ("run", "--defense", "none", "--attack", "sketch")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "give a command"),
        (("rnu",), "unknown command 'rnu'; did you mean 'run'?"),
        (("run", "--defence", "ldp"), "unknown option '--defence'; did you mean '--defense'?"),
        (("run", "--defence=ldp"), "unknown option '--defence'; did you mean '--defense'?"),
        (("run", "--attack", "sketch"), "--defense is missing"),
        (("run", "--defense", "none"), "--attack is missing"),
        (("run", "--defense"), "--defense: expected one argument"),
        ((*RUN, "more"), "'more' is an unexpected argument"),
        ((*RUN, "--seed", "x"), "--seed: expected a whole number, not 'x'"),
        ((*RUN, "--task", "reconstuction"), "unknown task 'reconstuction'; did you mean 'reconstruction'?"),
        ((*RUN, "--extractor", "sitf"), "unknown extractor 'sitf'; did you mean 'sift'?"),
        ((*RUN, "--extractor", "sift:upright=maybe"), "upright must be true or false"),
        ((*RUN, "--images", "absent"), "absent: no such folder"),
        (("run", "--defense", "lpd", "--attack", "sketch"), "did you mean 'ldp'?"),
        (("run", "--defense", "ldp:epsilom=1", "--attack", "sketch"), "did you mean 'epsilon'?"),
        (("run", "--defense", "ldp:epsilon=-1", "--attack", "sketch"), "epsilon"),
        (("run", "--defense", "none", "--attack", "skecth"), "did you mean 'sketch'?"),
        (("run", "--defense", "none", "--attack", "guess"), "guess attacks WordSets or Subspaces; none releases Descriptors"),
        (("run", "--defense", "ldp:dictionary=absent", "--attack", "sketch"), "absent: no such file"),
        (("list", "defences"), "did you mean 'defenses'?"),
        (("dictionary",), "bench dictionary build"),
        (("dictionary", "biuld"), "did you mean 'dictionary build'?"),
        (("dictionary", "build", "--images", "x"), "--size is missing"),
        (("dictionary", "build", "--images", "absent", "--size", "5", "--out", "k"), "no such folder"),
        (("train", "--images", "x"), "--defense is missing"),
        (("train", "--defense", "lpd", "--images", "x", "--out", "w"), "did you mean 'ldp'?"),
        (("train", "--defense", "ldp", "--images", "absent", "--out", "w"), "no such folder"),
    ],
)
def test_invalid_arguments_give_one_line_and_status_2_and_write_nothing(
    bench: Bench, arguments: tuple[str, ...], complaint: str
) -> None:
    status, shown, err = bench(*arguments)
    assert (status, shown) == (2, "")
    assert complaint in err
    assert err.count("\n") == 1
    assert err.startswith("bench: ")
    assert not list(Path().iterdir())


def test_empty_folder_and_unwritable_folder(bench: Bench, images: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert bench(*RUN, "--images", tmp_path / "empty")[0] == 2
    status, _, err = bench(*RUN, "--images", images, "--out", images / "0.png")
    assert status == 2
    assert "cannot write" in err


@pytest.mark.slow
def test_interrupt_keeps_the_records(bench: Bench, images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views: list[View] = []
    reconstruct = Sketch.reconstruct

    def interrupt(self: Any, view: View, rng: np.random.Generator) -> Any:
        views.append(view)
        if len(views) == 2:
            raise KeyboardInterrupt
        return reconstruct(self, view, rng)

    monkeypatch.setattr(Sketch, "reconstruct", interrupt)
    status, _, err = bench(*RUN, "--images", images, "--out", "x")
    assert status == 130
    assert "run the same command again to continue" in err
    assert len(Path("x/records.jsonl").read_text().splitlines()) == 1
    assert bench(*RUN, "--images", images, "--out", "x")[0] == 0
    assert len(views) == 3  # the first photograph is not computed again


@pytest.mark.parametrize(
    ("error", "complaint"), [(OSError(28, "No space left on device"), "No space left"), (MemoryError(), "memory")]
)
def test_full_disk_and_memory(
    bench: Bench, images: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, complaint: str
) -> None:
    def fail(self: Log, record: Any) -> None:
        raise error

    monkeypatch.setattr(Log, "append", fail)
    status, _, err = bench(*RUN, "--images", images, "--out", "x")
    assert status == 1
    assert complaint in err
    assert "run the same command again" in err
    assert "Traceback" not in err


@pytest.mark.slow
def test_list_shows_plugins_fields_and_the_matrix(bench: Bench) -> None:
    status, shown, _ = bench("list")
    assert status == 0
    for word in (
        "epsilon",
        "default 10.0",
        "subset_size",
        "defenses",
        "higher is better for the attacker",
        "which attack applies",
    ):
        assert word in shown
    assert "guess attacks WordSets or Subspaces; none releases Descriptors" in shown
    only = bench("list", "metrics")[1]
    assert "ssim" in only
    assert "which attack applies" not in only


@pytest.mark.parametrize("arguments", [("--help",), ("run", "--help"), ("dictionary", "build", "--help"), ("--version",)])
def test_help_and_version(bench: Bench, capfd: pytest.CaptureFixture[str], arguments: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit) as ended:
        bench(*arguments)
    assert ended.value.code == 0
    shown = capfd.readouterr().out
    assert "bench run --defense ldp --attack dia" in shown or "--size" in shown or "feature-privacy-bench 0" in shown


@pytest.mark.slow
def test_closed_pipe_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    ended = subprocess.run(
        [sys.executable, "-m", "bench.cli", "list", "metrics"], stdout=writing, stderr=subprocess.PIPE, text=True
    )
    os.close(writing)
    assert ended.returncode == terminal.BROKEN_PIPE
    assert "Traceback" not in ended.stderr
    assert "BrokenPipe" not in ended.stderr


@pytest.mark.slow
def test_shipped_networks_on_one_photograph(bench: Bench, images: Path) -> None:
    """Runs the real plugins if this checkout has their networks."""
    status, shown, err = bench(
        "run", "--defense", "ldp", "--defense", "none", "--attack", "dia", "--images", images, "--out", "x"
    )
    if "no adapted attacker" in err:
        pytest.skip("the networks are not here")
    assert status == 0
    assert "ldp:epsilon=10,subset_size=2" in shown
    assert discovery.load_plugin(discovery.ATTACK, "dia").name() in shown


def test_works_without_a_terminal(tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key not in ("TERM", "COLUMNS")}
    ended = subprocess.run(
        [sys.executable, "-m", "bench.cli", "--version"], capture_output=True, env=environment, cwd=tmp_path, check=True
    )
    assert ended.stderr == b""


@pytest.mark.slow
def test_dataset_is_written_in_a_layout(bench: Bench) -> None:
    tiny = "gallery:width=64,height=48,detail=0.1"
    status, shown, _ = bench("dataset", tiny, "--views", 2, "--queries", 2, "--seed", 3, "--layout", "colmap", "--out", "x")
    assert status == 0
    assert shown == "x: 2 references and 2 queries of gallery, as colmap\n"
    written = colmap.load(Path("x"))
    expected = Gallery(width=64, height=48, detail=0.1, views=2, queries=2, seed=3).scene()
    np.testing.assert_array_equal(written.queries[1].pixels.read(), expected.queries[1].pixels.read())
    mask, drawn = written.queries[1].pixels.foreground(), expected.queries[1].pixels.foreground()
    assert mask is not None
    assert drawn is not None
    np.testing.assert_array_equal(mask, drawn)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("galery", "--layout", "colmap", "--out", "x"), "unknown dataset 'galery'; did you mean 'gallery'"),
        (("gallery", "--layout", "colmap"), "--out is missing"),
        (("gallery", "--out", "x"), "--layout is missing"),
        (("gallery:view=2", "--layout", "colmap", "--out", "x"), "unknown field of gallery 'view'; did you mean 'views'"),
        (("gallery", "--views", "0", "--layout", "colmap", "--out", "x"), "at least one view"),
        (("colmap", "--layout", "colmap", "--out", "x"), "colmap needs path"),
        (("colmap:path=absent", "--layout", "colmap", "--out", "x"), "absent: no such folder"),
        (("colmap:path=a", "--views", "2", "--layout", "colmap", "--out", "x"), "unknown field of colmap 'views'"),
        (
            ("gallery:width=64,height=48,detail=0.1", "--views", "1", "--layout", "colmp", "--out", "x"),
            "--layout colmp: unknown layout; available: aachen, colmap",
        ),
    ],
)
def test_invalid_arguments_of_dataset(bench: Bench, arguments: tuple[str, ...], complaint: str) -> None:
    status, shown, err = bench("dataset", *arguments)
    assert status == 2
    assert shown == ""
    assert complaint in err
    assert not Path("x").exists()


@pytest.mark.slow
def test_leaderboard_of_two_runs(bench: Bench, images: Path, tmp_path: Path) -> None:
    ldp = f"ldp:epsilon=12,dictionary={write_dictionary(tmp_path)}"
    for name, defense in (("one", "none"), ("two", ldp)):
        assert bench("run", "--defense", defense, "--attack", "sketch", "--images", images, "--out", f"runs/{name}")[0] == 0
    status, shown, err = bench("leaderboard", "--results", "runs", "--out", "site")
    assert (status, shown) == (0, "")
    assert err.splitlines()[-1] == "bench: written to site/index.html (comparison groups: 1, experiments: 2, records: 4)"
    written = {path.parent.name for path in Path("site").rglob("*") if path.is_file()}
    assert written == {"site", "tables", "plots", "pictures"}
    assert len(list(Path("site/pictures").iterdir())) == 2 + 4  # photographs once each, and the reconstructions
    page = Path("site/index.html").read_text()
    assert "no adapted attacker was run (dia)" in page
    assert "bench run --defense none --attack sketch --images album --seed 0" in page
    for link in re.findall(r'(?:href|src|data-made|data-original)="([^"#:]+)"', page):
        assert (Path("site") / link).is_file()


@pytest.mark.slow
def test_leaderboard_of_several_results(bench: Bench, images: Path) -> None:
    for seed in (0, 1, 2):
        assert bench(*RUN, "--images", images, "--seed", seed, "--out", f"runs/{seed}")[0] == 0
    results = ("--results", "runs/0", "runs/1", "--results", "runs/2/records.jsonl")
    status, shown, err = bench("leaderboard", *results, "--out", "site")
    assert (status, shown) == (0, "")
    assert "records: 6)" in err
    Path("empty").mkdir()
    status, _, err = bench("leaderboard", "--results", "runs/0", "empty", "--out", "x")
    assert status == 2
    assert "--results empty: there is no record in it" in err
    assert not Path("x").exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--out", "x"), "--results is missing"),
        (("--results", "."), "--out is missing"),
        (("--results", "absent", "--out", "x"), "absent: no such file"),
        (("--results", ".", "--out", "x"), "there is no record in it"),
        (("--result", ".", "--out", "x"), "unknown option '--result'; did you mean '--results'?"),
    ],
)
def test_invalid_arguments_of_leaderboard(bench: Bench, arguments: tuple[str, ...], complaint: str) -> None:
    status, shown, err = bench("leaderboard", *arguments)
    assert (status, shown) == (2, "")
    assert complaint in err
    assert err.count("\n") == 1
    assert not Path("x").exists()


@pytest.mark.slow
def test_leaderboard_needs_a_folder_and_undamaged_records(bench: Bench, images: Path) -> None:
    assert bench(*RUN, "--images", images, "--out", "runs")[0] == 0
    status, _, err = bench("leaderboard", "--results", "runs", "--out", images / "0.png")
    assert status == 2
    assert "cannot write" in err
    with Path("runs/records.jsonl").open("a") as file:
        file.write("damaged\n")
    status, _, err = bench("leaderboard", "--results", "runs", "--out", "x")
    assert status == 2
    assert "line 3: not valid JSON" in err
    assert not Path("x").exists()
