"""Processes of this machine that work on tasks, each with its device and its share of the CPUs.

A process that is lost, by a crash or a signal, costs its task one of a few tries: another process
does it again, and whatever stores checkpoints goes on from them. One that cannot even import what
it needs says why.
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # no fork server on Windows
    from multiprocessing.context import ForkServerContext, SpawnContext

GRACE_S = 40.0  # [s] after the deadline, or after a signal to end
TRIES = 3
FORKS = "forkserver" in multiprocessing.get_all_start_methods()


@dataclass(frozen=True)
class Place:
    """Where a process computes."""

    device: str
    """'cpu' or a CUDA device."""
    cpus: tuple[int, ...] = ()
    """Numbers of the CPUs it may use; none: any."""


@dataclass(frozen=True)
class Lost:
    """The outcome of a task whose processes all ended before it was done."""

    why: str
    """How the last one ended, or why it could not begin."""


@dataclass
class _Worker:
    process: BaseProcess
    connection: Connection
    place: Place


def places(devices: Sequence[str], count: int | None = None) -> list[Place]:
    """A place for every process, with equal shares of the CPUs.

    Args:
        devices: Where to compute: GPUs, or the CPU alone.
        count: Number of processes; None: one per GPU, or one per two CPUs.
    """
    known = hasattr(os, "sched_getaffinity")
    cpus = sorted(os.sched_getaffinity(0)) if known else list(range(os.cpu_count() or 1))
    if count is None:
        count = max(len(cpus) // 2, 1) if devices == ["cpu"] else len(devices)
    return [
        Place(devices[k % len(devices)], tuple(cpus[k % len(cpus) :: count]) if known else ())
        for k in range(count)
    ]


def parent_lives() -> bool:
    """Whether the process whose :class:`Workers` started this one still runs; the parent that the
    system names is the fork server, which runs as long as any worker does.
    """
    parent = multiprocessing.parent_process()
    return parent is None or parent.is_alive()


class Workers:
    """Processes that all do the same work.

    Args:
        places: One for each process; they start when they are needed.
        work: Called in a process with a task and its place; what it returns is the outcome. It
            can be pickled, handles its own errors, and may be called several times per process.
    """

    def __init__(self, places: Sequence[Place], work: Callable[[Any, Place], Any]):
        self.work = work
        self._free = list(places)[::-1]
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, tuple[_Worker, Any, int]] = {}
        # forks of one process that has imported what the work needs and knows no CUDA, which would
        # not survive a fork; "spawn" imports it again in every process
        self._context: ForkServerContext | SpawnContext = multiprocessing.get_context("spawn")
        if FORKS:
            self._context = multiprocessing.get_context("forkserver")
            # which may lie where a fork server does not look, beside a program: our part of it is
            # what takes long
            self._context.set_forkserver_preload([work.__module__, f"{__package__}.job"])

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def outcomes(
        self, tasks: Iterable[Any], *, tries: int = TRIES, deadline: float = math.inf
    ) -> Iterator[tuple[Any, Any]]:
        """Tasks with their outcomes, or :class:`Lost`, in the order in which they are ready.

        No task begins after ``deadline`` on the monotonic clock [s], and what is not ready
        ``GRACE_S`` later is killed; such tasks have no outcome.
        """
        waiting = deque((task, 1) for task in tasks)
        while waiting or self._busy:
            while waiting and (self._idle or self._free) and time.monotonic() < deadline:
                self._begin(*waiting.popleft())
            if not self._busy:
                return
            left = None if math.isinf(deadline) else max(deadline + GRACE_S - time.monotonic(), 0.0)
            ready = wait(list(self._busy), left)
            if not ready:
                self._kill()
                return
            for connection in ready:
                assert isinstance(connection, Connection)
                worker, task, attempt = self._busy.pop(connection)
                try:
                    outcome = connection.recv()
                except (EOFError, OSError):
                    outcome = self._ended(worker)
                    if attempt < tries:
                        waiting.append((task, attempt + 1))
                        continue
                else:
                    if isinstance(outcome, Lost):
                        self._ended(worker)
                    else:
                        self._idle.append(worker)
                yield task, outcome

    def _begin(self, task: Any, attempt: int) -> None:
        worker = None
        while worker is None:
            worker = self._idle.pop() if self._idle else self._start(self._free.pop())
            try:
                worker.connection.send(task)
            except OSError:  # it was killed while it had nothing to do
                self._ended(worker)
                worker = None
        self._busy[worker.connection] = worker, task, attempt

    def _ended(self, worker: _Worker) -> Lost:
        """Free the place of a process that ends; how it does."""
        worker.process.join()
        worker.connection.close()
        self._free.append(worker.place)
        return Lost(_how(worker.process.exitcode or 0))

    def _start(self, place: Place) -> _Worker:
        ours, theirs = self._context.Pipe()
        given = theirs, place, pickle.dumps(self.work)
        process = self._context.Process(target=_serve, args=given, name="gftorf-worker")
        process.start()
        theirs.close()
        return _Worker(process, ours, place)

    def _kill(self) -> None:
        for worker, _, _ in self._busy.values():
            worker.process.kill()
            worker.process.join()
        self._busy.clear()

    def close(self) -> None:
        """End all processes: idle ones at once; others are told to, and killed if they do not."""
        for worker in self._idle:
            worker.connection.close()
        busy = [worker for worker, _, _ in self._busy.values()]
        for worker in busy:
            worker.process.terminate()
        end = time.monotonic() + GRACE_S
        for worker in [*self._idle, *busy]:
            worker.process.join(max(end - time.monotonic(), 0.0))
        self._idle.clear()
        self._kill()


def _how(exit_code: int) -> str:
    """How a process ended, by its exit code."""
    if exit_code >= 0:
        return f"its process ended with exit code {exit_code}"
    name = signal.strsignal(-exit_code) or -exit_code
    return f"its process was ended by a signal ({name}), as when memory is short"


def _serve(connection: Connection, place: Place, pickled: bytes) -> None:
    """The life of a process: tasks until its parent closes the connection, or ends."""
    from ..process import sigterm_raises

    if place.cpus:
        os.sched_setaffinity(0, place.cpus)
    log = logging.getLogger("gftorf_warp")  # runs have logs of their own
    log.addHandler(logging.NullHandler())
    log.propagate = False
    try:
        with sigterm_raises():
            try:
                work = pickle.loads(pickled)  # imports all that it needs
            except (ImportError, MemoryError, OSError) as error:
                connection.recv()
                connection.send(Lost(f"its process could not begin: {error or 'out of memory'}"))
                return
            while True:
                connection.send(work(connection.recv(), place))
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):
        return
