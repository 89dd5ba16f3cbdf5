"""Workers on many machines, under a scheduler of dask.distributed. `docs/sweeps.md` says how to start them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any

from bench.core.errors import UserError
from bench.runner.engines import worker
from bench.runner.engines.base import Engine, Job, run_as_completed, write_message
from bench.runner.trial import Result, build_record

if TYPE_CHECKING:
    from distributed import Client

AHEAD = 2  # jobs for each worker: one that runs, and one that waits
THREADS = 1  # of a worker: there is one for each core
PATIENCE = 60.0  # seconds until the scheduler and a first worker must have answered


class Cluster(Engine):
    """The workers of a scheduler. A job is a dask task, keyed by the job's hash; other workers execute the jobs of a lost one."""

    name = "dask"

    def __init__(self, scheduler: str) -> None:
        self._scheduler = scheduler

    def describe(self, plugins: Iterable[object]) -> dict[str, Any]:
        with self._client() as client:
            try:
                client.wait_for_workers(1, timeout=PATIENCE)
            except TimeoutError:
                raise UserError(f"--scheduler {self._scheduler}: it has no workers") from None
            several = [address for address, count in client.nthreads().items() if count != 1]
            if several:
                raise UserError(f"worker {several[0]} does several jobs at once; start workers with --nthreads 1")
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
                    raise UserError(f"--scheduler {self._scheduler}: the scheduler was lost; run again to go on") from None
                except KilledWorker:
                    reason = "every worker that began this ended, perhaps for want of memory"
                    yield Result(record=build_record(job.experiment, job.sample, status="failed", reason=reason))

    def _client(self) -> Client:
        try:
            from distributed import Client
        except ImportError:
            raise UserError("--engine dask needs distributed: pip install 'feature-privacy-bench[dask]'") from None
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # our errors report what matters
        try:
            return Client(self._scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UserError(f"--scheduler {self._scheduler}: no scheduler answers there ({error})") from None
