"""Pictures on disk while the next images are rendered: by as many threads as there are CPUs, in order of the images.

A 320x240 image with four quads and distance costs a CPU 4 ms, half of it the system's for two megabytes. For less than
0.3 ms of it Python's lock is held: so much take images of 4x4 pixels. Processes would have to be sent the images.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from ..data.files import many_files, write_one_of_many
from ..data.images import write_exr
from . import previews
from .pictures import Scale
from .previews import Channels

THREADS_MIN = 4  # on fewer CPUs they wait for the disk in turns
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
    workers = max(THREADS_MIN, available_cpus())
    waiting: deque[Future] = deque()
    written = 0

    def collect(most: int) -> None:
        nonlocal written
        while waiting and (len(waiting) > most or waiting[0].done()):
            waiting.popleft().result()  # raises what stopped the writing
            written += 1
            if progress is not None:
                progress(written, total)

    with ExitStack() as stack:
        for name in scales:
            stack.enter_context(many_files(out / name))
        threads = ThreadPoolExecutor(workers, thread_name_prefix="gftorf-files")
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)
        for index, images in enumerate(series):
            waiting.append(threads.submit(write_images, out, scales, index, images))
            del images  # the memory of what is written is used again
            collect(QUEUED * workers)
        collect(0)


def write_images(out: Path, scales: Mapping[str, Scale], index: int, images: Mapping[str, Channels]) -> None:
    """Write what was rendered at the index-th time: for each thing one EXR and one PNG, each of them atomically.

    What looks after their folders is :func:`many_files`.
    """
    for name, channels in images.items():
        exr, png = previews.paths(out, name, index)
        write_exr(exr, channels, one_of=True)
        write_one_of_many(png, previews.preview(name, channels, scales[name]))


def available_cpus() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
