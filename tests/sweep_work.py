"""Work for the processes of a sweep without torch and Warp, which take seconds to import.

A process imports the module that its work is defined in.
"""

import os
import signal
import time
from pathlib import Path

from gftorf_warp.sweep.workers import parent_lives


def die_once(task, place):
    """Kill the own process the first time."""
    path, times = task
    count = len(list(Path(path).iterdir()))
    (Path(path) / str(count)).touch()
    if count < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return count, place.device


def sleep(task, place):  # noqa: ARG001
    """A job that takes so many seconds."""
    time.sleep(task)


def pid(task, place):  # noqa: ARG001
    """Which process does the work."""
    return os.getpid()


def until_parent_ends(task, place):  # noqa: ARG001
    """A job that says when it begins, and when it notices that nobody waits for it."""
    Path(task, "begun").touch()
    while parent_lives():
        time.sleep(0.01)
    Path(task, "noticed").touch()


def cannot_load():
    """What the loader says without memory."""
    raise ImportError("libtorch: failed to map segment")


class Unloadable:
    """Work that no process can load."""

    def __reduce__(self):
        return cannot_load, ()
