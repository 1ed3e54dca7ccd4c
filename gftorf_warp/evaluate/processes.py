"""Pictures on disk by other processes, to which images go through shared memory.

OpenEXR holds Python's lock while it writes, so the threads of one process keep no more than two CPUs busy. These
processes are started and not forked, and load what writes: neither torch nor Warp, and nothing of CUDA. The memory has
no name, and each of them ends when its connection does, so nothing is left, however this process ends.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from mmap import mmap
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import ResourceError
from .pictures import Scale
from .previews import Channels, write_images

MANY = 300  # images from which on it pays: processes start in half a second of a CPU each
CPUS = 4  # with no more of them threads write nearly as fast
MOST = 16  # processes: they take images as fast as one process gives them away
BLOCK = 4  # images of a message, unless
BLOCK_BYTES = 1 << 23  # they would take more
HELD = 2  # messages for each process: one that is written and one that comes next
SURROUNDINGS = {  # variables of their environment
    "OMP_NUM_THREADS": "1",  # or NumPy starts a thread for each CPU
    "MALLOC_MMAP_THRESHOLD_": str(1 << 25),  # or glibc gives the memory of each image back,
    "MALLOC_TRIM_THRESHOLD_": str(1 << 28),  # and new pages for the next take a third of the time
}
NOTHING: Float[np.ndarray, "M B C H W"] = np.empty((0, 0, 0, 0, 0), np.float32)
START = 4096  # [bytes] where images begin in the memory; its first byte says whether to stop


def useful(total: int) -> int:
    """How many processes pay for so many images on this machine; 0: threads do as well."""
    if total < MANY or not hasattr(os, "memfd_create"):
        return 0
    cpus = len(os.sched_getaffinity(0))
    return min(cpus - 1, MOST) if cpus > CPUS else 0


@contextmanager
def writing(out: Path, scales: Mapping[str, Scale], count: int, done: Callable[[int], None]) -> Iterator[Writing]:
    """Some processes that write what they are given; at a normal end they have written it all.

    At any other each completes the picture that it writes, and drops what waits.

    Args:
        out: Folder with a folder for each thing, which ``many_files`` looks after.
        scales: Of the previews of each thing.
        count: How many processes.
        done: Called with how many more images are written.

    Raises:
        UsageError, ResourceError: If a file cannot be written, or a process was stopped.
    """
    processes = Writing(out, scales, done)
    try:
        processes.start(count)
        yield processes
        processes.finish()
    finally:
        processes.stop()


class Writing:
    """Processes at work, and the memory [M, B, C, H, W] of all messages between here and there."""

    def __init__(self, out: Path, scales: Mapping[str, Scale], done: Callable[[int], None]):
        """Take note; nothing is started yet."""
        self._out, self._scales, self._done = out, scales, done
        self._file = os.memfd_create("gftorf-pictures")
        self._processes: dict[Connection, subprocess.Popen] = {}
        self._busy: dict[Connection, dict[int, int]] = {}  # images of each message under way
        self._images = NOTHING
        self._first, self._filled = 0, 0  # what lies in the message that is being filled
        self._free: list[int] = []  # messages; the last one is being filled

    def start(self, count: int) -> None:
        """Start some processes, which do not wait for the first image to load what they need."""
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import work; work()"
        here = os.environ | SURROUNDINGS
        for _ in range(count):
            ours, theirs = Pipe()
            with theirs:
                files = theirs.fileno(), self._file
                command = [sys.executable, "-c", code, *map(str, files)]
                # groups of their own: Ctrl-C is for this process, which lets them complete what they write
                process = subprocess.Popen(command, env=here, pass_fds=files, stdin=subprocess.DEVNULL, process_group=0)
            self._processes[ours], self._busy[ours] = process, {}

    def write(self, index: int, images: Mapping[str, Channels]) -> None:
        """Have the index-th image written; its memory may be used again when this returns."""
        if not self._images.size:
            self._begin(images)
        if not self._filled:
            self._hear(len(self._free) == 0)
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
            self._hear(True)

    def stop(self) -> None:
        """Let each process complete the picture that it writes, and end."""
        os.pwrite(self._file, b"\1", 0)
        for connection in self._processes:
            connection.close()
        for process in self._processes.values():
            process.wait()
        self._images = NOTHING  # an error that is looked at later holds no memory
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
            self._tell(connection, (self._out, self._scales, names, shape))

    def _send(self) -> None:
        connection = min(self._busy, key=lambda one: len(self._busy[one]))
        message = self._free.pop()
        self._busy[connection][message] = self._filled
        self._tell(connection, (message, self._first, self._filled))
        self._filled = 0

    def _tell(self, connection: Connection, what: object) -> None:
        try:
            connection.send(what)
        except OSError as error:
            raise self._ended(connection) from error

    def _hear(self, patiently: bool) -> None:
        """What processes have said, and if there is reason to wait, until one has said something."""
        ready = wait([one for one, busy in self._busy.items() if busy], None if patiently else 0)
        for connection in [one for one in self._busy if one in ready]:
            try:
                said = connection.recv()
            except (EOFError, OSError) as error:
                raise self._ended(connection) from error
            if isinstance(said, BaseException):
                raise said
            self._free.append(said)
            self._done(self._busy[connection].pop(said))

    def _ended(self, connection: Connection) -> ResourceError:
        connection.close()
        code = self._processes[connection].wait()
        why = f"signal {-code} stopped it" if code < 0 else f"it ended with {code}"
        return ResourceError(
            "a process that writes pictures ended", where=self._out, why=why, fix="free memory, then render again"
        )


def _mapped(file: int, shape: tuple[int, ...]) -> Float[np.ndarray, "M B C H W"]:
    """The images in shared memory."""
    count = math.prod(shape)
    return np.frombuffer(mmap(file, START + 4 * count), np.float32, count, START).reshape(shape)


def work() -> None:
    """What a process does: write the images of each message, then say so, until nobody listens."""
    connection, file = Connection(int(sys.argv[1])), int(sys.argv[2])
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        out, scales, names, shape = connection.recv()
        memory = _mapped(file, shape)
        while True:
            message, first, count = connection.recv()
            for k in range(count):
                if os.pread(file, 1, 0) != b"\0":
                    return
                planes = iter(memory[message, k])
                images = {name: {channel: next(planes) for channel in channels} for name, channels in names.items()}
                try:
                    write_images(out, scales, first + k, images)
                except Exception as error:
                    connection.send(error)
                    return
            connection.send(message)
