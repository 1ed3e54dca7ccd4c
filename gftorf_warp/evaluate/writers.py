"""Pictures on disk while the next images are rendered: by a few threads, or of many images by processes.

A 320x240 image with four quads and distance costs a CPU 5 ms. For half of it OpenEXR and others hold Python's lock, so
more threads write no more; what processes write is the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from ..data.files import many_files
from . import processes
from .pictures import Scale
from .previews import Channels, write_images

THREADS = 4  # they wait for the disk in turns; with more, for Python's lock, which OpenEXR holds
QUEUED = 2  # images that wait for each thread, at most: what memory holds


def write_all(
    out: Path,
    scales: Mapping[str, Scale],
    series: Iterable[Mapping[str, Channels]],
    total: int,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a series of images while it goes on; files have the numbers of their images.

    Whatever stops it, an interruption included, what is being written is completed before, and nothing else is written.

    Args:
        out: Folder with a folder for each thing.
        scales: Of the previews of each thing.
        series: Images in order.
        total: How many they are.
        progress: Called with (images written, images in all), counting up.

    Raises:
        UsageError, ResourceError: If a file cannot be written.
    """
    written = 0

    def done(images: int) -> None:
        nonlocal written
        for _ in range(images):
            written += 1
            if progress is not None:
                progress(written, total)

    count = processes.useful(total)
    with ExitStack() as stack:
        for name in scales:
            stack.enter_context(many_files(out / name))
        if count:
            others = stack.enter_context(processes.writing(out, scales, count, done))
            for index, images in enumerate(series):
                others.write(index, images)
        else:
            _write_by_threads(out, scales, series, done)


def _write_by_threads(
    out: Path, scales: Mapping[str, Scale], series: Iterable[Mapping[str, Channels]], done: Callable[[int], None]
) -> None:
    """The same as processes do, in this one."""
    waiting: deque[Future] = deque()

    def collect(most: int) -> None:
        while waiting and (len(waiting) > most or waiting[0].done()):
            waiting.popleft().result()  # raises what stopped the writing
            done(1)

    with ExitStack() as stack:
        threads = ThreadPoolExecutor(THREADS, thread_name_prefix="gftorf-files")
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)
        for index, images in enumerate(series):
            waiting.append(threads.submit(write_images, out, scales, index, images))
            del images  # the memory of what is written is used again
            collect(QUEUED * THREADS)
        collect(0)
