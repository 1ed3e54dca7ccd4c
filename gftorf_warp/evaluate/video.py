"""Videos and animations of pictures: WebM and MP4 by VP9, GIF, and WebP.

OpenCV's own FFmpeg encodes VP9, which browsers and usual players show from either file; it has
no encoder for H.264, which some office programs need.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ..data.files import atomic_path
from ..errors import ResourceError, UsageError
from .pictures import animated

CODEC = "vp09"
ENCODED = (".webm", ".mp4")
ANIMATED = (".gif", ".webp")
SUFFIXES = (*ENCODED, *ANIMATED)
HELD_BYTES_MAX = 1 << 30  # of the pictures of an animation
RATE_MIN, RATE_MAX, LONGEST_S = 4.0, 30.0, 5.0  # [1/s], [1/s], and [s] a short video should last

Picture = UInt8[np.ndarray, "H W 3"]


def checked(path: str | Path) -> Path:
    """The path, if its suffix is that of a video.

    Raises:
        UsageError: If not.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        why = f"expected a name that ends in {', '.join(SUFFIXES)}"
        fix = f"for example {path.with_suffix('.webm')}"
        raise UsageError("not a kind of video", where=path, why=why, fix=fix)
    return path


def rate_of(pictures: int) -> float:
    """Pictures per second, 4 to 30: few pictures are shown more slowly."""
    return float(np.clip(pictures / LONGEST_S, RATE_MIN, RATE_MAX))


def write_video(
    path: str | Path,
    pictures: Iterable[Picture],
    total: int,
    *,
    rate_hz: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write pictures as a video, whose kind the suffix of the path is; atomically.

    Args:
        path: A file that ends in one of ``SUFFIXES``.
        pictures: Red, green, blue, of one even width and height.
        total: Their number.
        rate_hz: Pictures per second; None: :func:`rate_of` their number.
        progress: Called with (pictures done, pictures in all).

    Raises:
        UsageError: If the suffix is another one, the file cannot be written, or an animation is too
            long to be held in memory.
        ResourceError: If the file does not hold all pictures afterwards, for example since the disk
            is full.
    """
    path, rate = checked(path), rate_hz or rate_of(total)
    with atomic_path(path) as temporary:
        seen = _counted(pictures, total, progress)
        if path.suffix in ANIMATED:
            pictures_held = _held(seen, total, path)
            temporary.write_bytes(animated(pictures_held, 1.0 / rate, path.suffix))
        else:
            named = temporary.with_name(f"{temporary.name}{path.suffix}")  # which decides the kind
            try:
                _encode(named, seen, rate, path)
                os.replace(named, temporary)
            finally:
                named.unlink(missing_ok=True)


def _counted(
    pictures: Iterable[Picture], total: int, progress: Callable[[int, int], None] | None
) -> Iterator[Picture]:
    for done, picture in enumerate(pictures, start=1):
        yield picture
        if progress is not None:
            progress(done, total)


def _held(pictures: Iterator[Picture], total: int, where: Path) -> list[Picture]:
    """All pictures in memory, which the encoder of animations needs."""
    held = []
    for picture in pictures:
        if total * picture.nbytes > HELD_BYTES_MAX:
            why = f"{total} pictures of {picture.shape[1]}x{picture.shape[0]} must be in memory at "
            why += f"once: {total * picture.nbytes >> 20} MB, the most is {HELD_BYTES_MAX >> 20}"
            fix = "write .webm or .mp4, or fewer times"
            raise UsageError("too long for an animation", where=where, why=why, fix=fix)
        held.append(picture)
    return held


def _encode(path: Path, pictures: Iterable[Picture], rate: float, where: Path) -> None:
    """Write VP9 and count what can be read: OpenCV does not notice a full disk."""
    import cv2

    path.touch(exist_ok=False)  # so that a missing permission is an error of its own
    writer, count = None, 0
    for picture in pictures:
        count += 1
        if writer is None:
            size = picture.shape[1], picture.shape[0]
            with _silent():  # FFmpeg prints that WebM has no tag for VP9, which it does not need
                code = cv2.VideoWriter.fourcc(*CODEC)
                writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, rate, size)
            if not writer.isOpened():
                why, fix = "OpenCV opened no VP9 encoder", "use .webp, or install another OpenCV"
                raise ResourceError("cannot encode video", where=where, why=why, fix=fix)
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    if writer is not None:
        writer.release()
    reader, readable = cv2.VideoCapture(str(path)), 0
    while reader.grab():
        readable += 1
    reader.release()
    if readable != count:
        why = f"{readable} of {count} pictures can be read back"
        fix = "check that the disk is not full"
        raise ResourceError("video damaged while writing", where=where, why=why, fix=fix)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Discard what libraries print to file descriptor 2."""
    saved, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)
