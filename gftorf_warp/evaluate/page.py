"""Parts of an offline HTML page without scripts and external resources."""

from __future__ import annotations

import functools
import html
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from . import pictures

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
# [px] larger pictures are subsampled, so that a page of thirty pictures stays below 4 MB
PICTURE_SIZE_MAX = 320
STYLE = """
:root { color-scheme: light dark; --ink: #1c2430; --soft: #5b6676; --line: #d9dee6; --page: #f4f6f9;
--card: #ffffff;
  --ours: #0072b2; --naive: #d55e00; --mark: #e8f1f8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ee; --soft: #9aa5b4; --line: #343c48;
--page: #14181e;
  --card: #1d232b; --ours: #6cb6e8; --naive: #f0955a; --mark: #1c2f3e; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif;
}
main { max-width: 1200px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 24px; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 0 0 4px; }
h3 { font-size: 14px; margin: 18px 0 6px; }
p { margin: 4px 0 10px; max-width: 860px; }
.soft, .caption { color: var(--soft); font-size: 13px; }
.verdict { font-size: 18px; line-height: 1.45; max-width: none; margin: 14px 0 4px; }
.verdict .ours { color: var(--ours); font-weight: 600; } .verdict .naive { color: var(--naive);
font-weight: 600; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 10px;
padding: 18px 20px;
  margin: 18px 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: 6px 8px 6px 8px; border-bottom: 1px solid var(--line); text-align: right;
vertical-align: baseline; }
th:first-child, td:first-child { text-align: left; }
thead th { font-weight: 600; font-size: 13px; } thead .soft { font-weight: 400; display: block; }
tr.ours td { background: var(--mark); } tr.ours td:first-child b { color: var(--ours); }
td + td .soft { display: inline-block; min-width: 74px; }
.facts { display: flex; flex-wrap: wrap; gap: 6px 30px; margin: 14px 0 0; padding: 0;
list-style: none; }
.facts b { display: block; font-size: 17px; } .facts li { font-size: 13px; color: var(--soft); }
.facts b, .facts b * { color: var(--ink); }
.row { display: grid; gap: 14px; grid-template-columns: repeat(var(--columns), minmax(0, 1fr));
margin: 8px 0 14px;
  align-items: end; }
.row .soft { align-self: center; padding: 0 6px; }
figure { margin: 0; min-width: 0; }
figcaption { font-size: 13px; font-weight: 600; line-height: 1.3; margin-bottom: 4px; }
figcaption span { font-weight: 400; color: var(--soft); white-space: nowrap; }
img.picture { width: 100%; height: auto; display: block; image-rendering: pixelated;
border-radius: 3px; }
.bar { display: flex; align-items: center; gap: 6px; font-size: 11.5px; color: var(--soft);
margin-top: 4px;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
.bar img { flex: 1; height: 9px; min-width: 20px; width: 20px; border-radius: 2px; }
.wide { max-width: 420px; }
.chart { background: #ffffff; border-radius: 6px; padding: 6px; }
.chart img { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 18px; margin: 8px 0;
font-size: 14px; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
pre { overflow-x: auto; font-size: 12px; background: var(--page); padding: 10px; border-radius: 6px;
  max-height: 420px; }
code { font-size: 13px; overflow-wrap: anywhere; }
@media (max-width: 700px) { .row { grid-template-columns: repeat(2, minmax(0, 1fr)); } }
"""

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
    unit = escape(scale.unit)
    return f'<div class="bar">{low}<img src="{source}" alt="colour bar">{high} {unit}</div>'


@functools.cache
def _bar(colours: str) -> str:
    return pictures.data_uri(pictures.webp(pictures.bar(colours)), "image/webp")


def row(figures: list[str], columns: int | None = None) -> str:
    """Pictures in equal columns."""
    return f'<div class="row" style="--columns: {columns or len(figures)}">{"".join(figures)}</div>'


def chart(svg: bytes, title: str) -> str:
    """An SVG drawing on white, embedded as an image."""
    source = pictures.data_uri(svg, "image/svg+xml")
    return f'<div class="chart"><img src="{source}" alt="{escape(title)}"></div>'


def document(title: str, body: str) -> str:
    """A whole page around trusted HTML."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )
