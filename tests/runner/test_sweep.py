"""Suites, the engines that carry them out, and what is known of a run from its folder."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fake_plugins.fatal import Fatal
from fake_plugins.guess import Guess
from fake_plugins.painter import Painter
from fakes import FAKES, album, install

from attacks.dia import DIA
from bench import cli
from bench.api import Asset
from bench.codebook.examples import small_dictionary
from bench.core import threads
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.runner import directory, engines, suite
from bench.runner import plan as runner
from bench.runner.plan import Plan
from bench.runner.records import FILE, Log, Record
from bench.runner.status import Count, status
from bench.runner.suite import Suite, grid
from bench.tasks.reconstruction import Reconstruction
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

PAINT = Reconstruction(inverter="painter")
MINE = """
from fake_plugins.painter import Painter
from bench.runner.suite import Suite, grid
from bench.tasks.reconstruction import Reconstruction
from defenses.none import Undefended

PARTS = dict(defenses=[Undefended()], attacks=[Painter()], tasks=[Reconstruction(inverter="painter")])
SUITE = Suite(summary="mine", parts=grid(**PARTS, images="album", seeds=(0, 1)))
TWICE = Suite(summary="the same cells in two parts", parts=(*SUITE.parts, *SUITE.parts))
"""


@pytest.fixture(autouse=True)
def _fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "installed", monkeypatch, FAKES)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    return album(tmp_path / "album", 3)


@pytest.fixture
def small(tmp_path: Path) -> Asset:
    return small_dictionary(tmp_path)


@pytest.fixture
def mine(tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A suite in a file."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine.py").write_text(MINE)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return "elsewhere/mine.py:SUITE"


def bench(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = cli.main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    return status, out, err


def lines(out: Path) -> list[Record]:
    return [json.loads(line) for line in (out / FILE).read_text().splitlines()]


def judged(records: list[Record]) -> list[Any]:
    """What must not depend on who made the records."""
    return [
        {key: value for key, value in record.items() if key not in ("seconds", "environment", "run_hash")} for record in records
    ]


def pictures(out: Path) -> dict[Path, bytes]:
    return {path.relative_to(out): path.read_bytes() for path in out.rglob("reconstructions/**/*.png")}


# ---- suites


def test_grid_is_everything_with_everything() -> None:
    parts = grid(
        defenses=[Undefended(), Affine()], attacks=[Painter(), Guess()], tasks=[PAINT, Reconstruction()], seeds=(0, 1, 2)
    )
    assert len(parts) == 6
    assert [part.seed for part in parts] == [0, 1, 2] * 2
    assert all(len(part.pairs) == 4 for part in parts)
    with pytest.raises(UserError, match="needs an attack"):
        grid(defenses=[Undefended()])


def test_every_suite_of_ours_can_be_planned() -> None:
    """And the full one holds all others."""
    found = {name: suite.find(name) for name in suite.names()}
    assert {"smoke", "paper-table-1", "paper-table-4", "attacks", "full"} <= found.keys()
    assert all(each.parts and each.summary for each in found.values())
    assert len(found["full"].parts) == sum(len(each.parts) for name, each in found.items() if name != "full")
    assert len(runner.planned(found["smoke"].parts[0])) == 9


def test_privacy_and_utility_are_told_of_the_same_queries_and_defenses() -> None:
    few = Gallery(views=2, queries=1, night=0.0, width=64, height=48, detail=0.1)
    attacked, served = (
        [cell for cell in runner.planned(replace(part, dataset=few)).experiments if cell.reason is None]
        for part in suite.find("privacy-utility").parts
    )
    assert [{cell.metadata["task"] for cell in cells} for cells in (attacked, served)] == [{"reconstruction"}, {"localization"}]
    assert len({cell.metadata["dataset"]["hash"] for cell in (*attacked, *served)}) == 1
    adapted = [cell.defense for cell in attacked if isinstance(cell.attack, DIA)]
    assert adapted == [cell.defense for cell in served]


def test_photographs_of_ones_own() -> None:
    assert {part.images for part in suite.find("settings").on("photos").parts} == {"photos"}


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("smok", "unknown suite 'smok'; did you mean 'smoke'"),
        ("absent.py:SUITE", "absent.py: no such file"),
        ("elsewhere/mine.py:OTHER", "has no Suite called 'OTHER'"),
        ("elsewhere/mine.py:PARTS", "has no Suite called 'PARTS'"),
        ("no.such.module:SUITE", "no.such.module cannot be imported: ModuleNotFoundError"),
    ],
)
def test_suites_that_are_not_there(mine: str, name: str, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        suite.find(name)


def test_sweep_of_a_suite_of_ones_own_and_again(mine: str, capfd: pytest.CaptureFixture[str]) -> None:
    done, shown, told = bench(capfd, "sweep", mine)
    assert done == 0
    assert "seed 1" in shown
    out = Path("runs/sweep-mine-SUITE")
    assert f"written to {out}" in told
    assert [(record["seed"], record["unit"]) for record in lines(out)] == [(s, f"{u}.png") for s in (0, 1) for u in range(3)]
    before = (out / FILE).read_bytes()
    assert bench(capfd, "sweep", mine)[:2] == (0, shown)
    assert (out / FILE).read_bytes() == before
    assert bench(capfd, "sweep", "elsewhere/mine.py:TWICE", "--out", out)[0] == 0  # cells that two parts have
    assert (out / FILE).read_bytes() == before
    assert "mine" not in bench(capfd, "sweep")[1]  # the list is of ours


# ---- engines


def test_engines_are_chosen_with_what_they_need() -> None:
    assert engines.choose_engine() is engines.IN_PROCESS
    for asked, complaint in [
        ((0,), "--workers must be at least 1"),
        ((1, "dusk"), "unknown engine 'dusk'; did you mean 'dask'"),
        ((1, "dask"), "--scheduler is missing"),
        ((1, "processes", "tcp://x:1"), "--scheduler is for --engine dask"),
    ]:
        with pytest.raises(UserError, match=complaint):
            engines.choose_engine(*asked)


def test_processes_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is started from here is limited, whichever library it computes with."""
    for variable in threads.VARIABLES:
        monkeypatch.setenv(variable, "7")
    monkeypatch.setattr(threads, "cores", lambda: 4)
    threads.limit.cache_clear()
    engine = engines.choose_engine(2)
    assert engine.describe([])["threads"] == 2
    assert {os.environ[variable] for variable in threads.VARIABLES} == {"2"}
    counted = "import numpy, torch, threadpoolctl; print({p['num_threads'] for p in threadpoolctl.threadpool_info()})"
    assert subprocess.check_output([sys.executable, "-c", counted], text=True).strip() in ("{2}", "{1, 2}", "{1}")
    threads.limit.cache_clear()


def test_a_process_that_is_killed_stops_the_run_and_the_rest_is_done_next_time(images: Path, tmp_path: Path) -> None:
    engine = engines.choose_engine(2)
    marker = tmp_path / "killed"
    plan = runner.prepare([Undefended()], [Painter(), Fatal(marker=str(marker))], images, task=PAINT)
    with pytest.raises(UserError, match=r"ended from outside.*run again to go on"):
        list(runner.execute([plan], tmp_path / "out", engine))
    assert marker.exists()
    assert len(list(runner.execute([plan], tmp_path / "out", engine))) == 6
    keys = [(record["cell_id"], record["unit"]) for record in lines(tmp_path / "out")]
    assert len(keys) == len(set(keys)) == 6


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Two workers, processes that know the made-up plugins."""
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")
    with pytest.MonkeyPatch.context() as patch:
        install(tmp_path_factory.mktemp("workers"), patch, FAKES)
        started = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50)
    with started:
        yield started


def test_two_workers_one_of_them_killed(images: Path, small: Asset, tmp_path: Path, cluster: Any) -> None:
    """Nothing is lost, nothing is double, and records and pictures are those of one process."""
    (images / "bad.jpg").write_bytes(b"no photograph")
    marker = tmp_path / "killed"
    attacks = [Painter(), Guess(), Fatal(marker=str(marker))]
    parts = grid(defenses=[LDP(epsilon=8, dictionary=small), Undefended()], attacks=attacks, tasks=[PAINT], images=images)
    engine = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address)
    before = {worker.pid for worker in cluster.workers.values()}
    plans = [runner.prepared(part, engine.describe) for part in parts]
    found = runner.sort_records(plans, runner.execute(plans, tmp_path / "many", engine))
    assert marker.exists()
    assert before != {worker.pid for worker in cluster.workers.values()}  # one of them is gone
    keys = [(record["run_hash"], record["unit"]) for record in lines(tmp_path / "many")]
    assert len(keys) == len(set(keys)) == len(plans[0])
    alone = [runner.prepared(part) for part in parts]
    assert judged(found) == judged(runner.sort_records(alone, runner.execute(alone, tmp_path / "one")))
    assert {record["status"] for record in found} == {"ok", "failed", "n/a"}
    assert pictures(tmp_path / "many") == pictures(tmp_path / "one") != {}
    assert {record["environment"]["threads"] for record in found} == {1}
    again = list(runner.execute(plans, tmp_path / "many", engine))  # only what failed is tried again
    assert len(lines(tmp_path / "many")) == len(keys) + sum(record["status"] == "failed" for record in again)


def test_what_kills_every_worker_is_a_failed_record(images: Path, tmp_path: Path, cluster: Any) -> None:
    engine = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address)
    part = grid(defenses=[Undefended()], attacks=[Fatal(), Painter()], tasks=[PAINT], images=[images / "0.png"])[0]
    plan = runner.prepared(part, engine.describe)
    fatal, painter = runner.sort_records([plan], runner.execute([plan], tmp_path / "out", engine))
    assert (fatal["status"], painter["status"]) == ("failed", "ok")
    assert "every worker that began this ended" in fatal["reason"]


def test_a_worker_with_other_files_is_refused(images: Path, tmp_path: Path, cluster: Any) -> None:
    """It would make other records."""
    engine = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address)
    part = grid(defenses=[Undefended()], attacks=[Painter()], tasks=[PAINT], images=images)[0]
    plan = runner.prepared(part, engine.describe)
    album(images, 4)
    with pytest.raises(UserError, match="other source, libraries or files"):
        list(runner.execute([plan], tmp_path / "out", engine))


def test_a_scheduler_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")
    from bench.runner.engines import cluster as module

    monkeypatch.setattr(module, "PATIENCE", 0.2)
    with pytest.raises(UserError, match="no scheduler answers there"):
        engines.choose_engine(kind="dask", scheduler="tcp://127.0.0.1:9").describe([])


# ---- what a folder tells


@pytest.fixture
def plan(images: Path) -> Plan:
    return runner.prepare([Undefended(), Affine(lifting="random")], [Painter(), Guess()], images, task=PAINT)


def test_status_from_nothing_to_the_end(plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(UserError, match="nothing was run there"):
        status(out)
    running: Iterator[Record] = runner.execute([plan], out)
    next(running)  # what does not apply
    begun = status(out)
    assert (begun.count, begun.explain_not_applicable, begun.alive) == (Count(missing=9), 1, True)
    next(running)
    next(running)
    middle = status(out)
    assert (middle.count, middle.alive) == (Count(done=2, missing=7), True)
    assert middle.writer is not None
    assert middle.writer["pid"] == os.getpid()
    running.close()  # type: ignore[attr-defined]
    ended = status(out)
    assert (ended.count, ended.writer, ended.alive) == (Count(done=2, missing=7), None, False)
    list(runner.execute([plan], out))
    assert status(out).count == Count(done=9)


def test_what_is_in_hand_is_running_and_what_a_killed_process_left_is_not(plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code = """
import sys, time
from pathlib import Path
from fake_plugins.painter import Painter
from bench import runner
from bench.tasks.reconstruction import Reconstruction
from defenses.none import Undefended

def forever(self, view, rng):
    print("begun", flush=True)
    time.sleep(1000)

Painter.reconstruct = forever
plan = runner.prepare([Undefended()], [Painter()], "album", task=Reconstruction(inverter="painter"))
list(runner.execute([plan], Path("out")))
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        found = status(out)
        assert (found.count, found.alive) == (Count(running=1, missing=2), True)
        with pytest.raises(UserError, match=r"another process is writing to .*records\.jsonl"):
            list(runner.execute([plan], out))
        process.kill()
    dead = status(out)
    assert (dead.count, dead.alive) == (Count(missing=3), False)
    assert dead.writer is not None
    assert dead.writer["pid"] == process.pid
    assert len(list(runner.execute([plan], out))) == 10  # the lock is gone with its owner
    assert not (out / directory.RUNNING).exists()


def test_failed_units_and_records_of_other_runs_are_told_apart(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (images / "bad.jpg").write_bytes(b"no photograph")
    out = tmp_path / "runs" / "sweep-x"
    common = (
        "--defense",
        "none",
        "--attack",
        "painter",
        "--images",
        images,
        "--out",
        out,
        "--task",
        "reconstruction:inverter=painter",
    )
    assert bench(capfd, "run", *common)[0] == 1
    assert bench(capfd, "run", *common, "--seed", 1)[0] == 1
    shown = bench(capfd, "status", "--results", out)
    assert shown[0] == 0
    assert "3 done, 0 running, 1 failed, 0 missing; 4 records of other runs" in shown[1]
    assert "painter" in shown[1]
    overview = bench(capfd, "status")[1]
    assert "x" in overview
    assert "3 done" in overview
    assert bench(capfd, "status", "x")[1].count("painter") == 1  # as a suite's name
    assert bench(capfd, "status", "absent")[0] == 2
    assert bench(capfd, "status", "x", "--results", out)[0] == 2


def test_a_full_disk_loses_nothing_that_was_written(
    mine: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    written, append = [], Log.append

    def full(self: Log, record: Record) -> None:
        if len(written) == 4:
            raise OSError(28, "No space left on device")
        written.append(record)
        append(self, record)

    with monkeypatch.context() as small_disk:
        small_disk.setattr(Log, "append", full)
        ended, _, told = bench(capfd, "sweep", mine)
    assert ended == 1
    assert "No space left" in told
    assert "run the same command again" in told
    out = Path("runs/sweep-mine-SUITE")
    assert lines(out) == written
    assert bench(capfd, "sweep", mine)[0] == 0
    assert lines(out)[:4] == written
    assert len(lines(out)) == 6


def test_interrupted_sweep_goes_on(mine: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    asked: list[int] = []
    kept: Callable[..., Any] = Painter.reconstruct

    def interrupted(self: Any, view: Any, rng: Any) -> Any:
        asked.append(1)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return kept(self, view, rng)

    monkeypatch.setattr(Painter, "reconstruct", interrupted)
    ended, _, told = bench(capfd, "sweep", mine)
    assert ended == 130
    assert "run the same command again to go on" in told
    assert status(Path("runs/sweep-mine-SUITE")).count == Count(done=2, missing=4)
    assert bench(capfd, "sweep", mine)[0] == 0
    assert len(asked) == 7
    assert isinstance(suite.find(mine), Suite)


# ---- the documentation

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "sweeps.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("line", re.findall(r"^bench (.+?)(?:\s+#.*)?$", DOCUMENT, re.MULTILINE))
def test_commands_of_the_documentation_are_understood(line: str) -> None:
    args, extra = cli.parser().parse_known_args(line.split())
    assert not extra
    assert all(getattr(args, option) for option in args.required)


def test_suite_of_the_documentation(images: Path) -> None:
    code = next(block for block in re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL) if "SUITE" in block)
    names: dict[str, Any] = {}
    exec(code, names)
    parts = names["SUITE"].parts
    assert [part.seed for part in parts] == [0, 1, 2]
    assert all(len(part.pairs) == 8 for part in parts)
