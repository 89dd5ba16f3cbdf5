"""How many threads a process computes with, so that processes that share a machine do not get in each other's way."""

from __future__ import annotations

import functools
import os

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Those that this process may use; a batch system may have given it a few of the machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.lru_cache(maxsize=1)
def limit(count: int) -> None:
    """Let this process compute with so many threads, and those that it starts as well.

    Records say how many threads were used, so this is done before planning.
    """
    import cv2
    import torch
    from threadpoolctl import threadpool_limits

    for variable in VARIABLES:  # for libraries that are loaded later, and for processes that are started
        os.environ[variable] = str(count)
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    threadpool_limits(count)
