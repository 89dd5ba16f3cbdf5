"""Suites, the engines that execute them, and the status of a run from its folder."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from fake_plugins.fatal import Fatal
from fake_plugins.guess import Guess
from fake_plugins.sketch import Sketch
from fakes import FAKES, check_plan, install_plugins, prepare_plan, write_album

from attacks.dia import DIA
from bench import cli
from bench.core import threads
from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.runner import directory, engines, execute, suite
from bench.runner.plan import Plan, build_plan
from bench.runner.records import FILE, Log, Record
from bench.runner.status import Count, read_status
from bench.runner.suite import Suite, grid
from bench.settings import Asset
from bench.tasks.reconstruction import Reconstruction
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

RECONSTRUCTION = Reconstruction(inverter="sketch")
MINE = """
from fake_plugins.sketch import Sketch
from bench.runner.suite import Suite, grid
from bench.tasks.reconstruction import Reconstruction
from defenses.none import Undefended

PARTS = dict(defenses=[Undefended()], attacks=[Sketch()], tasks=[Reconstruction(inverter="sketch")])
SUITE = Suite(summary="mine", parts=grid(**PARTS, images="album", seeds=(0, 1)))
TWICE = Suite(summary="the same experiments in two parts", parts=(*SUITE.parts, *SUITE.parts))
"""


@pytest.fixture(autouse=True)
def _fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    return write_album(tmp_path / "album", 3)


@pytest.fixture
def mine(tmp_path: Path, images: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A suite in a file."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine.py").write_text(MINE)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return "elsewhere/mine.py:SUITE"


def bench(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    read_status = cli.main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    return read_status, out, err


def read_records(out: Path) -> list[Record]:
    return [json.loads(line) for line in (out / FILE).read_text().splitlines()]


def select_engine_independent(records: list[Record]) -> list[Any]:
    """Return the records without the keys that depend on the engine."""
    return [
        {key: value for key, value in record.items() if key not in ("seconds", "environment", "run_hash", "digest")}
        for record in records
    ]


def read_reconstructions(out: Path) -> dict[Path, bytes]:
    return {path.relative_to(out): path.read_bytes() for path in out.rglob("reconstructions/**/*.png")}


# ---- suites


def test_grid_is_the_full_product() -> None:
    parts = grid(
        defenses=[Undefended(), Affine()], attacks=[Sketch(), Guess()], tasks=[RECONSTRUCTION, Reconstruction()], seeds=(0, 1, 2)
    )
    assert len(parts) == 6
    assert [part.seed for part in parts] == [0, 1, 2] * 2
    assert all(len(part.pairs) == 4 for part in parts)
    with pytest.raises(UserError, match="needs an attack"):
        grid(defenses=[Undefended()])


@pytest.mark.slow
def test_every_shipped_suite_can_be_planned() -> None:
    """The full suite contains all others."""
    suites = {name: suite.find(name) for name in suite.list_suites()}
    assert {"smoke", "paper-table-1", "paper-table-4", "attacks", "full"} <= suites.keys()
    assert all(each.parts and each.summary for each in suites.values())
    assert len(suites["full"].parts) == sum(len(each.parts) for name, each in suites.items() if name != "full")
    assert len(build_plan(suites["smoke"].parts[0])) == 12


@pytest.mark.slow
def test_privacy_and_utility_use_the_same_queries_and_defenses() -> None:
    few = Gallery(views=2, queries=1, night=0.0, width=64, height=48, detail=0.1)
    attacked, localized = (
        [experiment for experiment in build_plan(replace(part, dataset=few)).experiments if experiment.reason is None]
        for part in suite.find("privacy-utility").parts
    )
    assert [{experiment.metadata["task"] for experiment in experiments} for experiments in (attacked, localized)] == [
        {"reconstruction"},
        {"localization"},
    ]
    assert len({experiment.metadata["dataset"]["hash"] for experiment in (*attacked, *localized)}) == 1
    dia_defenses = [experiment.defense for experiment in attacked if isinstance(experiment.attack, DIA)]
    assert dia_defenses == [experiment.defense for experiment in localized]


def test_suite_with_other_images() -> None:
    assert {part.images for part in suite.find("settings").with_images("photos").parts} == {"photos"}


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
def test_missing_suites(mine: str, name: str, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        suite.find(name)


@pytest.mark.slow
def test_sweep_of_a_user_suite_twice(mine: str, capfd: pytest.CaptureFixture[str]) -> None:
    exit_code, output, messages = bench(capfd, "sweep", mine)
    assert exit_code == 0
    assert "seed 1" in output
    out = Path("runs/sweep-mine-SUITE")
    assert f"written to {out}" in messages
    assert [(record["seed"], record["sample"]) for record in read_records(out)] == [
        (s, f"{u}.png") for s in (0, 1) for u in range(3)
    ]
    before = (out / FILE).read_bytes()
    assert bench(capfd, "sweep", mine)[:2] == (0, output)
    assert (out / FILE).read_bytes() == before
    assert bench(capfd, "sweep", "elsewhere/mine.py:TWICE", "--out", out)[0] == 0  # experiments of two parts
    assert (out / FILE).read_bytes() == before
    assert "mine" not in bench(capfd, "sweep")[1]  # only shipped suites are listed


# ---- engines


def test_engines_require_their_options() -> None:
    assert engines.choose_engine() is engines.IN_PROCESS
    for arguments, complaint in [
        ((0,), "--workers must be at least 1"),
        ((1, "dusk"), "unknown engine 'dusk'; did you mean 'dask'"),
        ((1, "dask"), "--scheduler is missing"),
        ((1, "processes", "tcp://x:1"), "--scheduler requires --engine dask"),
    ]:
        with pytest.raises(UserError, match=complaint):
            engines.choose_engine(*arguments)


@pytest.mark.slow
def test_processes_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Child processes are limited, for each numerical library."""
    for variable in threads.VARIABLES:
        monkeypatch.setenv(variable, "7")
    monkeypatch.setattr(threads, "count_cores", lambda: 4)
    threads.limit_threads.cache_clear()
    engine = engines.choose_engine(2)
    assert engine.describe([])["threads"] == 2
    assert {os.environ[variable] for variable in threads.VARIABLES} == {"2"}
    code = "import numpy, torch, threadpoolctl; print({p['num_threads'] for p in threadpoolctl.threadpool_info()})"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() in ("{2}", "{1, 2}", "{1}")
    threads.limit_threads.cache_clear()


@pytest.mark.slow
def test_a_killed_process_stops_the_run_and_the_next_run_resumes(images: Path, tmp_path: Path) -> None:
    engine = engines.choose_engine(2)
    marker = tmp_path / "killed"
    plan = prepare_plan([Undefended()], [Sketch(), Fatal(marker=str(marker))], images, task=RECONSTRUCTION)
    with pytest.raises(UserError, match=r"was killed.*run again to continue"):
        list(execute.execute([plan], tmp_path / "out", engine))
    assert marker.exists()
    assert len(list(execute.execute([plan], tmp_path / "out", engine))) == 6
    keys = [(record["experiment_id"], record["sample"]) for record in read_records(tmp_path / "out")]
    assert len(keys) == len(set(keys)) == 6


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Two worker processes that have the fake plugins. Their nannies start new ones, however often these are killed."""
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")
    import dask

    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1 day"}):
        # LocalCluster closes a nanny whose worker is lost both now and so long after an earlier loss (15 s by default).
        with pytest.MonkeyPatch.context() as patch:
            install_plugins(tmp_path_factory.mktemp("workers"), patch, FAKES)
            local_cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50)
        with local_cluster:
            yield local_cluster


@pytest.mark.exhaustive
def test_two_workers_one_of_them_killed(images: Path, small: Asset, tmp_path: Path, cluster: Any) -> None:
    """No record is lost or duplicated, and records and reconstructions equal those of one process."""
    (images / "bad.jpg").write_bytes(b"no photograph")
    marker = tmp_path / "killed"
    attacks = [Sketch(), Guess(), Fatal(marker=str(marker))]
    parts = grid(
        defenses=[LDP(epsilon=8, dictionary=small), Undefended()], attacks=attacks, tasks=[RECONSTRUCTION], images=images
    )
    engine = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address)
    before = {worker.pid for worker in cluster.workers.values()}
    plans = [check_plan(build_plan(part, engine.describe)) for part in parts]
    records = execute.sort_records(plans, execute.execute(plans, tmp_path / "many", engine))
    assert marker.exists()
    assert before != {worker.pid for worker in cluster.workers.values()}  # one of them has ended
    keys = [(record["run_hash"], record["sample"]) for record in read_records(tmp_path / "many")]
    assert len(keys) == len(set(keys)) == len(plans[0])
    single_plans = [check_plan(build_plan(part)) for part in parts]
    assert select_engine_independent(records) == select_engine_independent(
        execute.sort_records(single_plans, execute.execute(single_plans, tmp_path / "one"))
    )
    assert {record["status"] for record in records} == {"ok", "failed", "n/a"}
    assert read_reconstructions(tmp_path / "many") == read_reconstructions(tmp_path / "one") != {}
    assert {record["environment"]["threads"] for record in records} == {1}
    again = list(execute.execute(plans, tmp_path / "many", engine))  # only failed samples run again
    assert len(read_records(tmp_path / "many")) == len(keys) + sum(record["status"] == "failed" for record in again)


@pytest.mark.slow
def test_an_attack_that_kills_every_worker_is_a_failed_record(images: Path, tmp_path: Path, cluster: Any) -> None:
    engine = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address)
    part = grid(defenses=[Undefended()], attacks=[Fatal(), Sketch()], tasks=[RECONSTRUCTION], images=[images / "0.png"])[0]
    plan = check_plan(build_plan(part, engine.describe))
    fatal, sketch = execute.sort_records([plan], execute.execute([plan], tmp_path / "out", engine))
    assert (fatal["status"], sketch["status"]) == ("failed", "ok")
    assert "every worker that started this job ended" in fatal["reason"]


@pytest.mark.slow
def test_a_worker_with_other_files_is_refused(images: Path, tmp_path: Path, cluster: Any) -> None:
    """Its records would differ."""
    engine = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address)
    part = grid(defenses=[Undefended()], attacks=[Sketch()], tasks=[RECONSTRUCTION], images=images)[0]
    plan = check_plan(build_plan(part, engine.describe))
    write_album(images, 4)
    with pytest.raises(UserError, match="other source, libraries or files"):
        list(execute.execute([plan], tmp_path / "out", engine))


@dataclass(frozen=True)
class EndsReader:
    """Kills the first process that unpickles it. Later ones receive an attack."""

    marker: Path

    def __reduce__(self) -> tuple[Any, ...]:
        return _end_first_process, (self.marker,)


def _end_first_process(marker: Path) -> Sketch:
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Sketch()


@pytest.mark.slow
def test_a_worker_that_ends_before_it_is_described_is_started_again(tmp_path: Path, cluster: Any) -> None:
    marker = tmp_path / "ended"
    described = engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address).describe([EndsReader(marker)])
    assert marker.exists()
    assert described == engines.choose_engine(kind="dask", scheduler=cluster.scheduler_address).describe([Sketch()])


@pytest.mark.slow
def test_missing_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")
    from bench.runner.engines import cluster as module

    monkeypatch.setattr(module, "PATIENCE", 0.2)
    with pytest.raises(UserError, match="no scheduler answers at this address"):
        engines.choose_engine(kind="dask", scheduler="tcp://127.0.0.1:9").describe([])


# ---- the status of a run


@pytest.fixture
def plan(images: Path) -> Plan:
    return prepare_plan([Undefended(), Affine(lifting="random")], [Sketch(), Guess()], images, task=RECONSTRUCTION)


@pytest.mark.slow
def test_status_from_start_to_end(plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(UserError, match="nothing was run there"):
        read_status(out)
    running: Iterator[Record] = execute.execute([plan], out)
    next(running)  # the pair that does not apply
    first = read_status(out)
    assert (first.count, first.inapplicable, first.alive) == (Count(missing=9), 1, True)
    next(running)
    next(running)
    middle = read_status(out)
    assert (middle.count, middle.alive) == (Count(done=2, missing=7), True)
    assert middle.writer is not None
    assert middle.writer["pid"] == os.getpid()
    running.close()  # type: ignore[attr-defined]
    ended = read_status(out)
    assert (ended.count, ended.writer, ended.alive) == (Count(done=2, missing=7), None, False)
    list(execute.execute([plan], out))
    assert read_status(out).count == Count(done=9)


@pytest.mark.slow
def test_samples_in_progress_are_running_until_their_process_is_killed(plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code = """
import sys, time
from pathlib import Path
from fake_plugins.sketch import Sketch
from fakes import prepare_plan
from bench.runner import execute
from bench.tasks.reconstruction import Reconstruction
from defenses.none import Undefended

def forever(self, view, rng):
    print("begun", flush=True)
    time.sleep(1000)

Sketch.reconstruct = forever
plan = prepare_plan([Undefended()], [Sketch()], "album", task=Reconstruction(inverter="sketch"))
list(execute.execute([plan], Path("out")))
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        current = read_status(out)
        assert (current.count, current.alive) == (Count(running=1, missing=2), True)
        with pytest.raises(UserError, match=r"another process is writing to .*records\.jsonl"):
            list(execute.execute([plan], out))
        process.kill()
    dead = read_status(out)
    assert (dead.count, dead.alive) == (Count(missing=3), False)
    assert dead.writer is not None
    assert dead.writer["pid"] == process.pid
    assert len(list(execute.execute([plan], out))) == 10  # the lock was released with its process
    assert not (out / directory.RUNNING).exists()


@pytest.mark.slow
def test_failed_samples_and_records_of_other_runs_are_counted_separately(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (images / "bad.jpg").write_bytes(b"no photograph")
    out = tmp_path / "runs" / "sweep-x"
    common = (
        "--defense",
        "none",
        "--attack",
        "sketch",
        "--images",
        images,
        "--out",
        out,
        "--task",
        "reconstruction:inverter=sketch",
    )
    assert bench(capfd, "run", *common)[0] == 1
    assert bench(capfd, "run", *common, "--seed", 1)[0] == 1
    result = bench(capfd, "status", "--results", out)
    assert result[0] == 0
    assert "3 done, 0 running, 1 failed, 0 missing; 4 records of other runs" in result[1]
    assert "sketch" in result[1]
    overview = bench(capfd, "status")[1]
    assert "x" in overview
    assert "3 done" in overview
    assert bench(capfd, "status", "x")[1].count("sketch") == 1  # as a suite's name
    assert bench(capfd, "status", "absent")[0] == 2
    assert bench(capfd, "status", "x", "--results", out)[0] == 2


@pytest.mark.slow
def test_a_full_disk_loses_no_written_record(
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
        exit_code, _, messages = bench(capfd, "sweep", mine)
    assert exit_code == 1
    assert "No space left" in messages
    assert "run the same command again" in messages
    out = Path("runs/sweep-mine-SUITE")
    assert read_records(out) == written
    assert bench(capfd, "sweep", mine)[0] == 0
    assert read_records(out)[:4] == written
    assert len(read_records(out)) == 6


@pytest.mark.slow
def test_interrupted_sweep_resumes(mine: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    calls: list[int] = []
    reconstruct: Callable[..., Any] = Sketch.reconstruct

    def interrupted(self: Any, view: Any, rng: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return reconstruct(self, view, rng)

    monkeypatch.setattr(Sketch, "reconstruct", interrupted)
    exit_code, _, messages = bench(capfd, "sweep", mine)
    assert exit_code == 130
    assert "run the same command again to continue" in messages
    assert read_status(Path("runs/sweep-mine-SUITE")).count == Count(done=2, missing=4)
    assert bench(capfd, "sweep", mine)[0] == 0
    assert len(calls) == 7
    assert isinstance(suite.find(mine), Suite)


# ---- the documentation

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "running.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("line", re.findall(r"^bench (.+?)(?:\s+#.*)?$", DOCUMENT.replace("\\\n", ""), re.MULTILINE))
def test_commands_of_the_documentation_parse(line: str) -> None:
    args, extra = cli.build_parser().parse_known_args(line.split())
    assert not extra
    assert all(getattr(args, option) for option in args.required)


@pytest.mark.slow
def test_the_scheduler_of_the_documentation_listens_on_loopback_alone(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")
    if not Path("/proc/net/tcp").is_file():
        pytest.skip("needs /proc, to see where a process listens")
    (line,) = re.findall(r"^dask scheduler (--.*127\.0\.0\.1.*)$", DOCUMENT.partition("### Several machines")[0], re.MULTILINE)
    (worker,) = re.findall(r"^dask worker (.*)$", DOCUMENT.partition("### Several machines")[0], re.MULTILINE)
    assert "--host 127.0.0.1" in worker
    assert "--dashboard-address 127.0.0.1:" in worker
    assert find_listeners(line) == {"0100007F"}  # 127.0.0.1
    assert find_listeners(line.replace("--dashboard-address 127.0.0.1:0", "--dashboard-address :0")) != {"0100007F"}


def find_listeners(options: str) -> set[str]:
    """Start a scheduler of dask with these options and a free port, and return the addresses on which it listens."""
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", *options.replace("8786", "0").split()]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as scheduler:
        assert scheduler.stderr is not None
        assert any("dashboard at" in line for line in scheduler.stderr)
        links = (os.readlink(link) for link in Path(f"/proc/{scheduler.pid}/fd").iterdir())
        sockets = {link.removeprefix("socket:[").removesuffix("]") for link in links if link.startswith("socket:")}
        tables = (Path(f"/proc/{scheduler.pid}/net/{table}") for table in ("tcp", "tcp6"))
        rows = [row.split() for table in tables if table.is_file() for row in table.read_text().splitlines()[1:]]
        scheduler.kill()
    return {row[1].partition(":")[0] for row in rows if row[9] in sockets and row[3] == "0A"}  # 0A: it listens


def test_suite_of_the_documentation(images: Path) -> None:
    code = next(block for block in re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL) if "SUITE" in block)
    names: dict[str, Any] = {}
    exec(code, names)
    parts = names["SUITE"].parts
    assert [part.seed for part in parts] == [0, 1, 2]
    assert all(len(part.pairs) == 8 for part in parts)
