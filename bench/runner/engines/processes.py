"""Processes on one machine that share its cores."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any

from bench.core import environment, threads
from bench.core.errors import UserError
from bench.runner.engines import Engine, Job, run_as_completed, worker, write_message
from bench.runner.trial import Result

if TYPE_CHECKING:
    from bench.runner.plan import Plan

AHEAD = 2  # jobs for each process: one that it does, and one that lies ready


class Processes(Engine):
    """So many processes, each with its share of the cores. Records say how many threads that is."""

    name = "processes"

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._threads = max(1, threads.cores() // workers)
        threads.limit(self._threads)  # here as well, and so in what is started from here

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        return environment.describe(plugins)

    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        # Processes are started afresh: a copy of one that has computed with several threads can hang.
        executor = ProcessPoolExecutor(self._workers, multiprocessing.get_context("spawn"), initializer=_begin)
        plans: set[Plan] = set()

        def submit(job: Job) -> Future[Result]:
            place = job.plan.public.place
            if place is not None and job.plan.needs_map and job.plan not in plans:
                _ = place.map  # made once, before each process reads it
            plans.add(job.plan)
            return executor.submit(worker.carry_out, write_message(job, self._threads))

        try:
            for _, future in run_as_completed(submit, lambda: AHEAD * self._workers, jobs):
                yield future.result()
        except BrokenProcessPool:
            raise UserError("a worker process was ended from outside, perhaps for want of memory; run again to go on") from None
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C, which a terminal sends to all, ends it without a traceback
