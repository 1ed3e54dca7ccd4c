"""The process of a command: CUDA context, CPUs, garbage collection and exit."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from .errors import Terminated


def open_cuda(device: str) -> None:
    """Create the CUDA context of torch and Warp in a thread, while they are imported."""
    if device == "cpu":
        return
    # as torch does before it initialises the driver
    os.environ.setdefault("CUDA_MODULE_LOADING", "LAZY")

    def create() -> None:
        import ctypes

        with suppress(OSError, AttributeError):  # no driver: `choose_device` reports it
            driver = ctypes.CDLL("libcuda.so.1")
            ordinal, context = ctypes.c_int(), ctypes.c_void_p()
            index = int(device.partition(":")[2] or 0)
            if driver.cuInit(0) == 0 and driver.cuDeviceGet(ctypes.byref(ordinal), index) == 0:
                driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), ordinal)

    threading.Thread(target=create, name="gftorf-cuda", daemon=True).start()


def exit_at_once(codes: list[int]) -> None:
    """Exit with the code of the command, without freeing modules and CUDA objects one by one."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    if codes:
        os._exit(codes[0])


def available_cpus() -> int:
    """Number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def sigterm_raises() -> Iterator[None]:
    """Let SIGTERM raise :class:`Terminated`, so that what is unfinished is put in order as after
    Ctrl-C; in the main thread, unless the caller of the process handles or ignores it.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def terminate(*_: object) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Import without garbage collection, and exclude the imported objects from later ones."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()
        gc.freeze()


@contextmanager
def on_cpus(threads: int | None) -> Iterator[None]:
    """Restrict this process to ``threads`` CPUs, which torch, OpenCV and the renderer respect."""
    if threads is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, set(sorted(before)[:threads]))
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
