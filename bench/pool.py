"""Processes on one machine that share its cores: they extract features, or do whole units of a plan that each made for itself."""

from __future__ import annotations

import itertools
import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING

from bench.errors import UserError
from bench.progress import Progress
from bench.types import Features, Knowledge

if TYPE_CHECKING:
    from bench.datasets.scene import Pixels
    from bench.plugin import Extractor
    from bench.records import Record
    from bench.runner import Asked, Plan, Work


FEW = 16  # images that are not worth processes of their own


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

    if plan.public.place is not None and needs_map(plan):
        _ = plan.public.place.map  # made once, before each process reads it
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


def needs_map(plan: Plan) -> bool:
    """Whether some cell of the plan will ask for the place's map."""
    return plan.task.places or any(cell.attack is not None and Knowledge.MAP in cell.attack.needs for cell in plan.cells)


def extracted(extractor: Extractor, images: Sequence[Pixels]) -> Iterator[Features]:
    """The features of images, by as many processes as there are cores where many are not kept yet.

    Raises
    ------
    UnitError
        if one of them cannot be read.
    """
    from bench.features import kept

    missing = [image for image in images if not kept.is_kept(extractor, image)]
    if len(missing) > FEW:
        with (
            ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as executor,
            Progress("features of reference images", len(missing)) as progress,
        ):
            for _ in executor.map(kept.keep, itertools.repeat(extractor), missing):
                progress.advance()
    return (kept.features(extractor, image) for image in images)


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
