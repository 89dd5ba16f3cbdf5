"""Processes on one machine that share its cores, each doing whole units of a plan that it made for itself."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING

from bench.errors import UserError

if TYPE_CHECKING:
    from bench.records import Record
    from bench.runner import Asked, Plan, Work


def share(workers: int) -> None:
    """Let this process use its share of the cores and no more. Those that it starts use as many.

    Records say how many threads were used, so this is done before planning.
    """
    import torch

    if workers > 1:
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // workers))


def units(plan: Plan, out: Path | None, work: Sequence[Work], workers: int) -> Iterator[Iterable[Record]]:
    """The records of each unit, made by `workers` processes.

    Raises
    ------
    UserError
        if a process was killed.
    """
    import torch

    places = {unit.name: place for place, unit in enumerate(plan.units)}
    # Processes are started afresh: a copy of one that has computed with several threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(plan.asked, torch.get_num_threads())) as executor:
        waiting: list[Future[list[Record]]] = [
            executor.submit(_unit, places[unit.name], [cell.head["cell_id"] for cell in cells], out) for unit, cells in work
        ]
        try:
            for future in waiting:
                yield future.result()
        except BrokenProcessPool:
            raise UserError("a worker process was ended from outside, perhaps for want of memory; run again to go on") from None
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


_plan: Plan | None = None  # of this process, if it is a worker


def _begin(asked: Asked, threads: int) -> None:
    global _plan
    import torch

    from bench import runner

    torch.set_num_threads(threads)
    _plan = runner.planned(asked)


def _unit(place: int, cells: Sequence[str], out: Path | None) -> list[Record]:
    from bench import runner

    assert _plan is not None
    wanted = [cell for cell in _plan.cells if cell.head["cell_id"] in cells]
    return list(runner.unit_records(_plan, _plan.units[place], wanted, out))
