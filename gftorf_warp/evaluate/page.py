"""Parts of an offline HTML page without scripts and external resources."""

from __future__ import annotations

import functools
import html
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from . import pictures

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
# [px] larger pictures are subsampled, so that a page of thirty pictures stays below 4 MB
PICTURE_SIZE_MAX = 320
STYLE = Path(__file__).with_suffix(".css")

FORMATS: dict[str, Callable[[Any], str]] = {  # formats of values of metrics.json
    "error": lambda value: f"{value:.3f}",  # [m^2 x 100]
    # root of a mean squared error given in m^2 x 100
    "rms_cm": lambda value: f"{10.0 * math.sqrt(value):.1f} cm",
    "length_cm": lambda value: f"{100.0 * value:.2f} cm",  # of a length given in m
    "ratio": lambda value: f"{value:.3g}",
    "percent": lambda value: f"{100.0 * value:.1f} %",
    "decibel": lambda value: f"{value:.2f} dB",
    "count": lambda value: f"{value:,}",
    "seconds": lambda value: f"{value:.1f} s",
    "text": str,
}


def escape(text: object) -> str:
    """Text with HTML's special characters escaped."""
    return html.escape(str(text), quote=True)


def look_up(metrics: Mapping[str, Any], key: str) -> Any:
    """The value of a key; ``moving.share`` is the share inside moving."""
    value: Any = metrics
    for part in key.split("."):
        value = value[part] if isinstance(value, Mapping) else None
    return value


def number(metrics: Mapping[str, Any], key: str, form: str) -> str:
    """A value of metrics.json, marked with its key, so that a test can compare it."""
    value = look_up(metrics, key)
    text = "not known" if value is None else FORMATS[form](value)
    return f'<span data-key="{escape(key)}" data-form="{escape(form)}">{escape(text)}</span>'


def ratio(metrics: Mapping[str, Any], above: str, below: str) -> str:
    """The ratio of two values of metrics.json, marked with their keys; both must be above zero."""
    value = look_up(metrics, above) / look_up(metrics, below)
    return f'<span data-above="{escape(above)}" data-below="{escape(below)}">{value:.1f}</span>'


def section(title: str, *parts: str) -> str:
    """A part of the page with its heading; ``parts`` are trusted HTML."""
    return f"<section><h2>{title}</h2>{''.join(parts)}</section>"


def caption(text: str) -> str:
    """A paragraph of trusted HTML that explains what follows."""
    return f'<p class="caption">{text}</p>'


def picture(
    image: Float[np.ndarray, "H W"], scale: pictures.Scale, title: str, note: str = ""
) -> str:
    """An image with its title, its colour bar and its unit."""
    rgb = pictures.colour_mapped(pictures.thinned(image, PICTURE_SIZE_MAX), scale)
    return plain_picture(rgb, title, note, colour_bar(scale))


def plain_picture(
    rgb: UInt8[np.ndarray, "h w 3"], title: str, note: str = "", below: str = ""
) -> str:
    """A picture with its title; ``below`` is trusted HTML."""
    source = pictures.data_uri(pictures.webp(rgb), "image/webp")
    caption = f"{escape(title)} <span>{escape(note)}</span>" if note else escape(title)
    size = f'width="{rgb.shape[1]}" height="{rgb.shape[0]}"'
    image = f'<img class="picture" {size} src="{source}" alt="{escape(title)}">'
    return f"<figure><figcaption>{caption}</figcaption>{image}{below}</figure>"


def colour_bar(scale: pictures.Scale) -> str:
    """The colours of a scale between its two values."""
    source = _bar(scale.colours)
    low, high = (f"{value:.3g}".replace("-", "\N{MINUS SIGN}") for value in (scale.low, scale.high))
    unit = f"<span>{escape(scale.unit)}</span>" if scale.unit else ""
    return f'<div class="bar">{low}<img src="{source}" alt="colour bar">{high} {unit}</div>'


@functools.cache
def _bar(colours: str) -> str:
    return pictures.data_uri(pictures.webp(pictures.bar(colours)), "image/webp")


def row(figures: list[str], columns: int | None = None, *, kind: str = "") -> str:
    """Pictures in equal columns, two on a phone; of kind ``strip``, all of them in a row there."""
    style = f'class="row {kind}" style="--columns: {columns or len(figures)}"'
    return f"<div {style}>{''.join(figures)}</div>"


def charts(drawings: Sequence[bytes], title: str) -> str:
    """SVG drawings on white, embedded as images, as many in a row as fit."""
    images = (
        f'<img src="{pictures.data_uri(svg, "image/svg+xml")}" alt="{escape(title)}">'
        for svg in drawings
    )
    return f'<div class="charts">{"".join(images)}</div>'


def table(head: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> str:
    """A table of trusted HTML that scrolls sideways where it does not fit.

    Args:
        head: Titles of the columns; the first is that of the names.
        rows: Class of a row, such as ``ours`` or nothing, and its cells.
    """
    titles = "".join(f"<th>{title}</th>" for title in head)
    lines = "".join(
        f'<tr class="{kind}">{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        for kind, cells in rows
    )
    return (
        f'<div class="scroll"><table><thead><tr>{titles}</tr></thead><tbody>{lines}</tbody>'
        "</table></div>"
    )


def document(title: str, body: str) -> str:
    """A whole page around trusted HTML."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE.read_text(encoding='utf-8')}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )
