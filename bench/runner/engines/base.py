"""The interface of engines, and the engine that executes jobs in this process.

An engine takes jobs when a worker is free and yields their results in any order. It writes no file.
"""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from typing import Any, ClassVar

from bench.core import environment
from bench.core.hashing import short_hash
from bench.images.samples import Sample
from bench.runner.plan import Experiment, Plan
from bench.runner.trial import Result, TrialRunner


@dataclass(frozen=True, eq=False)
class Job:
    """One sample of one experiment, which gives one record."""

    plan: Plan
    experiment: Experiment
    sample: Sample

    @property
    def key(self) -> tuple[str, str]:
        """The key of its record: `run_hash` and sample."""
        return self.experiment.metadata["run_hash"], self.sample.name

    @property
    def name(self) -> str:
        """Name of the task, and a hash of all inputs of the record."""
        return f"{self.plan.task.name()}-{short_hash(self.key)}"


@dataclass(frozen=True, kw_only=True)
class JobMessage:
    """A job as a message to another process, which builds the same plan from the configuration."""

    configuration: bytes  # pickled
    key: tuple[str, str]
    threads: int  # number of threads of the computation


class Engine(ABC):
    """Executes jobs."""

    name: ClassVar[str]

    @abstractmethod
    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        """Return the environment that executes the jobs, in the form of records.

        Raises
        ------
        UserError
            if there is no worker, or the environments of the workers differ.
        """

    @abstractmethod
    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        """Take jobs and yield their results.

        Raises
        ------
        UserError
            if the engine cannot continue.
        """


class InProcess(Engine):
    """Executes jobs in this process, in order."""

    name = "this process"

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        return environment.describe(plugins)

    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        runner: TrialRunner | None = None
        for job in jobs:
            if runner is None or runner.plan is not job.plan:
                if runner is not None:
                    runner.clear()
                runner = TrialRunner(job.plan)
            yield runner.execute(job.experiment, job.sample)


IN_PROCESS = InProcess()


def write_message(job: Job, threads: int) -> JobMessage:
    """Return the job as a message for another process."""
    return JobMessage(configuration=pickle.dumps(job.plan.configuration), key=job.key, threads=threads)


def run_as_completed(
    submit: Callable[[Job], Future[Result]], room: Callable[[], int], jobs: Iterator[Job]
) -> Iterator[tuple[Job, Future[Result]]]:
    """Submit jobs while fewer than `room()` are waiting, and yield each job with its future when it is done."""
    waiting: dict[Future[Result], Job] = {}
    try:
        for job in jobs:
            waiting[submit(job)] = job
            while len(waiting) >= room():
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future
    finally:
        for future in waiting:
            future.cancel()
