"""Files of a colour camera as linear images: PNG, TIFF, OpenEXR and the raw files of cameras."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..data.arrays import SIDE_MAX
from ..data.exr import read_exr
from ..data.pictures import read_picture
from ..data.untrusted import read_bytes, unreadable

EXR, PICTURES = (".exr",), (".png", ".tif", ".tiff")
ENCODINGS = ("linear", "srgb")
BALANCES = ("camera", "daylight", "none")


def is_picture(path: Path) -> bool:
    """Whether a file of this name does not say if its numbers are linear."""
    return path.suffix.lower() in PICTURES


def read_colour(path: Path, encoding: str, balance: str) -> Float[np.ndarray, "h w 3"]:
    """One image, linear, float32; red, green and blue, 1 is the largest number of a picture and the
    white level of a raw file.

    Args:
        path: A picture of 8 or 16 bits, an OpenEXR file with channels R, G, B, or a raw file of a
            camera, such as DNG, in linear sRGB primaries, black level subtracted, not turned.
        encoding: One of ``ENCODINGS``: what the numbers of a picture are.
        balance: One of ``BALANCES``: white balance of a raw file, as the camera set it, of
            daylight, or none.

    Raises:
        InputError: If it is no whole file of these kinds, or not of three channels.
    """
    suffix = path.suffix.lower()
    image: np.ndarray
    if suffix in EXR:
        channels = read_exr(path)
        if not {"R", "G", "B"} <= channels.keys():
            raise unreadable(path, f"expected channels R, G, B, found {', '.join(channels)}")
        image = np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float32)
    elif suffix in PICTURES:
        pages = read_picture(path)
        if pages.ndim != 4 or len(pages) != 1 or pages.dtype.kind != "u":
            why = "expected one picture of red, green and blue in 8 or 16 bits, found "
            raise unreadable(path, f"{why}{pages.dtype} of shape {pages.shape}")
        image = pages[0, ..., :3] / np.float32(np.iinfo(pages.dtype).max)
        image = _from_srgb(image) if encoding == "srgb" else image
    else:
        image = _raw(path, balance)
    if not np.isfinite(image).all():
        raise unreadable(path, "expected finite numbers, found NaN or infinity")
    return image


def reduced(image: Float[np.ndarray, "H W 3"], factor: int) -> Float[np.ndarray, "h w 3"]:
    """Mean of so many by so many pixels; what is left at the right and below is cut off.

    Raises:
        ValueError: If nothing is left.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if min(height, width) < 1:
        raise ValueError(f"image {image.shape} cannot be reduced by {factor}")
    cut = image[: height * factor, : width * factor]
    blocks = cut.reshape(height, factor, width, factor, 3)
    return blocks.mean(axis=(1, 3)) if factor > 1 else image


def _from_srgb(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Linear light of the numbers of IEC 61966-2-1."""
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype("f4")


def _raw(path: Path, balance: str) -> Float[np.ndarray, "h w 3"]:
    """A raw file of a camera; brightness does not depend on what is in the image."""
    import rawpy

    read_bytes(path)  # a pipe or a folder is named as such
    options: dict[str, dict[str, Any]] = {
        "camera": {"use_camera_wb": True},
        "daylight": {"use_camera_wb": False, "use_auto_wb": False},
        "none": {"user_wb": [1.0, 1.0, 1.0, 1.0]},
    }
    try:
        with warnings.catch_warnings(), rawpy.imread(str(path)) as raw:
            warnings.simplefilter("ignore")
            height, width = raw.sizes.raw_height, raw.sizes.raw_width
            if not (1 <= height <= SIDE_MAX and 1 <= width <= SIDE_MAX):
                raise unreadable(path, f"expected at most {SIDE_MAX} pixels a side, found {width}")
            codes = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,  # else the scale would follow the brightest pixel
                user_flip=0,
                output_bps=16,
                **options[balance],
            )
    except (rawpy.LibRawError, OSError, ValueError, MemoryError) as error:
        raise unreadable(path, f"expected a raw file of a camera, found {error}") from error
    return codes / np.float32(65535)
