"""Rendered images as arrays on disk: for each channel one .npy file [S, H, W] float32, filled while rendering goes on.

Nothing is encoded, so what is left is to copy. Files are written and not mapped: a full disk is an error then and not a
signal, and it took half the time. Each file is filled by one thread at a time, which is all that systems do in any
case, so channels have files of their own. Many images go into one call of the system, because each call gives Python's
lock back and asks for it again, and the rendering waits for it each time.

Where a disk takes them as they are, images go there past the memory in which systems keep files (``O_DIRECT``). Else it
begins with what it is given while more is rendered, not at the end.
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import math
import os
import shutil
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
from ..errors import ResourceError
from .previews import Channels

BLOCK = 32  # images that one call of the system writes, unless
BLOCK_BYTES = 1 << 26  # they would take more: memory holds the block that is written and the one that comes next
HELD = 2 * BLOCK + 2  # images at most that are held meanwhile
HEADER = 4096  # [bytes] of a file: then images start where a page does, of files and of what maps them
DIRECT = getattr(os, "O_DIRECT", 0)
REFUSED = {errno.EINVAL, errno.EFAULT, errno.EOPNOTSUPP}  # a size, an address, a kind of memory, a kind of file
LOG = logging.getLogger("gftorf_warp")


def path_of(out: Path, name: str, channel: str) -> Path:
    """Where all images of one channel of one thing belong."""
    return out / name / f"{channel}.npy"


def store_all(
    out: Path,
    channels: Mapping[str, Iterable[str]],
    series: Iterable[Mapping[str, Channels]],
    shape: tuple[int, int, int],
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a series of images as arrays, while it goes on; files appear when all images are in them.

    Args:
        out: Folder with a folder for each thing.
        channels: Names of the channels of each thing.
        series: Images in order.
        shape: (S, H, W) of each channel.
        progress: Called with (images written, images in all); the last time when everything is on the disk.

    Raises:
        ResourceError: If the disk is full, or cannot hold them.
        UsageError: If the place cannot be written to.
    """
    paths = [path_of(out, name, channel) for name in channels for channel in channels[name]]
    needed = 4 * math.prod(shape) * len(paths)
    with as_errors(out):
        free = shutil.disk_usage(out).free
    if needed > free:
        raise ResourceError(
            "not enough space",
            where=out,
            why=f"the arrays take {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free",
            fix="render fewer --times, or write to another disk",
        )
    with ExitStack() as stack:
        files = {path: stack.enter_context(Stored(path, shape)) for path in paths}
        threads = ThreadPoolExecutor(len(files), thread_name_prefix="gftorf-arrays")
        stack.callback(threads.shutdown, wait=True, cancel_futures=True)  # before files are closed
        waiting: deque[tuple[int, list[Future]]] = deque()

        def collect(most: int) -> None:
            while len(waiting) > most:
                last, futures = waiting.popleft()
                for future in futures:
                    future.result()  # raises what stopped the writing
                if progress is not None and last < shape[0]:
                    progress(last, shape[0])

        most = max(1, min(BLOCK, BLOCK_BYTES // (needed // shape[0])))
        block: list[Mapping[str, Channels]] = []
        for done, images in enumerate(series, start=1):
            block.append(images)
            del images  # the memory of what is written is used again
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
    """Write some images, each channel by itself, some day."""
    return [
        threads.submit(_fill, files[path_of(out, name, channel)], first, [images[name][channel] for images in block])
        for name, channels in block[0].items()
        for channel in channels
    ]


def _fill(file: Stored, first: int, images: list[Float[np.ndarray, "H W"]]) -> None:
    """Write some images of a channel, and let go of them before anybody hears of it: their memory is used again."""
    try:
        file.write(first, images)
    finally:
        images.clear()


class Stored:
    """A .npy file [S, H, W] that is filled in any order, and appears under its name at the end of a ``with``."""

    def __init__(self, path: Path, shape: tuple[int, int, int]):
        """Take note of where and how large; nothing is written yet."""
        self._path, self._shape = path, shape
        self._lock, self._stack = threading.Lock(), ExitStack()
        self._direct = False  # whether it is written past the system's memory

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
        """Write some consecutive images.

        Args:
            first: The number of the first of them.
            images: Of the file's size.

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
                LOG.debug("%s goes through the system's memory: %s", self._path, error)
                self._direct = _set_direct(self._file, False)
                self._file.seek(start)
                _write(self._file, rows)
            if not self._direct:
                _begin_to_flush(self._file, start, sum(map(len, rows)))


def _header(shape: tuple[int, int, int]) -> bytes:
    """What a .npy file of float32 starts with, filled up with spaces as the format allows."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    magic = np.lib.format.magic(1, 0)
    text = file.getvalue()[len(magic) + 2 : -1].ljust(HEADER - len(magic) - 3) + b"\n"
    return magic + len(text).to_bytes(2, "little") + text


def _write(file: FileIO, rows: list[memoryview]) -> None:
    """Write bytes one after the other, all of them."""
    done = os.writev(file.fileno(), rows) if hasattr(os, "writev") else 0
    for row in rows:
        there = min(done, len(row))
        rest, done = row[there:], done - there
        while rest:
            rest = rest[file.write(rest) :]


def _set_direct(file: FileIO, wanted: bool) -> bool:
    """Write past the system's memory from now on, or no more; whether it will be so."""
    if not DIRECT:
        return False
    import fcntl

    flags = fcntl.fcntl(file, fcntl.F_GETFL) & ~DIRECT
    with contextlib.suppress(OSError):  # not every file system can
        fcntl.fcntl(file, fcntl.F_SETFL, flags | (DIRECT if wanted else 0))
        return wanted
    return False


def _begin_to_flush(file: FileIO, start: int, length: int) -> None:
    """Let the disk begin with a part of a file, without waiting for it.

    Linux does when told that the part will not be needed; otherwise the disk is idle until much more is in memory.
    """
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(file.fileno(), start, length, os.POSIX_FADV_DONTNEED)
