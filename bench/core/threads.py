"""Limits on the threads of a process, so that several processes can use one machine."""

from __future__ import annotations

import functools
import os

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def count_cores() -> int:
    """Return the number of cores that this process may use. A batch system may grant only some."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.lru_cache(maxsize=1)
def limit_threads(count: int) -> None:
    """Limit this process and its child processes to `count` threads.

    Records hold the number of threads, so call this before `build_plan`.
    """
    import cv2
    import torch
    from threadpoolctl import threadpool_limits

    for variable in VARIABLES:  # for libraries loaded later and for child processes
        os.environ[variable] = str(count)
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    threadpool_limits(count)
