"""The curves and histograms of a report, as SVG files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, cycle
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from .plot import Curve, Plot, svg

# Okabe and Ito
COLOURS = {"closed_form": "#d55e00", "d": "#0072b2", "d_normalised": "#56b4e9", "d_tof": "#009e73"}
NAMES = {"closed_form": "closed form", "d": "d", "d_normalised": "d / opacity", "d_tof": "d_ToF"}
Styles = Mapping[str, tuple[str, str]]
"""Colour and label of the curve of each kind of distance."""
OF_DISTANCES: Styles = {name: (COLOURS[name], NAMES[name]) for name in COLOURS}
TERM_COLOURS = "#0072b2 #e69f00 #009e73 #cc79a7 #56b4e9 #d55e00 #8c6d31 #666666".split()
# what else a log step holds
NOT_LOSSES = {"images", "seconds", "gaussians", "quad_psnr_db", "opacity", "attempt"}
FLOOR_M = 1e-3  # [m] smaller errors fall into the first bin of the histogram
BINS = 59
IMAGES = "optimised images"
SQUARED = "m\N{SUPERSCRIPT TWO} \N{MULTIPLICATION SIGN} 100"
DASHED, DOTTED = "5 3", "1.5 2"
GROUPS = {
    "": ("all pixels", ""),
    "moving.": ("moving pixels", DASHED),
    "static.": ("static pixels", DOTTED),
}
SINGLE = {  # title and unit of a plot of one curve: key of the rows of diagnostics
    ("Transmittance", "mean of 1 \N{MINUS SIGN} opacity"): "transmittance",
    ("Depth distortion", "m\N{SUPERSCRIPT TWO}"): "distortion",
    ("Gaussians", "number N"): "gaussians",
}


def training_curves(log: Sequence[Mapping[str, float]]) -> list[bytes]:
    """Loss terms, quad PSNR and number of Gaussians over optimised images; none without a log.

    Args:
        log: Steps of ``metrics.jsonl``: images, seconds, gaussians, quad_psnr_db and the loss terms
            by name.
    """
    if not log:
        return []
    terms = [name for name in dict.fromkeys(chain.from_iterable(log)) if name not in NOT_LOSSES]
    losses = [_curve(log, name, colour, name) for name, colour in zip(terms, cycle(TERM_COLOURS))]
    losses = [curve for curve in losses if (curve.y > 0).any()]
    psnr, count = (_curve(log, name, COLOURS["d"]) for name in ("quad_psnr_db", "gaussians"))
    plots = [
        Plot(title="Loss and its weighted terms", x=IMAGES, y="value", curves=losses, log_y=True),
        Plot(title="Quad PSNR", x=IMAGES, y="dB", curves=[psnr], from_zero=False),
        Plot(title="Gaussians", x=IMAGES, y="number N", curves=[count], log_y=False),
    ]
    return [svg(plot) for plot in plots if plot.curves]


def along_run(rows: Sequence[Mapping[str, float]]) -> list[bytes]:
    """Diagnostics over optimised images: errors if the truth is known, agreement, opacity, N.

    Args:
        rows: Those of ``diagnostics.jsonl``, see recon/diagnostics.py.
    """
    if not rows:
        return []
    plots = []
    for name in ("d", "d_tof"):
        curves = [
            _curve(rows, f"{group}{name}_mse_x100", COLOURS[name], label, dashes)
            for group, (label, dashes) in GROUPS.items()
        ]
        plots.append(Plot(title=f"Error of {NAMES[name]}", x=IMAGES, y=SQUARED, curves=curves))
    displaced = "length of the displacement"
    static = [
        _curve(rows, "d_minus_dtof_static_m", COLOURS["d"], "|d \N{MINUS SIGN} d_ToF|"),
        _curve(rows, "offset_static_m", COLOURS["d_normalised"], displaced, DASHED),
    ]
    plots.append(Plot(title="On static pixels", x=IMAGES, y="m", curves=static))
    for (title, unit), key in SINGLE.items():
        plots.append(Plot(title=title, x=IMAGES, y=unit, curves=[_curve(rows, key, COLOURS["d"])]))
    return [svg(plot) for plot in plots if any(len(curve.x) for curve in plot.curves)]


def error_over_frames(
    frames: Sequence[int],
    groups: Mapping[str, Mapping[str, Sequence[float | None]]],
    styles: Styles = OF_DISTANCES,
) -> list[bytes]:
    """Error of every scored frame, one plot per group of pixels.

    Args:
        frames: The scored raw frames n.
        groups: For each group of pixels the errors [m^2 x 100] by the name of the distance, None
            where there are none.
        styles: Colour and label of each distance.
    """
    x = np.asarray(frames, dtype=float)
    drawn = {
        group: {name: (x, np.array(row, float)) for name, row in errors.items()}  # None: NaN
        for group, errors in groups.items()
    }
    return _groups(drawn, styles, x="raw frame n", y=f"mean squared error [{SQUARED}]", points=True)


def error_histogram(
    errors: Mapping[str, Float[np.ndarray, "S H W"]],
    groups: Mapping[str, Bool[np.ndarray, "S H W"]],
    styles: Styles = OF_DISTANCES,
) -> list[bytes]:
    """Share of pixels over error [m] on a logarithmic axis, one plot per group of pixels.

    Args:
        errors: Squared errors [m^2] by the name of the distance, NaN where unknown.
        groups: Pixels to count, by name; each not empty.
        styles: Colour and label of each distance.
    """
    top = max(10.0 * FLOOR_M, *(float(np.sqrt(np.nanmax(error))) for error in errors.values()))
    edges = np.geomspace(FLOOR_M, top * 1.001, BINS + 1)
    stairs = np.repeat(edges, 2)
    drawn: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {group: {} for group in groups}
    for name, error in errors.items():
        width = np.log(edges[1] / edges[0])
        with np.errstate(divide="ignore"):
            position = np.log(error) * (0.5 / width) - np.log(FLOOR_M) / width
        known = ~np.isnan(position)
        bins = np.where(known, np.clip(position, 0, BINS - 1), 0).astype(np.uint8)
        for group, mask in groups.items():
            counts = np.bincount(bins[mask & known], minlength=BINS)
            share = np.repeat(counts / max(counts.sum(), 1), 2)
            drawn[group][name] = stairs, np.concatenate([[0.0], share, [0.0]])
    share_of = "share of these pixels"
    return _groups(drawn, styles, x="absolute error [m]", y=share_of, log_x=True, log_y=False)


def _groups(
    drawn: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    styles: Styles,
    *,
    points: bool = False,
    **axes: Any,
) -> list[bytes]:
    """One plot per group of pixels, with one curve (x, y) for each kind of distance."""
    plots = []
    for group, curves in drawn.items():
        lines = [
            Curve(x=across, y=up, colour=styles[name][0], label=styles[name][1], points=points)
            for name, (across, up) in curves.items()
        ]
        plots.append(Plot(title=group, curves=lines, **axes))
    return [svg(plot) for plot in plots]


def _curve(
    log: Sequence[Mapping[str, float]], name: str, colour: str, label: str = "", dashes: str = ""
) -> Curve:
    """A number of a log over optimised images."""
    steps = [(step["images"], step[name]) for step in log if step.get(name) is not None]
    points = np.array(steps, dtype=float).reshape(-1, 2)
    return Curve(x=points[:, 0], y=points[:, 1], colour=colour, label=label, dashes=dashes)
