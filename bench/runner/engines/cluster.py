"""Engine: workers on many machines, under a scheduler of dask.distributed. `docs/running.md` explains how to start them."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any

from bench.core.errors import UserError
from bench.runner.engines import worker
from bench.runner.engines.base import Engine, Job, run_as_completed, write_message
from bench.runner.trial import Result, build_record

if TYPE_CHECKING:
    from distributed import Client

AHEAD = 2  # submitted jobs per worker: one is running, one is waiting
THREADS = 1  # per worker, as there is one worker per core
PATIENCE = 60.0  # seconds to wait for the scheduler and a first worker


class Cluster(Engine):
    """Executes jobs by the workers of a scheduler. Each job is a dask task; if a worker is lost, others execute its jobs."""

    name = "dask"

    def __init__(self, scheduler: str) -> None:
        self._scheduler = scheduler

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        deadline = time.monotonic() + PATIENCE
        environments: dict[str, Any] = {}
        with self._client() as client:
            from distributed.comm import CommClosedError

            while not environments:  # a worker may end before it has answered, and its nanny starts another
                if (left := deadline - time.monotonic()) <= 0:
                    raise UserError(f"--scheduler {self._scheduler}: the scheduler has no workers; start some")
                with contextlib.suppress(TimeoutError, CommClosedError):
                    client.wait_for_workers(1, timeout=left)
                    several = [address for address, count in client.nthreads().items() if count != 1]
                    if several:
                        raise UserError(f"worker {several[0]} executes several jobs at a time; start workers with --nthreads 1")
                    environments = client.run(worker.describe_environment, list(plugins), THREADS)
        (first, reference), *rest = environments.items()
        for address, other in rest:
            for name in reference:
                if other.get(name) != reference[name]:
                    raise UserError(f"workers differ in {name}: {first} has {reference[name]}, {address} has {other.get(name)}")
        return reference

    def __call__(self, jobs: Iterator[Job]) -> Iterator[Result]:
        from distributed import KilledWorker

        with self._client() as client, client.get_executor() as executor:
            submitted = run_as_completed(
                lambda job: executor.submit(worker.execute_job, write_message(job, THREADS), key=job.name),
                lambda: AHEAD * max(1, len(client.nthreads())),  # workers come and go
                jobs,
            )
            for job, future in submitted:
                try:
                    yield future.result()
                except CancelledError:
                    raise UserError(f"--scheduler {self._scheduler}: lost the connection; run again to continue") from None
                except KilledWorker:
                    reason = "every worker that started this job ended, perhaps for lack of memory"
                    yield Result(record=build_record(job.experiment, job.sample, status="failed", reason=reason))

    def _client(self) -> Client:
        try:
            from distributed import Client
        except ImportError:
            raise UserError("--engine dask needs distributed: pip install 'feature-privacy-bench[dask]'") from None
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # our own errors are enough
        try:
            return Client(self._scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UserError(f"--scheduler {self._scheduler}: no scheduler answers at this address ({error})") from None
