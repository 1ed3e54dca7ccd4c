"""Curves and histograms as SVG files, the same bytes every time."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

COLOURS = {"closed_form": "#d55e00", "d": "#0072b2", "d_normalised": "#56b4e9", "d_tof": "#009e73"}  # Okabe and Ito
NAMES = {"closed_form": "closed form", "d": "d", "d_normalised": "d / opacity", "d_tof": "d_ToF"}
NOT_LOSSES = {"images", "seconds", "gaussians", "quad_psnr_db", "opacity"}  # what else a log step holds
LOG_SPAN = 20.0  # values that span more than this factor are drawn on a logarithmic axis
FLOOR_M = 1e-3  # [m] smaller errors fall into the first bin of the histogram
BINS = 60
ALONG_COLUMNS = 3
STATIC_CURVES = {  # key of a row of diagnostics: label, line, colour
    "d_minus_dtof_static_m": (r"|d $-$ d_ToF|", "-", COLOURS["d"]),
    "offset_static_m": ("length of the displacement", "--", COLOURS["d_normalised"]),
}
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "gftorf_warp",  # element ids would be random without
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def training_curves(log: Sequence[Mapping[str, float]]) -> bytes | None:
    """Loss terms, quad PSNR and number of Gaussians over optimised images; None if nothing was logged.

    Args:
        log: Steps of ``metrics.jsonl``: images, seconds, gaussians, quad_psnr_db and the loss terms by name.
    """
    if not log:
        return None
    terms = [name for name in dict.fromkeys(key for step in log for key in step) if name not in NOT_LOSSES]

    def draw(figure):
        loss, psnr, count = figure.subplots(1, 3)
        for name in terms:
            x, y = _curve(log, name)
            if (y > 0).any():
                loss.plot(x, np.where(y > 0, y, np.nan), label=name, linewidth=1.4)
        loss.set_yscale("log")
        loss.set(title="Loss and its weighted terms", xlabel="optimised images", ylabel="value")
        loss.legend(fontsize=8)
        psnr.plot(*_curve(log, "quad_psnr_db"), color=COLOURS["d"])
        psnr.set(title="Quad PSNR", xlabel="optimised images", ylabel="dB")
        count.plot(*_curve(log, "gaussians"), color=COLOURS["d"])
        count.set(title="Gaussians", xlabel="optimised images", ylabel="number N", ylim=(0, None))

    return _svg(draw, 11.0, 2.9)


def along_run(rows: Sequence[Mapping[str, float]]) -> bytes | None:
    """What diagnostics saw over optimised images: errors if truth is known, agreement, opacity, number of Gaussians.

    Args:
        rows: Those of ``diagnostics.jsonl``, see recon/diagnostics.py.
    """
    if not rows:
        return None
    errors = ("d", "d_tof")
    plots = [(f"Error of {NAMES[name]}", r"m$^2$ $\times$ 100", _error_curves(name)) for name in errors]
    plots.append(("On static pixels", "m", STATIC_CURVES))
    plots.append(("Light let through", r"mean of 1 $-$ opacity", {"transmittance": ("T_e", "-", COLOURS["d"])}))
    plots.append(("Depth distortion", "m$^2$", {"distortion": ("mean", "-", COLOURS["d"])}))
    plots.append(("Gaussians", "number N", {"gaussians": ("N", "-", COLOURS["d"])}))
    plots = [plot for plot in plots if any(row.get(key) is not None for row in rows for key in plot[2])]

    def draw(figure):
        axes = np.ravel(figure.subplots(-(-len(plots) // ALONG_COLUMNS), ALONG_COLUMNS))
        for unused in axes[len(plots) :]:
            unused.set_visible(False)
        for plot, (title, unit, curves) in zip(axes, plots, strict=False):
            drawn = []
            for key, (label, line, colour) in curves.items():
                x, y = _curve(rows, key)
                if len(x):
                    plot.plot(x, y, line, color=colour, label=label, linewidth=1.4)
                    drawn.append(y)
            _choose_axis(plot, np.concatenate(drawn))
            plot.set(title=title, xlabel="optimised images", ylabel=unit)
            if len(drawn) > 1:
                plot.legend(fontsize=8)

    return _svg(draw, 11.0, 2.7 * -(-len(plots) // ALONG_COLUMNS))


def _error_curves(name: str) -> dict[str, tuple[str, str, str]]:
    groups = {"": ("all pixels", "-"), "moving.": ("moving pixels", "--"), "static.": ("static pixels", ":")}
    return {f"{prefix}{name}_mse_x100": (label, line, COLOURS[name]) for prefix, (label, line) in groups.items()}


def error_over_frames(frames: Sequence[int], groups: Mapping[str, Mapping[str, Sequence[float | None]]]) -> bytes:
    """Error of every scored frame, one plot per group of pixels.

    Args:
        frames: The scored raw frames n.
        groups: For each group of pixels the errors [m^2 x 100] by the name of the distance, None where there are none.
    """

    def draw(figure):
        for plot, (group, errors) in zip(np.ravel(figure.subplots(1, len(groups))), groups.items(), strict=True):
            rows = {name: np.array([np.nan if v is None else v for v in row], float) for name, row in errors.items()}
            for name, row in rows.items():
                plot.plot(frames, row, ".-", color=COLOURS[name], label=NAMES[name], linewidth=1.2, markersize=4)
            _choose_axis(plot, np.concatenate(list(rows.values())))
            plot.set(title=group, xlabel="raw frame n", ylabel=r"mean squared error [m$^2$ $\times$ 100]")
        _legend(figure, plot)

    return _svg(draw, 11.0, 3.0)


def error_histogram(
    errors: Mapping[str, Float[np.ndarray, "S H W"]], groups: Mapping[str, Bool[np.ndarray, "S H W"]]
) -> bytes:
    """How large the errors are, one plot per group of pixels: share of pixels over error [m], both logarithmic.

    Args:
        errors: Squared errors [m^2] by the name of the distance, NaN where unknown.
        groups: Pixels to count, by name; each not empty.
    """
    top = max(10.0 * FLOOR_M, *(float(np.sqrt(np.nanmax(error))) for error in errors.values()))
    edges = np.geomspace(FLOOR_M, top * 1.001, BINS)

    def draw(figure):
        for plot, (group, mask) in zip(np.ravel(figure.subplots(1, len(groups))), groups.items(), strict=True):
            for name, error in errors.items():
                size = np.sqrt(error[mask & ~np.isnan(error)])
                counts, _ = np.histogram(np.maximum(size, FLOOR_M), bins=edges)
                plot.stairs(counts / size.size, edges, color=COLOURS[name], label=NAMES[name], linewidth=1.4)
            plot.set_xscale("log")
            plot.set(title=group, xlabel="absolute error [m]", ylabel="share of these pixels")
        _legend(figure, plot)

    return _svg(draw, 11.0, 2.8)


def _curve(log: Sequence[Mapping[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    steps = [(step["images"], step[name]) for step in log if step.get(name) is not None]
    points = np.array(steps, dtype=float).reshape(-1, 2)
    return points[:, 0], points[:, 1]


def _choose_axis(plot, values: np.ndarray) -> None:
    known = values[np.isfinite(values)]
    if known.size and known.min() > 0 and known.max() > LOG_SPAN * known.min():
        plot.set_yscale("log")
    else:
        plot.set_ylim(0, None)


def _legend(figure, plot) -> None:
    """One legend for all plots, beside them: it hides nothing."""
    figure.legend(*plot.get_legend_handles_labels(), loc="outside right upper", fontsize=8)


def _svg(draw, width: float, height: float) -> bytes:
    """The SVG file of what ``draw(figure)`` draws; sizes in inches of 72 px."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    file = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        FigureCanvasSVG(figure)
        draw(figure)
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()
