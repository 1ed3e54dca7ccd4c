"""Coloured pictures of arrays, with one scale and one colour map for pictures to be compared."""

from __future__ import annotations

import base64
import functools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

UNKNOWN_GREY = 128  # pixels without a value; no colour map contains this grey
WHITE = 255  # between pictures in a row
WEBP_LOSSLESS = 101  # OpenCV: a WebP quality above 100 means lossless
TICKS = 254  # colours of a map; with grey and white, 256
BLUE_TO_RED = (  # RdBu of ColorBrewer, reversed
    (5, 48, 97), (33, 102, 172), (67, 147, 195), (146, 197, 222), (209, 229, 240), (247, 247, 247),
    (253, 219, 199), (244, 165, 130), (214, 96, 77), (178, 24, 43), (103, 0, 31),
)  # fmt: skip
UNKNOWN, GAP = TICKS, TICKS + 1  # indices of these two


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Maps values to colours."""

    low: float
    """Value of the first colour."""
    high: float
    """Value of the last colour."""
    colours: str
    """Name of a colour map: viridis, magma, twilight, gray or RdBu_r."""
    unit: str
    """Unit of both values."""

    def __post_init__(self):
        if not self.low < self.high:
            raise ValueError(f"a scale needs low < high, got {self.low} and {self.high}")


def distance_scale(images: Iterable[Float[np.ndarray, "*n"]]) -> Scale:
    """A scale [m] between the percentiles 0.5 and 99.5 of distances."""
    low, high = _range(images, 0.5, 99.5)
    return Scale(low=low, high=max(high, low + 1e-3), colours="viridis", unit="m")


def error_scale(images: Iterable[Float[np.ndarray, "*n"]], least: float = 1e-3) -> Scale:
    """A scale [m] from 0 to percentile 98 of errors, or to ``least`` [m] if that is more."""
    return Scale(low=0.0, high=max(_range(images, 0.0, 98.0)[1], least), colours="magma", unit="m")


def amplitude_scale(images: Iterable[Float[np.ndarray, "*n"]]) -> Scale:
    """A scale [quad units] from 0 to percentile 99.5 of amplitudes."""
    high = _range(images, 0.0, 99.5)[1]
    return Scale(low=0.0, high=high if high > 0 else 1.0, colours="gray", unit="quad units")


def signed_scale(images: Iterable[Float[np.ndarray, "*n"]]) -> Scale:
    """A scale [quad units] symmetric about zero, for values of either sign."""
    high = _range((np.abs(image) for image in images), 0.0, 99.5)[1]
    high = high if high > 0 else 1.0
    return Scale(low=-high, high=high, colours="RdBu_r", unit="quad units")


def phase_scale() -> Scale:
    """One turn [rad]; the first and the last colour are the same."""
    return Scale(low=0.0, high=2.0 * np.pi, colours="twilight", unit="rad")


def colour_mapped(image: Float[np.ndarray, "H W"], scale: Scale) -> UInt8[np.ndarray, "H W 3"]:
    """RGB of an image; values beyond the scale are clamped, NaN is grey."""
    return palette(scale)[ticks(image, scale)]


def ticks(image: Float[np.ndarray, "H W"], scale: Scale) -> UInt8[np.ndarray, "H W"]:
    """Indices into :func:`palette` of the pixels of an image."""
    level = image - scale.low
    level *= TICKS / (scale.high - scale.low)
    np.clip(level, 0, TICKS - 1, out=level)
    if np.isnan(level.min()):  # a reduction is cheaper than a mask
        level[np.isnan(level)] = UNKNOWN
    return level.astype(np.uint8)


def palette(scale: Scale) -> UInt8[np.ndarray, "C 3"]:
    """RGB of all colours of :func:`ticks`, and white."""
    return _palette(scale.colours)


def side_by_side(
    pictures: list[UInt8[np.ndarray, "H w 3"]], gap: int = 2
) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures of one height in a row, ``gap`` white pixels between them."""
    return _row(pictures, gap, WHITE)


def ticks_side_by_side(
    images: list[UInt8[np.ndarray, "H w"]], gap: int = 2
) -> UInt8[np.ndarray, "H W"]:
    """:func:`side_by_side` of indices by :func:`ticks` into one palette."""
    return _row(images, gap, GAP)


def _row(pictures: list[np.ndarray], gap: int, white: int) -> np.ndarray:
    between = np.full((pictures[0].shape[0], gap, *pictures[0].shape[2:]), white, dtype=np.uint8)
    row = [part for picture in pictures for part in (between, picture)]
    return np.concatenate(row[1:], axis=1)


def thinned(image: np.ndarray, size_max: int) -> np.ndarray:
    """Every k-th row and column, with the smallest k for sides of at most ``size_max``."""
    step = -(-max(image.shape[:2]) // size_max)
    return image[::step, ::step]


def webp(rgb: UInt8[np.ndarray, "H W 3"], quality: int = WEBP_LOSSLESS) -> bytes:
    """A WebP file, lossless unless a ``quality`` as in JPEG is given."""
    import cv2

    ok, data = cv2.imencode(
        ".webp", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_WEBP_QUALITY, quality]
    )
    if not ok:
        raise ValueError(f"OpenCV could not encode a picture of shape {rgb.shape} as WebP")
    return data.tobytes()


def animated(
    pictures: list[UInt8[np.ndarray, "H W 3"]], period_s: float, kind: str, quality: int = 80
) -> bytes:
    """An endless animation, each picture for ``period_s`` [s].

    ``kind`` is ``.webp``, with ``quality`` as in JPEG, or ``.gif``.
    """
    import cv2

    animation = cv2.Animation()
    animation.frames = [np.ascontiguousarray(picture[..., ::-1]) for picture in pictures]
    animation.durations = [round(1000 * period_s)] * len(pictures)
    options = [cv2.IMWRITE_WEBP_QUALITY, quality] if kind == ".webp" else []
    ok, data = cv2.imencodeanimation(kind, animation, options)
    if not ok:
        raise ValueError(f"OpenCV could not encode {len(pictures)} pictures as an animated {kind}")
    return np.asarray(data).tobytes()


def data_uri(data: bytes, kind: str) -> str:
    """A data URI of a file, for example of kind ``image/webp``."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def bar(colours: str) -> UInt8[np.ndarray, "1 T 3"]:
    """The colours of a map from low to high."""
    return _colours(colours)[None].copy()


@functools.cache
def _colours(name: str) -> UInt8[np.ndarray, "T 3"]:
    import cv2

    if name == "RdBu_r":
        at = np.arange(TICKS) * (len(BLUE_TO_RED) - 1) / (TICKS - 1)
        known = range(len(BLUE_TO_RED))
        channels = [np.interp(at, known, channel) for channel in zip(*BLUE_TO_RED, strict=True)]
        return np.round(np.stack(channels, axis=-1)).astype(np.uint8)
    nearest = np.minimum(np.arange(TICKS) * 256 // (TICKS - 1), 255).astype(np.uint8)[:, None]
    if name == "gray":
        return np.repeat(nearest, 3, axis=1)
    bgr = cv2.applyColorMap(nearest, getattr(cv2, f"COLORMAP_{name.upper()}"))[:, 0]
    return np.ascontiguousarray(bgr[:, ::-1], dtype=np.uint8)


@functools.cache
def _palette(name: str) -> UInt8[np.ndarray, "C 3"]:
    grey, white = np.full((1, 3), UNKNOWN_GREY, np.uint8), np.full((1, 3), WHITE, np.uint8)
    return np.concatenate([_colours(name), grey, white])


def _range(images: Iterable[np.ndarray], low: float, high: float) -> tuple[float, float]:
    """Percentiles of all finite values; (0, 0) if there are none."""
    known = [np.asarray(image)[np.isfinite(image)].ravel() for image in images]
    values = np.concatenate(known) if known else np.zeros(0)
    if not values.size:
        return 0.0, 0.0
    return float(np.percentile(values, low)), float(np.percentile(values, high))
