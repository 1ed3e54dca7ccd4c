"""Pictures for viewing: enlarged, in a row, under a title, each with its colour bar."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from . import pictures

Picture = UInt8[np.ndarray, "h w 3"]
ALONE, IN_A_ROW = 640, 320  # [px] least width of a picture
MARGIN, GAP = 12, 16  # [px] around everything, and between pictures
HEAD, SUBHEAD = 34, 24  # [px] height of the title and of the titles of pictures
BAR, BAR_GAP, BAR_TEXT = 18, 10, 76  # [px] width of a colour bar, its distance, and its numbers
LABELS = 5  # numbers of a colour bar
TEXT, SMALL = 20, 15  # [px] size of letters
INK = (32, 32, 32)


class Panel(NamedTuple):
    """One picture with what is beside it."""

    title: str
    """What it shows, if the title of all does not say so."""
    image: Picture
    """Red, green, blue."""
    scale: pictures.Scale | None
    """Of its colours; None: they are no values."""


def captioned(panels: Sequence[Panel], title: str, least: int | None = None) -> Picture:
    """Pictures of one height in a row; those of one scale share a colour bar.

    Pixels are enlarged to squares, so that colours stay those of the scale. Width and height are
    even, as video codecs need. ``least`` is the least width of each [px]; None: what suits so many.
    """
    height, width = panels[0].image.shape[:2]
    least = least or (ALONE if len(panels) == 1 else IN_A_ROW)
    factor = max(1, -(-least // width))
    top = HEAD + (SUBHEAD if any(panel.title for panel in panels) else 0)
    bars = [one.scale != other.scale for one, other in pairwise(panels)] + [True]
    bars = [bar and panel.scale is not None for bar, panel in zip(bars, panels, strict=True)]
    widths = [
        factor * panel.image.shape[1] + (BAR_GAP + BAR + BAR_TEXT if bar else GAP)
        for panel, bar in zip(panels, bars, strict=True)
    ]
    size = top + factor * height + MARGIN, 2 * MARGIN + sum(widths)
    canvas = np.full((*(side + side % 2 for side in size), 3), pictures.WHITE, np.uint8)
    _write(canvas, title, (MARGIN, HEAD - 11), TEXT)
    left = MARGIN
    for panel, bar, across in zip(panels, bars, widths, strict=True):
        _place(canvas, panel, (left, top), factor, bar=bar)
        left += across
    return canvas


def _place(
    canvas: Picture, panel: Panel, corner: tuple[int, int], factor: int, *, bar: bool
) -> None:
    """Draw a picture with its upper left corner at (x, y) [px]."""
    left, top = corner
    image = panel.image.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width = image.shape[:2]
    canvas[top : top + height, left : left + width] = image
    _write(canvas, panel.title, (left, top - 7), SMALL)
    if bar and panel.scale is not None:
        _colour_bar(canvas, panel.scale, (left + width + BAR_GAP, top), height)


def _colour_bar(
    canvas: Picture, scale: pictures.Scale, corner: tuple[int, int], height: int
) -> None:
    """Draw a scale, the highest value on top, with numbers."""
    left, top = corner
    values = np.linspace(scale.high, scale.low, height)[:, None].repeat(BAR, axis=1)
    canvas[top : top + height, left : left + BAR] = pictures.colour_mapped(values, scale)
    for k in range(LABELS):
        share = k / (LABELS - 1)
        value = scale.high + share * (scale.low - scale.high)
        at = top + round(share * (height - SMALL)) + SMALL - 3
        _write(canvas, f"{value:.3g}", (left + BAR + 6, at), SMALL)


def _write(canvas: Picture, text: str, at: tuple[int, int], size: int) -> None:
    """Text with the left end of its base line at (x, y) [px]."""
    import cv2

    cv2.putText(canvas, text, at, INK, cv2.FontFace("sans"), size, 400)
