"""Processes on one machine that share its cores."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from bench.core import environment, threads
from bench.core.errors import UserError
from bench.runner.engines import worker
from bench.runner.engines.base import Engine, Job, run_as_completed, write_message
from bench.runner.plan import Plan
from bench.runner.trial import Result

AHEAD = 2  # jobs for each process: one that runs, and one that waits


class Processes(Engine):
    """Several processes, each with its part of the cores. Records hold the number of threads."""

    name = "processes"

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._threads = max(1, threads.count_cores() // workers)
        threads.limit_threads(self._threads)  # in this process too, and so in those that it starts

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        return environment.describe(plugins)

    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        # Processes are spawned: a fork of one that has computed with several threads can hang.
        executor = ProcessPoolExecutor(self._workers, multiprocessing.get_context("spawn"), initializer=_start_worker)
        plans: set[Plan] = set()

        def submit(job: Job) -> Future[Result]:
            index = job.plan.public.scene_index
            if index is not None and job.plan.needs_map and job.plan not in plans:
                _ = index.map  # built once, before each process reads it
            plans.add(job.plan)
            return executor.submit(worker.execute_job, write_message(job, self._threads))

        try:
            for _, future in run_as_completed(submit, lambda: AHEAD * self._workers, jobs):
                yield future.result()
        except BrokenProcessPool:
            raise UserError("a worker process was ended from outside, perhaps for want of memory; run again to go on") from None
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C, which a terminal sends to all, ends it without a traceback
