"""Line plots as SVG, written directly: matplotlib takes two seconds for those of a report."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

WIDTH, HEIGHT = 288, 216  # [px] of a drawing
LEFT, RIGHT, BELOW = 52, 14, 38  # [px] around the axes of a plot
TITLE, LEGEND_ROW = 22, 13  # [px] above them
FONT, SMALL = 9.5, 8.5  # [px]
INK, GRID = "#262626", "#0001"
LETTER = 0.54  # mean width of a letter, as a fraction of the size of its font
LOG_SPAN = 20.0  # values that span more than this factor are drawn on a logarithmic axis
MARGIN = 0.04  # of the span of an axis, beyond its values
LABELS = 5  # of an axis, about
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Curve(NamedTuple):
    """One line; values that are not finite, or not positive on a logarithmic axis, interrupt it."""

    x: Float[np.ndarray, "K"]
    y: Float[np.ndarray, "K"]
    colour: str
    label: str = ""
    dashes: str = ""  # as in SVG, for example "5 3"; empty: a solid line
    points: bool = False  # whether every value is marked


class Plot(NamedTuple):
    """One pair of axes with their labels."""

    title: str
    x: str
    y: str
    curves: Sequence[Curve]
    log_x: bool = False
    log_y: bool | None = None  # None: if all values are positive and span more than ``LOG_SPAN``
    from_zero: bool = True  # whether a linear vertical axis starts at zero


class _Axis(NamedTuple):
    """Maps values between ``low`` and ``high`` to pixels between ``start`` and ``end``."""

    low: float
    high: float
    log: bool
    start: float
    end: float

    def __call__(self, values: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        with np.errstate(divide="ignore", invalid="ignore"):
            at, low, high = (
                np.log10(v) if self.log else np.asarray(v) for v in (values, self.low, self.high)
            )
        return self.start + (at - low) / (high - low) * (self.end - self.start)

    def ticks(self) -> list[tuple[float, str]]:
        """Values with a label, or without one."""
        if not self.log:
            step = _step((self.high - self.low) / LABELS)
            first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
            return [(step * k, _number(step * k)) for k in range(first, last + 1)]
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        every = -(-len(decades) // (LABELS + 2))
        decimal = self.high / self.low < 100.0
        labelled = (1, 2, 5) if self.high / self.low > 5.0 else range(1, 10)
        ticks = []
        for decade in decades:
            power = f"10{str(decade).translate(SUPERSCRIPT)}" if decade % every == 0 else ""
            for k in range(1, 10):
                value, label = k * 10.0**decade, power if k == 1 else ""
                if decimal:
                    label = f"{value:g}" if k in labelled else ""
                ticks.append((value, label))
        return [(value, label) for value, label in ticks if self.low <= value <= self.high]


def svg(plot: Plot) -> bytes:
    """A drawing of one plot, its legend above the axes."""
    legend = _legend(plot.curves, WIDTH - 2 * RIGHT)
    body = _plot(plot, TITLE + LEGEND_ROW * len(legend)) + _group(legend, RIGHT, TITLE)
    size = f'width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}"'
    font = f'font-family="DejaVu Sans, Verdana, sans-serif" font-size="{FONT}" fill="{INK}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {font}>{body}</svg>\n'.encode()


def _plot(plot: Plot, above: float) -> str:
    """Axes and curves, ``above`` [px] below the upper edge."""
    x0, x1, y0, y1 = LEFT, WIDTH - RIGHT, HEIGHT - BELOW, above
    xs = np.concatenate([np.asarray(curve.x, float) for curve in plot.curves])
    ys = np.concatenate([np.asarray(curve.y, float) for curve in plot.curves])
    x, y = _axis(xs, plot.log_x, x0, x1), _axis(ys, plot.log_y, y0, y1, from_zero=plot.from_zero)
    bold = 'text-anchor="middle" font-weight="bold" font-size="11"'
    parts = [_text(0.5 * (x0 + x1), 14, plot.title, bold)]
    for value, label in x.ticks():
        at = float(x(np.array(value)))
        parts += [_line(at, y0, at, y1, GRID)] if label else []
        parts.append(_line(at, y0, at, y0 + (3.5 if label else 2)))
        parts.append(_text(at, y0 + 14, label, 'text-anchor="middle"'))
    for value, label in y.ticks():
        at = float(y(np.array(value)))
        parts += [_line(x0, at, x1, at, GRID)] if label else []
        parts.append(_line(x0 - (3.5 if label else 2), at, x0, at))
        parts.append(_text(x0 - 6, at + 3.3, label, 'text-anchor="end"'))
    parts += [_line(x0, y0, x1, y0), _line(x0, y0, x0, y1)]
    parts.append(_text(0.5 * (x0 + x1), y0 + 30, plot.x, 'text-anchor="middle"'))
    middle = 0.5 * (y0 + y1)
    turned = f'text-anchor="middle" transform="rotate(-90 11 {middle:.1f})"'
    parts.append(_text(11, middle, plot.y, turned))
    return "".join(parts) + "".join(_curve(curve, x, y) for curve in plot.curves)


def _curve(curve: Curve, x: _Axis, y: _Axis) -> str:
    across, up = x(np.asarray(curve.x, float)), y(np.asarray(curve.y, float))
    words, pen_down = [], False
    for a, b in zip(across.tolist(), up.tolist(), strict=True):
        known = math.isfinite(a) and math.isfinite(b)
        if known:
            words.append(f"{'L' if pen_down else 'M'}{a:.1f} {b:.1f}")
        pen_down = known
    dashes = f' stroke-dasharray="{curve.dashes}"' if curve.dashes else ""
    line = f'fill="none" stroke="{curve.colour}" stroke-width="1.4"{dashes}'
    path = f'<path d="{"".join(words)}" {line}/>'
    if not curve.points and len(words) > 1:
        return path
    # a line without length and with round ends
    marks = "".join(f"{word.replace('L', 'M')}h0" for word in words)
    dots = f'stroke="{curve.colour}" stroke-width="3.2" stroke-linecap="round"'
    return f'{path}<path d="{marks}" {dots}/>'


def _axis(
    values: Float[np.ndarray, "K"],
    log: bool | None,
    start: float,
    end: float,
    *,
    from_zero: bool = False,
) -> _Axis:
    known = values[np.isfinite(values)]
    if log is None:
        log = bool(known.size and known.min() > 0 and known.max() > LOG_SPAN * known.min())
    known = known[known > 0] if log else known
    low, high = (float(known.min()), float(known.max())) if known.size else (0.1, 1.0)
    if log:
        factor = (high / low) ** MARGIN if high > 1.5 * low else 1.5
        return _Axis(low / factor, high * factor, True, start, end)
    low = min(low, 0.0) if from_zero else low
    span = high - low or abs(high) or 1.0
    below = 0.0 if from_zero and low == 0.0 else MARGIN * span
    return _Axis(low - below, high + MARGIN * span, False, start, end)


def _number(value: float) -> str:
    """A number in up to five characters, else with a power of ten."""
    text = f"{value:.10g}"
    if len(text) <= 5:
        return text
    digits, exponent = f"{value:.3e}".split("e")
    return f"{float(digits):g}\N{MIDDLE DOT}10{str(int(exponent)).translate(SUPERSCRIPT)}"


def _step(least: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is at least ``least``."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-9))


def _legend(curves: Iterable[Curve], width: float) -> list[str]:
    """Rows of a legend, each an SVG group with its origin at the left; none for a single curve."""
    rows: list[str] = []
    at, curves = width, [curve for curve in curves if curve.label]
    for curve in curves if len(curves) > 1 else ():
        wide = 23 + LETTER * SMALL * len(curve.label)
        if at + wide > width:
            rows.append("")
            at = 0.0
        dashes = f'stroke-dasharray="{curve.dashes}" ' if curve.dashes else ""
        line = f'<path d="M{at:.1f} 0h14" stroke="{curve.colour}" stroke-width="1.6" {dashes}/>'
        rows[-1] += line + _text(at + 17, 3, curve.label, f'font-size="{SMALL}"')
        at += wide
    return rows


def _group(rows: Sequence[str], left: float, top: float) -> str:
    return "".join(
        f'<g transform="translate({left:.1f} {top + LEGEND_ROW * k:.1f})">{row}</g>'
        for k, row in enumerate(rows)
    )


def _line(x0: float, y0: float, x1: float, y1: float, colour: str = INK) -> str:
    return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{colour}" stroke-width="0.8"/>'


def _text(x: float, y: float, text: str, how: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" {how}>{html.escape(text)}</text>' if text else ""
