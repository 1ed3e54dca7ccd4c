"""Pictures written by other processes, which receive images through shared memory.

OpenEXR holds the GIL while it writes, so threads use no more than two CPUs. The processes are
started, not forked, and import neither torch nor Warp. The shared memory is anonymous and a process
ends with its connection, so nothing is left when this process is killed.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from mmap import mmap
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import ResourceError
from .pictures import Scale
from .previews import Channels, Label, write_images

MANY = 300  # fewest images for processes: each needs half a second of a CPU to start
CPUS = 4  # up to these, threads write nearly as fast
MOST = 16  # processes, which write as fast as one process copies images to them
BLOCK = 4  # images of a message, at most
BLOCK_BYTES = 1 << 23  # of a message, at most
HELD = 2  # messages of each process: one being written and the next
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",  # else NumPy starts a thread for each CPU
    # else glibc returns the memory of each image to the system,
    "MALLOC_MMAP_THRESHOLD_": str(1 << 25),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 28),  # and new pages take a third of the time
}
NOTHING: Float[np.ndarray, "M B C H W"] = np.empty((0, 0, 0, 0, 0), np.float32)
START = 4096  # [bytes] offset of the images in shared memory; the first byte is the stop flag


def useful(total: int) -> int:
    """Number of processes for ``total`` images on this machine; 0: use threads."""
    if total < MANY or not hasattr(os, "memfd_create"):
        return 0
    cpus = len(os.sched_getaffinity(0))
    return min(cpus - 1, MOST) if cpus > CPUS else 0


@contextmanager
def writing(
    out: Path,
    scales: Mapping[str, Scale],
    labels: Sequence[Label],
    count: int,
    done: Callable[[int], None],
) -> Iterator[Writing]:
    """Processes that write images; all are written at the end of the block, unless it raises.

    After an exception each process completes its current picture and drops the rest. ``done`` is
    called with the number of further images written.

    Raises:
        UsageError, ResourceError: If a file cannot be written, or a process was stopped.
    """
    processes = Writing(out, scales, labels, done)
    try:
        processes.start(count)
        yield processes
        processes.finish()
    finally:
        processes.stop()


class Writing:
    """Writing processes and the shared memory [M, B, C, H, W] of all messages."""

    def __init__(
        self,
        out: Path,
        scales: Mapping[str, Scale],
        labels: Sequence[Label],
        done: Callable[[int], None],
    ):
        """Create the shared memory, empty; no process is started."""
        self._out, self._scales, self._labels, self._done = out, scales, labels, done
        self._file = os.memfd_create("gftorf-pictures")
        self._processes: dict[Connection, subprocess.Popen] = {}
        # number of images of each message in flight
        self._busy: dict[Connection, dict[int, int]] = {}
        self._images = NOTHING
        # index of the first image and number of images of the current message
        self._first, self._filled = 0, 0
        self._free: list[int] = []  # free messages; the last one is the current one

    def start(self, count: int) -> None:
        """Start processes, which import their modules at once."""
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import work; work()"
        environment = os.environ | ENVIRONMENT
        for _ in range(count):
            ours, theirs = Pipe()
            with theirs:
                files = theirs.fileno(), self._file
                command = [sys.executable, "-c", code, *map(str, files)]
                # Ctrl-C reaches only this process, which lets those complete their picture
                given: dict[str, Any] = {"stdin": subprocess.DEVNULL, "process_group": 0}
                process = subprocess.Popen(command, env=environment, pass_fds=files, **given)
            self._processes[ours], self._busy[ours] = process, {}

    def write(self, index: int, images: Mapping[str, Channels]) -> None:
        """Copy the index-th image to a message; the last image of a message sends it."""
        if not self._images.size:
            self._begin(images)
        if not self._filled:
            self._receive(wait_for_one=not self._free)
            self._first = index
        planes = self._images[self._free[-1], self._filled]
        channels = (channel for thing in images.values() for channel in thing.values())
        for plane, channel in zip(planes, channels, strict=True):
            plane[:] = channel
        self._filled += 1
        if self._filled == len(self._images[0]):
            self._send()

    def finish(self) -> None:
        """Wait until everything is written."""
        if self._filled:
            self._send()
        while any(self._busy.values()):
            self._receive(wait_for_one=True)

    def stop(self) -> None:
        """Let each process complete its current picture and end."""
        os.pwrite(self._file, b"\1", 0)
        for connection in self._processes:
            connection.close()
        for process in self._processes.values():
            process.wait()
        self._images = NOTHING  # a traceback must not hold the memory
        os.close(self._file)

    def _begin(self, images: Mapping[str, Channels]) -> None:
        names = {name: list(channels) for name, channels in images.items()}
        size = next(iter(next(iter(images.values())).values())).shape
        image = sum(map(len, names.values())), *size
        block = max(1, min(BLOCK, BLOCK_BYTES // (4 * math.prod(image))))
        shape = HELD * len(self._processes), block, *image
        os.ftruncate(self._file, START + 4 * math.prod(shape))
        self._images = _mapped(self._file, shape)
        self._free = list(range(shape[0]))
        for connection in self._processes:
            self._post(connection, (self._out, self._scales, self._labels, names, shape))

    def _send(self) -> None:
        connection = min(self._busy, key=lambda one: len(self._busy[one]))
        message = self._free.pop()
        self._busy[connection][message] = self._filled
        self._post(connection, (message, self._first, self._filled))
        self._filled = 0

    def _post(self, connection: Connection, what: object) -> None:
        try:
            connection.send(what)
        except OSError as error:
            raise self._ended(connection) from error

    def _receive(self, *, wait_for_one: bool) -> None:
        """Handle replies of the processes, and with ``wait_for_one`` wait for one."""
        ready = wait([one for one, busy in self._busy.items() if busy], None if wait_for_one else 0)
        for connection in [one for one in self._busy if one in ready]:
            try:
                reply = connection.recv()
            except (EOFError, OSError) as error:
                raise self._ended(connection) from error
            if isinstance(reply, BaseException):
                raise reply
            self._free.append(reply)
            self._done(self._busy[connection].pop(reply))

    def _ended(self, connection: Connection) -> ResourceError:
        connection.close()
        code = self._processes[connection].wait()
        why = f"signal {-code} stopped it" if code < 0 else f"its exit code is {code}"
        what, fix = "a process that writes pictures ended", "free memory, then render again"
        return ResourceError(what, where=self._out, why=why, fix=fix)


def _mapped(file: int, shape: tuple[int, ...]) -> Float[np.ndarray, "M B C H W"]:
    count = math.prod(shape)
    return np.frombuffer(mmap(file, START + 4 * count), np.float32, count, START).reshape(shape)


def work() -> None:
    """Main function of a process: writes and acknowledges messages until the connection closes."""
    connection, file = Connection(int(sys.argv[1])), int(sys.argv[2])
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        out, scales, labels, names, shape = connection.recv()
        memory = _mapped(file, shape)
        while True:
            message, first, count = connection.recv()
            for k in range(count):
                if os.pread(file, 1, 0) != b"\0":
                    return
                planes = iter(memory[message, k])
                images = {
                    name: {channel: next(planes) for channel in channels}
                    for name, channels in names.items()
                }
                try:
                    write_images(out, scales, first + k, images, labels)
                except Exception as error:
                    connection.send(error)
                    return
            connection.send(message)
