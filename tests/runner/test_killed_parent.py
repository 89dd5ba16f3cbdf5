"""Every process that a command starts ends when the command is killed."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fakes import write_album

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs /proc, to see whether a process has ended"),
]
PATIENCE = 60.0  # seconds

WORKERS = """
from pathlib import Path
from fake_plugins.sleeper import Sleeper
from fakes import prepare_plan
from bench.runner import engines, execute
from bench.tasks.reconstruction import Reconstruction
from defenses.none import Undefended

if __name__ == "__main__":
    engine = engines.choose_engine(2)
    plan = prepare_plan([Undefended()], [Sleeper()], "album", task=Reconstruction(inverter="sketch"))
    list(execute.execute([plan], Path("out"), engine))
"""
ATTACK = """
from dataclasses import replace
from fake_plugins.sleeper import Sleeper
from fakes import prepare_plan
from bench.runner.attack_process import execute_in_attack_process
from bench.runner.trial import TrialRunner
from bench.tasks.reconstruction import Reconstruction
from defenses.none import Undefended

if __name__ == "__main__":
    plan = prepare_plan([Undefended()], [Sleeper()], "album", task=Reconstruction(inverter="sketch"))
    TrialRunner(replace(plan, execute=execute_in_attack_process)).execute(plan.experiments[0], plan.samples[0])
"""
EXTRACTION = """
from pathlib import Path
from fake_plugins.sleeper import SleepingExtractor
from bench.cache import feature_cache
from bench.core import threads
from bench.images.scene import File

if __name__ == "__main__":
    threads.limit_threads(2)  # MKL counts physical cores, whatever OMP_NUM_THREADS says
    list(feature_cache.extract_all(SleepingExtractor(), [File(path=path, size=(80, 64)) for path in Path("album").iterdir()]))
"""
TRAINING = """
from fake_plugins.sleeper import sleep
from bench.inversion.process_group import launch

if __name__ == "__main__":
    launch(2, 2, sleep)
"""
DASK = """
import time
from distributed import Client, LocalCluster
from fake_plugins.sleeper import sleep

if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        client.gather(client.map(sleep, range(2)))
"""


@pytest.mark.parametrize(
    ("script", "count"),
    [
        pytest.param(WORKERS, 2, id="workers"),
        *(
            pytest.param(script, count, id=name, marks=pytest.mark.exhaustive)
            for script, count, name in (
                (ATTACK, 1, "attack process"),
                (EXTRACTION, 2, "extraction"),
                (TRAINING, 2, "training"),
                (DASK, 2, "dask"),
            )
        ),
    ],
)
def test_child_processes_end_with_a_killed_command(script: str, count: int, tmp_path: Path) -> None:
    write_album(tmp_path / "album", 18)
    (tmp_path / "command.py").write_text(script)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "command.py"], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True
    ) as command:
        assert command.stdout is not None
        children = [int(command.stdout.readline()) for _ in range(count)]
        try:
            assert len(set(children)) == count
            assert command.pid not in children
            assert all(map(is_running, children))
            command.kill()
            command.wait()
            end = time.monotonic() + PATIENCE
            while any(map(is_running, children)) and time.monotonic() < end:
                time.sleep(0.1)
            assert not any(map(is_running, children))
        finally:
            for child in filter(is_running, children):
                os.kill(child, 9)
            command.kill()


def is_running(process: int) -> bool:
    """Return whether a process exists that has not ended."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ("Z", "X")
