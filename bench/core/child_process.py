"""Processes that this program starts: they end when their parent ends, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.connection import wait


def end_with_parent() -> None:
    """End this process as soon as its parent has ended, also by SIGKILL. Call it once in a process of `multiprocessing`.

    `multiprocessing` gives each spawned process a pipe, or on Windows a handle, that becomes ready when the parent ends. A daemon
    thread waits for it. The process ends without clean-up; files are written atomically.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_for, args=(parent.sentinel,), name="end-with-parent", daemon=True).start()


def _wait_for(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
