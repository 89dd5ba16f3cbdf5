"""Functions of worker processes, which execute the jobs of another process."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Iterable
from typing import Any

from bench.core import environment, threads
from bench.core.errors import UserError
from bench.runner.engines.base import JobMessage
from bench.runner.plan import build_plan
from bench.runner.trial import Result, TrialRunner

_LAST: list[TrialRunner] = []  # the runner whose last sample is in memory
PLANS = 2  # plans in memory: jobs arrive plan by plan, but a repeated job may arrive late


def execute_job(message: JobMessage) -> Result:
    """Execute the job, and return its result.

    Raises
    ------
    UserError
        if source, libraries or photographs differ from those of the sender.
    """
    threads.limit_threads(message.threads)
    runner = _build_runner(message.configuration)
    for last in _LAST:
        if last is not runner:
            last.clear()
    _LAST[:] = [runner]
    run_hash, name = message.key
    for experiment in runner.plan.experiments:
        if experiment.metadata["run_hash"] == run_hash:
            return runner.execute(experiment, next(sample for sample in runner.plan.samples if sample.name == name))
    raise UserError(
        "a worker has other source, libraries or files than the run at its start; "
        "start all workers in one environment and folder, and run again"
    )


def describe_environment(plugins: Iterable[object], count: int) -> dict[str, Any]:
    """Return the environment of this process with `count` threads."""
    threads.limit_threads(count)
    return environment.describe(plugins)


@functools.lru_cache(maxsize=PLANS)
def _build_runner(configuration: bytes) -> TrialRunner:
    return TrialRunner(build_plan(pickle.loads(configuration)))
