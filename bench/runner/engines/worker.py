"""What runs in a process that carries out jobs of another."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Iterable
from typing import Any

from bench.core import environment, threads
from bench.core.errors import UserError
from bench.runner import plan
from bench.runner.engines import JobMessage
from bench.runner.trial import Result, Trials

_LAST: list[Trials] = []  # whose last unit is kept
PLANS = 2  # that are kept: jobs come plan by plan, but one that was lost may come late


def carry_out(letter: JobMessage) -> Result:
    """Do the job.

    Raises
    ------
    UserError
        if this process would do another: its source, its libraries or its photographs are not those of the sender.
    """
    threads.limit(letter.threads)
    trials = _trials(letter.configuration)
    for last in _LAST:
        if last is not trials:
            last.forget()
    _LAST[:] = [trials]
    run_hash, name = letter.key
    for cell in trials.plan.experiments:
        if cell.metadata["run_hash"] == run_hash:
            return trials.execute(cell, next(unit for unit in trials.plan.samples if unit.name == name))
    raise UserError(
        "a worker has other source, libraries or files than there were when the run began: it would make other records; "
        "start all workers in one environment and folder, and run again"
    )


def described(plugins: Iterable[object], count: int) -> dict[str, Any]:
    """The environment of this process, computing with `count` threads."""
    threads.limit(count)
    return environment.describe(plugins)


@functools.lru_cache(maxsize=PLANS)
def _trials(asked: bytes) -> Trials:
    return Trials(plan.planned(pickle.loads(asked)))
