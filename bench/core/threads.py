"""Limits on the threads of a process, so that several processes can use one machine."""

from __future__ import annotations

import functools
import os

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SPINS = "GOMP_SPINCOUNT"  # of GCC's OpenMP library, which PyTorch's packages for Linux contain


def count_cores() -> int:
    """Return the number of cores that this process may use. A batch system may grant only some."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def limit_spinning() -> None:
    """Let idle threads of this process and its child processes sleep soon, unless the user's environment says how they wait.

    By default they spin, and take the core from threads that have work if another program uses it: `bench run` with two threads
    beside one busy process took 117 seconds, and 11 with this limit. Without other programs both take 7. The library reads the
    variable when it is loaded, so call this before PyTorch is imported.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault(SPINS, "1000")


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
