"""Controls of a page that need no script: a slider between two pictures, and a film with a button
that pauses it. How they work is in page.css.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from . import page, pictures

FILM_COLUMNS = 4  # panels beside each other, on a large screen
FILM_QUALITY = 80  # of WebP, as in JPEG
FILM_LOSSLESS_MAX = 2**18  # [px] of all frames: below, edges stay sharp and a panel below 300 kB
FILM_HEIGHT_MAX = 16383  # [px] WebP's limit of all frames together


def slider(
    left: UInt8[np.ndarray, "h w 3"],
    right: UInt8[np.ndarray, "h w 3"],
    titles: tuple[str, str],
    below: str = "",
) -> str:
    """Two pictures in one place with an edge between them that the scroll bar moves.

    Args:
        left: Picture left of the edge.
        right: Picture right of it, of the same size.
        titles: Their titles.
        below: Trusted HTML.
    """
    if left.shape != right.shape:
        raise ValueError(f"a slider needs pictures of one size, got {left.shape}, {right.shape}")
    before, after = (_image(rgb, title) for rgb, title in zip((left, right), titles, strict=True))
    ends = "".join(f"<span>{page.escape(title)}</span>" for title in titles)
    name = page.escape(f"{titles[0]} and {titles[1]}, scroll sideways")
    layers = f'{after}<div class="left">{before}</div><i class="edge"></i><i class="middle"></i>'
    return (
        f'<div><div class="slider" tabindex="0" role="group" aria-label="{name}"><div>{layers}'
        f'</div></div><div class="ends">{ends}</div>{below}</div>'
    )


def film(
    panels: Mapping[str, tuple[Sequence[UInt8[np.ndarray, "h w 3"]], str]], period_s: float
) -> str:
    """Pictures side by side that change together, with a button that pauses them.

    Args:
        panels: By title, the frames of a panel and trusted HTML below it. All panels have the same
            number of frames, at least two.
        period_s: Time of one frame [s].
    """
    (count,) = {len(frames) for frames, _ in panels.values()}
    figures = "".join(_frames(title, *given) for title, given in panels.items())
    row = page.row([figures], columns=min(FILM_COLUMNS, len(panels)))
    time = f"--count: {count}; --seconds: {count * period_s:g}s"
    return (
        f'<div class="film" style="{time}"><input type="checkbox" id="film" '
        'aria-label="pause the film"><label for="film"></label>'
        f'<div class="at"><i></i></div>{row}</div>'
    )


def _frames(title: str, frames: Sequence[UInt8[np.ndarray, "h w 3"]], below: str) -> str:
    """One panel: all of its frames above each other in one picture."""
    height, width = frames[0].shape[:2]
    if height * len(frames) > FILM_HEIGHT_MAX:
        raise ValueError(f"{len(frames)} frames of {height} rows exceed {FILM_HEIGHT_MAX} rows")
    strip = np.concatenate(list(frames))
    small = strip[..., 0].size <= FILM_LOSSLESS_MAX
    data = pictures.webp(strip, pictures.WEBP_LOSSLESS if small else FILM_QUALITY)
    source, alt = pictures.data_uri(data, "image/webp"), page.escape(f"film: {title}")
    image = (
        f'<img class="picture frames" style="aspect-ratio: {width} / {height}" '
        f'src="{source}" alt="{alt}">'
    )
    return f"<figure><figcaption>{page.escape(title)}</figcaption>{image}{below}</figure>"


def _image(rgb: UInt8[np.ndarray, "h w 3"], title: str) -> str:
    source = pictures.data_uri(pictures.webp(rgb), "image/webp")
    size = f'width="{rgb.shape[1]}" height="{rgb.shape[0]}"'
    return f'<img class="picture" {size} src="{source}" alt="slider: {page.escape(title)}">'
