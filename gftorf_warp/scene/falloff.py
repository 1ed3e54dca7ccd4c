"""Read a measured map of the fall-off of a lens: an image or an array of any size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.arrays import map_array
from ..data.exr import read_exr
from ..data.pictures import read_picture
from ..errors import InputError

SUFFIXES = (".npy", ".exr", ".png")


def read_falloff(path: Path) -> Float[np.ndarray, "h w"]:
    """The map in a file, above 0 and of maximum 1. PNG is linear, EXR has one channel.

    Raises:
        InputError: If the file cannot be read, or it is no image of numbers above 0.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise _wrong(path, f"expected one of {', '.join(SUFFIXES)}, found {path.suffix!r}")
    if not path.is_file():
        raise _wrong(path, "there is no such file")
    image = _image(path)
    if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "uif":
        actual = f"{image.dtype} {image.shape}"
        raise _wrong(path, f"expected numbers in rows and columns, found {actual}")
    image = image.astype(np.float64)
    if not np.isfinite(image).all() or image.min() <= 0:
        raise _wrong(path, f"expected finite numbers above 0, found {image.min()} to {image.max()}")
    return image / image.max()


def resized(image: Float[np.ndarray, "h w"], height: int, width: int) -> Float[np.ndarray, "H W"]:
    """The map at the pixels of an image: means, or linear interpolation of a coarser map."""
    import cv2

    if image.shape == (height, width):
        return image
    finer = image.shape[0] >= height and image.shape[1] >= width
    method = cv2.INTER_AREA if finer else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method)


def _image(path: Path) -> np.ndarray:
    if path.suffix.lower() == ".exr":
        channels = read_exr(path)
        if len(channels) != 1:
            raise _wrong(path, f"expected one channel, found {', '.join(sorted(channels))}")
        return next(iter(channels.values()))
    try:
        return map_array(path) if path.suffix.lower() == ".npy" else read_picture(path)[0]
    except InputError as error:
        raise _wrong(path, error.why) from error


def _wrong(path: Path, why: str) -> InputError:
    return InputError(
        "no fall-off map", where=path, why=why, fix="give an array [H, W] or a grey picture, linear"
    )
