"""The quads of one pixel over time: every measured one, and the fit at each slot's shift."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import numpy as np
from jaxtyping import Float, Int

from ..evaluate.figures import TERM_COLOURS
from ..evaluate.plot import Curve, Plot, svg
from .subject import Subject

AROUND = 64  # raw frames of a plot: a few objects' passing, and as many renderings
NOW = "#888888"


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """Quads of a pixel at M raw frames, in the units of the sequence."""

    frames: Int[np.ndarray, "M"]
    """The raw frames n."""
    times: Float[np.ndarray, "M"]
    """Their times [s]."""
    measured: Float[np.ndarray, "M K"]
    """The measured quad, in the column of its slot; NaN in all others."""
    fit: Float[np.ndarray, "M K"] | None
    """Rendered quads of every slot's shift; NaN at another frequency. None: there is no run."""


def series_of(subject: Subject, pixel: tuple[int, int], now: int) -> Series:
    """The quads of pixel (y, x) in the raw frames around ``now``.

    Raises:
        ValueError: If the pixel is outside of the image.
    """
    sequence, (y, x) = subject.sequence, pixel
    if not (0 <= y < sequence.height and 0 <= x < sequence.width):
        raise ValueError(f"pixel {pixel} is outside of {sequence.height} x {sequence.width}")
    first = min(max(0, now - AROUND // 2), max(0, sequence.frames - AROUND))
    frames = np.arange(first, min(first + AROUND, sequence.frames))
    slots = frames % sequence.cycle
    measured = np.full((len(frames), sequence.cycle), np.nan)
    taken = sequence.measured[frames]
    measured[np.flatnonzero(taken), slots[taken]] = sequence.quads[frames[taken], y, x]
    fit = None
    if subject.run is not None:
        fit = np.stack([subject.rendered(int(n))["slots"][:, y, x] for n in frames])
        of_slot = sequence.frame_frequencies[: sequence.cycle]
        fit[of_slot[None] != sequence.frame_frequencies[frames][:, None]] = np.nan
    return Series(frames=frames, times=sequence.times[frames], measured=measured, fit=fit)


def drawing(subject: Subject, series: Series, now: int) -> bytes:
    """An SVG of the quads over time: dots are measured, lines the fit, one colour per slot."""
    sequence, milliseconds, curves = subject.sequence, 1e3 * series.times, []
    slots = range(min(sequence.cycle, sequence.frames))
    for k, colour in zip(slots, cycle(TERM_COLOURS), strict=False):
        label = f"{np.degrees(sequence.shifts[k]):.0f}\N{DEGREE SIGN}"
        if len(sequence.frequencies) > 1:
            label += f" {sequence.frame_frequencies[k] / 1e6:.4g} MHz"
        if series.fit is not None:
            curves.append(Curve(x=milliseconds, y=series.fit[:, k], colour=colour))
        curves.append(_dots(milliseconds, series.measured[:, k], colour, label))
    known = np.concatenate([curve.y[np.isfinite(curve.y)] for curve in curves])
    if known.size:
        at = np.full(2, 1e3 * sequence.times[now])
        curves.append(Curve(x=at, y=np.array([known.min(), known.max()]), colour=NOW, dashes="3 3"))
    title = "Quads: dots measured, lines fit" if series.fit is not None else "Measured quads"
    plot = Plot(title=title, x="time [ms]", y="quad", curves=curves, from_zero=False, log_y=False)
    return svg(plot)


def _dots(x: Float[np.ndarray, "M"], y: Float[np.ndarray, "M"], colour: str, label: str) -> Curve:
    """Points without a line between them: NaN interrupts it."""
    apart = np.full((2, 2 * len(x)), np.nan)
    apart[0, ::2], apart[1, ::2] = x, y
    return Curve(x=apart[0], y=apart[1], colour=colour, label=label, points=True)
