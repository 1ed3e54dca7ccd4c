"""Writing of pictures beside the rendering: threads, or for many images as many processes as there are CPUs.

An EXR and a PNG of a 320x240 image cost a CPU tens of milliseconds, a third of which holds Python's lock. A process is
started as ``python -m gftorf_warp.evaluate.writers``: it imports neither torch nor the caller's main module, is told
what to write through its standard input, answers each time, and ends when the input does. It has a session of its own,
so that Ctrl-C reaches the renderer alone and whatever is being written is completed.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from ..data.images import write_exr, write_png
from ..errors import ResourceError
from . import previews
from .pictures import Scale
from .previews import Channels

MANY = 64  # images from which on processes pay: one takes half a second to start
THREADS = 4  # that compress and flush otherwise
QUEUED = 2  # images that wait for each writer
Images = Mapping[str, Channels]


def write_images(out: Path, scales: Mapping[str, Scale], index: int, images: Images) -> None:
    """Write what was rendered at the index-th time: for each thing one EXR and one PNG, each of them atomically."""
    for name, channels in images.items():
        exr, png = previews.paths(out, name, index)
        write_exr(exr, channels)
        write_png(png, previews.preview(name, channels, scales[name]))


def write_all(
    out: Path,
    scales: Mapping[str, Scale],
    series: Iterable[Images],
    total: int,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a series of images while it goes on; files have the numbers of their images.

    Args:
        out: Folder with a folder for each thing.
        scales: Of the previews of each thing.
        series: Images in order.
        total: How many they are.
        progress: Called with (images written, images in all), counting up.

    Raises:
        GftorfError: What stopped a writer; then nothing more is written.
    """
    workers = available_cpus() if total >= MANY else THREADS
    with Writers(out, scales, workers, processes=total >= MANY) as writers:
        waiting: deque[Future] = deque()
        written = 0

        def collect(most: int) -> None:
            nonlocal written
            while waiting and (len(waiting) > most or waiting[0].done()):
                waiting.popleft().result()  # raises what stopped the writing
                written += 1
                if progress is not None:
                    progress(written, total)

        for index, images in enumerate(series):
            waiting.append(writers.submit(index, images))
            del images  # the memory of what is written is used again
            collect(QUEUED * workers)
        collect(0)


class Writers:
    """Threads that write images, each of them by itself or through a process of its own."""

    def __init__(self, out: Path, scales: Mapping[str, Scale], workers: int, *, processes: bool):
        """Start nothing yet: a worker starts when the others are busy."""
        self._out, self._scales, self._processes = out, scales, processes
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="gftorf-files")
        self._own = threading.local()
        self._helpers: list[Helper] = []

    def submit(self, index: int, images: Images) -> Future:
        """Write the images of the index-th time some day."""
        return self._threads.submit(self._write, index, images)

    def _write(self, index: int, images: Images) -> None:
        if not self._processes:
            write_images(self._out, self._scales, index, images)
            return
        if not hasattr(self._own, "helper"):
            self._own.helper = Helper(self._out, self._scales)
            self._helpers.append(self._own.helper)
        self._own.helper.write(index, images)

    def __enter__(self) -> Writers:
        return self

    def __exit__(self, *_: object) -> None:
        """Complete what is being written, drop what waits, and end."""
        self._threads.shutdown(wait=True, cancel_futures=True)
        for helper in self._helpers:
            helper.close()


class Helper:
    """A process that writes images."""

    def __init__(self, out: Path, scales: Mapping[str, Scale]):
        """Start it.

        Raises:
            ResourceError: If there cannot be another process.
        """
        self._out = out
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", __spec__.name]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "bufsize": 1 << 20}
        try:
            self.process = subprocess.Popen(command, **pipes, env=environment, start_new_session=True)  # type: ignore[call-overload]
        except OSError as error:
            raise self._lost(f"it could not be started: {error}") from error
        self._say((out, dict(scales)))

    def write(self, index: int, images: Images) -> None:
        """Have the images of the index-th time written.

        Raises:
            GftorfError: What stopped it.
            ResourceError: If the process ended.
        """
        self._say((index, {name: dict(channels) for name, channels in images.items()}))
        try:
            error = pickle.load(self.process.stdout)
        except (EOFError, pickle.UnpicklingError, OSError) as lost:
            raise self._lost(f"it ended with code {self.process.wait()}") from lost
        if error is not None:
            raise error

    def close(self) -> None:
        """Let it end, and wait for that."""
        try:
            self.process.stdin.close()
        except OSError:  # it has ended already, with something unsent
            self.process.kill()
        self.process.wait()
        self.process.stdout.close()

    def _say(self, message: object) -> None:
        try:
            pickle.dump(message, self.process.stdin, protocol=5)
            self.process.stdin.flush()
        except OSError as error:
            raise self._lost(f"it ended with code {self.process.wait()}") from error

    def _lost(self, why: str) -> ResourceError:
        return ResourceError(
            "a process that writes pictures is gone", where=self._out, why=why, fix="free memory, or use --threads 1"
        )


def available_cpus() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def serve() -> None:
    """What a process does: write what it is told to, and answer None or the error, until the input ends."""
    import cv2

    cv2.setNumThreads(1)  # there is a process for every CPU
    heard, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # nothing that a library prints may look like an answer
    out, scales = pickle.load(heard)
    while True:
        try:
            index, images = pickle.load(heard)
        except (EOFError, pickle.UnpicklingError):  # between two of them, or within one: who asked is gone
            return
        answer: Exception | None = None
        try:
            write_images(out, scales, index, images)
        except Exception as error:  # raised again where it is heard
            answer = error
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    serve()
