"""Engines execute the jobs of a plan: this process, several processes of this machine, or workers on many machines."""

from __future__ import annotations

from bench.core.errors import UserError, unknown_name
from bench.runner.engines.base import IN_PROCESS, Engine

ENGINES = ("processes", "dask")


def choose_engine(workers: int = 1, kind: str = ENGINES[0], scheduler: str | None = None) -> Engine:
    """Return an engine: `workers` processes of this machine, or the workers of a dask scheduler.

    Raises
    ------
    UserError
        if the kind is unknown, or `workers` or `scheduler` does not suit it.
    """
    if kind not in ENGINES:
        raise unknown_name("engine", kind, ENGINES)
    if kind == "dask":
        from bench.runner.engines.cluster import Cluster

        if scheduler is None:
            raise UserError("--scheduler is missing: --engine dask needs a scheduler's address, such as tcp://127.0.0.1:8786")
        return Cluster(scheduler)
    if scheduler is not None:
        raise UserError("--scheduler requires --engine dask")
    if workers < 1:
        raise UserError(f"--workers must be at least 1, got {workers}")
    if workers == 1:
        return IN_PROCESS
    from bench.runner.engines.processes import Processes

    return Processes(workers)
