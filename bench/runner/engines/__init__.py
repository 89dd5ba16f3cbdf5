"""Who carries out a plan: this process (`HERE`), several processes of this machine, or workers on many machines.

An engine takes jobs as it has room for them and yields what came of each, in any order. It writes nothing.
"""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from bench.core import environment
from bench.core.errors import UserError, unknown_name
from bench.core.hashing import short_hash
from bench.runner.trial import Result, Trials

if TYPE_CHECKING:
    from bench.images.samples import Sample
    from bench.runner.plan import Experiment, Plan


@dataclass(frozen=True, eq=False)
class Job:
    """One unit of one cell: what a record is made of."""

    plan: Plan
    experiment: Experiment
    sample: Sample

    @property
    def key(self) -> tuple[str, str]:
        """What its record is known by: `run_hash` and unit."""
        return self.experiment.metadata["run_hash"], self.sample.name

    @property
    def name(self) -> str:
        """Its task and a hash of all that its record depends on."""
        return f"{self.plan.task.name()}-{short_hash(self.key)}"


@dataclass(frozen=True, kw_only=True)
class JobMessage:
    """A job as it is sent to another process, which makes the same plan from what was asked."""

    configuration: bytes  # pickled
    key: tuple[str, str]
    threads: int  # to compute with


class Engine(ABC):
    """Carries out jobs."""

    name: ClassVar[str]

    @abstractmethod
    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        """The environment that the jobs will run in, as records hold it.

        Raises
        ------
        UserError
            if there is none, or more than one.
        """

    @abstractmethod
    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        """Take jobs and yield what came of each.

        Raises
        ------
        UserError
            if they cannot be gone on with.
        """


class InProcess(Engine):
    """This process, one job after the other."""

    name = "this process"

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        return environment.describe(plugins)

    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        trials: Trials | None = None
        for job in jobs:
            if trials is None or trials.plan is not job.plan:
                if trials is not None:
                    trials.forget()
                trials = Trials(job.plan)
            yield trials.execute(job.experiment, job.sample)


IN_PROCESS = InProcess()
ENGINES = ("processes", "dask")


def choose_engine(workers: int = 1, kind: str = ENGINES[0], scheduler: str | None = None) -> Engine:
    """The engine of that kind: `workers` processes of this machine, or the workers of a dask scheduler.

    Raises
    ------
    UserError
        if there is no such kind, or it lacks what it needs.
    """
    if kind not in ENGINES:
        raise unknown_name("engine", kind, ENGINES)
    if kind == "dask":
        from bench.runner.engines.cluster import Cluster

        if scheduler is None:
            raise UserError("--scheduler is missing: --engine dask needs the address of one, such as tcp://127.0.0.1:8786")
        return Cluster(scheduler)
    if scheduler is not None:
        raise UserError("--scheduler is for --engine dask")
    if workers < 1:
        raise UserError(f"--workers must be at least 1, got {workers}")
    if workers == 1:
        return IN_PROCESS
    from bench.runner.engines.processes import Processes

    return Processes(workers)


def write_message(job: Job, threads: int) -> JobMessage:
    """The job for another process."""
    return JobMessage(configuration=pickle.dumps(job.plan.configuration), key=job.key, threads=threads)


def run_as_completed(
    submit: Callable[[Job], Future[Result]], room: Callable[[], int], jobs: Iterator[Job]
) -> Iterator[tuple[Job, Future[Result]]]:
    """Submit jobs while there is room for more, and yield each with its result as soon as there is one."""
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
