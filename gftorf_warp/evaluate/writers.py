"""Pictures written by threads or, if many, by processes, while the next images are rendered.

A 320x240 image with four quads and distance takes 5 ms of a CPU, half of it with the GIL held by
OpenEXR.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from ..data.files import many_files
from . import processes
from .pictures import Scale
from .previews import Channels, Label, write_images

THREADS = 4  # more would wait for the GIL
QUEUED = 2  # waiting images per thread, at most, which bounds memory


def write_all(
    out: Path,
    scales: Mapping[str, Scale],
    series: Iterable[Mapping[str, Channels]],
    total: int,
    progress: Callable[[int, int], None] | None = None,
    labels: Sequence[Label] = (),
) -> None:
    """Write a series of images as files numbered from 0.

    After an exception or interruption, files in progress are completed and no others are written.

    Args:
        out: Folder with a folder for each kind of image.
        scales: Scale of the previews of each kind.
        series: Images in order.
        total: Their number.
        progress: Called with (images written, images in all), counting up.
        labels: What is beside the pixels of each image; empty: nothing.

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
            others = stack.enter_context(processes.writing(out, scales, labels, count, done))
            for index, images in enumerate(series):
                others.write(index, images)
        else:
            _write_by_threads(out, scales, series, labels, done)


def _write_by_threads(
    out: Path,
    scales: Mapping[str, Scale],
    series: Iterable[Mapping[str, Channels]],
    labels: Sequence[Label],
    done: Callable[[int], None],
) -> None:
    waiting: deque[Future] = deque()

    def collect(most: int) -> None:
        while waiting and (len(waiting) > most or waiting[0].done()):
            waiting.popleft().result()  # raises the error of the thread
            done(1)

    with ExitStack() as stack:
        threads = ThreadPoolExecutor(THREADS, thread_name_prefix="gftorf-files")
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)
        for index, images in enumerate(series):
            waiting.append(threads.submit(write_images, out, scales, index, images, labels))
            del images  # so that its memory is reused
            collect(QUEUED * THREADS)
        collect(0)
