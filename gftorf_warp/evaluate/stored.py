"""Rendered images as arrays on disk: one .npy file [S, H, W] float32 per channel.

Files are written rather than mapped: a full disk then raises an error instead of a signal, and it
takes half the time. Each file is written by one thread at a time, with many images per system call,
because every call releases and reacquires the GIL, for which rendering waits. Writes bypass the
page cache (``O_DIRECT``) where the file system allows it; otherwise write-back is started early.
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import math
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..data.files import as_errors, atomic_path
from .previews import Channels

BLOCK = 32  # images of one system call, at most
BLOCK_BYTES = 1 << 26  # of one system call, at most; memory holds two blocks
HELD = 2 * BLOCK + 2  # images in memory, at most
HEADER = 4096  # [bytes] so that images are aligned to pages
DIRECT = getattr(os, "O_DIRECT", 0)
# errors of O_DIRECT for an unsuitable size, address, memory or file system
REFUSED = {errno.EINVAL, errno.EFAULT, errno.EOPNOTSUPP}
LOG = logging.getLogger("gftorf_warp")


def path_of(out: Path, name: str, channel: str) -> Path:
    """Path of the file of one channel."""
    return out / name / f"{channel}.npy"


def store_all(
    out: Path,
    channels: Mapping[str, Iterable[str]],
    series: Iterable[Mapping[str, Channels]],
    shape: tuple[int, int, int],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a series of images as arrays; files get their names when they are complete.

    Args:
        out: Folder with a folder for each kind of image.
        channels: Names of the channels of each kind.
        series: Images in order, S of them.
        shape: (S, H, W) of each channel.
        progress: Called with (images written, images in all); the last time after the flush.

    Raises:
        ResourceError: If the disk is full.
        UsageError: If ``out`` is not writable.
    """
    paths = [path_of(out, name, channel) for name in channels for channel in channels[name]]
    image_bytes = 4 * math.prod(shape[1:]) * len(paths)
    with ExitStack() as stack:
        files = {path: stack.enter_context(Stored(path, shape)) for path in paths}
        threads = ThreadPoolExecutor(len(files), thread_name_prefix="gftorf-arrays")
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)  # before files are closed
        waiting: deque[tuple[int, list[Future]]] = deque()

        def collect(most: int) -> None:
            while len(waiting) > most:
                last, futures = waiting.popleft()
                for future in futures:
                    future.result()  # raises the error of the thread
                if progress is not None and last < shape[0]:
                    progress(last, shape[0])

        most = max(1, min(BLOCK, BLOCK_BYTES // image_bytes))
        block: list[Mapping[str, Channels]] = []
        for done, images in enumerate(series, start=1):
            block.append(images)
            del images  # so that its memory is reused
            if len(block) == most or done == shape[0]:
                waiting.append((done, _submit(threads, files, out, done - len(block), block)))
                block = []
                collect(1)
        collect(0)
    if progress is not None:
        progress(shape[0], shape[0])


def _submit(
    threads: ThreadPoolExecutor,
    files: Mapping[Path, Stored],
    out: Path,
    first: int,
    block: list[Mapping[str, Channels]],
) -> list[Future]:
    """Submit the writing of a block, each channel on its own."""
    futures = []
    for name, channels in block[0].items():
        for channel in channels:
            images = [one[name][channel] for one in block]
            file = files[path_of(out, name, channel)]
            futures.append(threads.submit(_fill, file, first, images))
    return futures


def _fill(file: Stored, first: int, images: list[Float[np.ndarray, "H W"]]) -> None:
    """Write images of a channel, and release their memory before the future completes."""
    try:
        file.write(first, images)
    finally:
        images.clear()


class Stored:
    """A .npy file [S, H, W], filled in any order; it gets its name at the end of a ``with``."""

    def __init__(self, path: Path, shape: tuple[int, int, int]):
        """Store path and shape; nothing is written yet."""
        self._path, self._shape = path, shape
        self._lock, self._stack = threading.Lock(), ExitStack()
        self._direct = False  # whether O_DIRECT is set

    def __enter__(self) -> Stored:
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_path(self._path))
            self._file = stack.enter_context(FileIO(temporary, "x+"))
            _write(self._file, [memoryview(_header(self._shape))])
            self._direct = _set_direct(self._file, True)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def write(self, first: int, images: Iterable[Float[np.ndarray, "H W"]]) -> None:
        """Write consecutive images, the first of which has the number ``first``.

        Raises:
            ResourceError: If the disk is full.
        """
        with as_errors(self._path), self._lock:
            rows = [np.ascontiguousarray(image, dtype="<f4").data.cast("B") for image in images]
            start = HEADER + 4 * first * math.prod(self._shape[1:])
            self._file.seek(start)
            try:
                _write(self._file, rows)
            except OSError as error:
                if not (self._direct and error.errno in REFUSED):
                    raise
                LOG.debug("%s is written through the page cache: %s", self._path, error)
                self._direct = _set_direct(self._file, False)
                self._file.seek(start)
                _write(self._file, rows)
            if not self._direct:
                _start_write_back(self._file, start, sum(map(len, rows)))


def _header(shape: tuple[int, int, int]) -> bytes:
    """Header of a .npy file of float32, padded with spaces."""
    file = io.BytesIO()
    content = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, content)
    magic = np.lib.format.magic(1, 0)
    text = file.getvalue()[len(magic) + 2 : -1].ljust(HEADER - len(magic) - 3) + b"\n"
    return magic + len(text).to_bytes(2, "little") + text


def _write(file: FileIO, rows: list[memoryview]) -> None:
    """Write all rows."""
    done = os.writev(file.fileno(), rows) if hasattr(os, "writev") else 0
    for row in rows:
        skipped = min(done, len(row))
        rest, done = row[skipped:], done - skipped
        while rest:
            rest = rest[file.write(rest) :]


def _set_direct(file: FileIO, wanted: bool) -> bool:
    """Set or clear O_DIRECT; returns whether it is set."""
    if not DIRECT:
        return False
    import fcntl

    flags = fcntl.fcntl(file, fcntl.F_GETFL) & ~DIRECT
    with contextlib.suppress(OSError):  # not supported by every file system
        fcntl.fcntl(file, fcntl.F_SETFL, flags | (DIRECT if wanted else 0))
        return wanted
    return False


def _start_write_back(file: FileIO, start: int, length: int) -> None:
    """Start write-back of a part of a file: Linux does that for pages declared as not needed."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(file.fileno(), start, length, os.POSIX_FADV_DONTNEED)
