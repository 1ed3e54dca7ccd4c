"""Radiance images (.hdr) of RGBE pixels, by OpenCV after a check of their size."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.pictures import without_log_of_opencv
from ..data.untrusted import SIDE_MAX, unreadable
from .raw_files import raw_bytes, size_of

HEAD_BYTES = 4096  # a header has a few lines
SIZE = re.compile(rb"\n-Y (\d{1,5}) \+X (\d{1,5})\n")


def read_radiance(path: Path, size: tuple[int, int] | None = None) -> Float[np.ndarray, "H W 3"]:
    """Red, green and blue of an image, float32; ``size``: rows and columns that it must have.

    Raises:
        InputError: If it is missing, damaged, truncated, or of another size.
    """
    import cv2

    data = raw_bytes(path)
    head = data[:HEAD_BYTES].tobytes()
    match = SIZE.search(head)
    if not head.startswith(b"#?") or match is None:
        raise unreadable(path, f"expected a Radiance image, found {head[:16]!r}")
    shape = int(match[1]), int(match[2])
    if not (0 < min(shape) and max(shape) <= SIDE_MAX) or (size is not None and shape != size):
        expected = f"{size[1]}x{size[0]}" if size is not None else f"at most {SIDE_MAX} wide"
        raise unreadable(path, f"expected pixels {expected}, found {shape[1]}x{shape[0]}")
    if size_of(path) - match.end() < 4 * shape[0]:  # a row takes at least four bytes
        raise unreadable(path, "truncated")
    try:
        with without_log_of_opencv():
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise unreadable(path, str(error)[:200]) from error
    if image is None or image.shape != (*shape, 3) or image.dtype != np.float32:
        raise unreadable(path, f"expected {shape[1]}x{shape[0]} pixels, found damaged ones")
    if not np.isfinite(image).all():
        raise unreadable(path, "pixels that are not finite")
    return np.ascontiguousarray(image[..., ::-1])  # OpenCV has blue first
