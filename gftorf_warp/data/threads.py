"""Threads that stay for the next call, for functions that call OpenCV.

OpenCV keeps about 900 bytes for every thread that called it, even when the thread has ended
(https://github.com/opencv/opencv/issues/23252), so new threads for every call are a leak.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent import futures
from functools import cache
from typing import Any


class KeptThreads(futures.Executor):
    """A ``ThreadPoolExecutor`` whose threads are those of the last one of the same name and number.

    Leaving a ``with`` waits for what was submitted here. Functions of one name must not wait for
    others of that name.
    """

    def __init__(self, name: str, threads: int | None = None):
        """At most ``threads`` threads, by default those of ``ThreadPoolExecutor``."""
        self._pool = _pool(name, threads)
        self._unfinished: set[futures.Future] = set()

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> futures.Future:
        """See ``Executor.submit``."""
        future = self._pool.submit(fn, *args, **kwargs)
        self._unfinished.add(future)
        future.add_done_callback(self._unfinished.discard)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for what was submitted here, or cancel what has not begun; the threads stay."""
        left = tuple(self._unfinished)
        if cancel_futures:
            for future in left:
                future.cancel()
        if wait:
            futures.wait(left)


@cache
def _pool(name: str, threads: int | None) -> futures.ThreadPoolExecutor:
    return futures.ThreadPoolExecutor(threads, thread_name_prefix=name)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a fork copies no threads
