"""Engine: several processes on one machine, each with a part of its cores."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from bench.core import environment, threads
from bench.core.child_process import end_with_parent
from bench.core.errors import UserError
from bench.runner.engines import worker
from bench.runner.engines.base import Engine, Job, run_as_completed, write_message
from bench.runner.plan import Plan
from bench.runner.trial import Result

AHEAD = 2  # submitted jobs per process: one is running, one is waiting


class Processes(Engine):
    """Executes jobs in several processes, each with an equal number of threads, which records hold."""

    name = "processes"

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._threads = max(1, threads.count_cores() // workers)
        threads.limit_threads(self._threads)  # in this process and in its child processes

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        return environment.describe(plugins)

    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        # Processes are spawned: a fork can hang after a computation with several threads.
        executor = ProcessPoolExecutor(self._workers, multiprocessing.get_context("spawn"), initializer=_start_worker)
        plans: set[Plan] = set()

        def submit(job: Job) -> Future[Result]:
            index = job.plan.public.scene_index
            if index is not None and job.plan.needs_map and job.plan not in plans:
                _ = index.map  # build it once, before the processes read it
            plans.add(job.plan)
            return executor.submit(worker.execute_job, write_message(job, self._threads))

        try:
            for _, future in run_as_completed(submit, lambda: AHEAD * self._workers, jobs):
                yield future.result()
        except BrokenProcessPool:
            raise UserError("a worker process was killed, perhaps for lack of memory; run again to continue") from None
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def _start_worker() -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a terminal sends Ctrl-C to all processes; this one ends without a traceback
