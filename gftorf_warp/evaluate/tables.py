"""The tables of a report: errors by distance and group of pixels, with the numbers of
metrics.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from . import page
from .metrics import DISTANCES

ROWS = {
    "closed_form": ("closed form", "decoded from the raw quads of a quartet"),
    "temporal_mean": ("temporal mean", "decoded from the mean of all quartets"),
    "temporal_median": ("temporal median", "decoded from their median, raw frame by raw frame"),
    "temporal": ("temporal", "mean of the quartets that agree with the median, else closed form"),
    "d": ("ours, d", "rendered mean distance, not divided by opacity"),
    "d_fit": ("the fit alone, d", "where the measurement does not replace it"),
    "d_normalised": ("ours, d / opacity", "the same, divided"),
    "d_median": ("ours, median", "distance at which one half of the light is stopped"),
    "d_tof": ("ours, d_ToF", "decoded from quads rendered at one instant"),
}
FACTS = (
    ("quad PSNR", "quad_psnr_db", "decibel"),
    ("colour PSNR", "colour_psnr_db", "decibel"),
    ("raw frames scored", "frames", "count"),
    ("protocol", "protocol", "text"),
    ("true distance", "against", "text"),
    ("Gaussians", "gaussians", "count"),
    ("optimised images", "images_optimised", "count"),
    ("reconstruction, wall clock", "seconds_reconstruct", "seconds"),
    ("device", "device", "text"),
    ("seed", "seed", "text"),
)
OPTIONAL = {"colour_psnr_db", "against"}  # left out where unknown
PIXELS = {"": "all pixels", "moving.": "moving pixels", "static.": "static pixels"}
COLUMNS = {**PIXELS, "static_throughout.": "static throughout"}
OF_CLASS = {
    "interior": "interior",
    "edge": "edge",
    "slope_0_10": "interior, 0 to 10 mm/px",
    "slope_10_20": "10 to 20 mm/px",
    "slope_20_40": "20 to 40 mm/px",
    "slope_over_40": "over 40 mm/px",
}
BARS = {"closed_form": "--naive", "temporal": "--other", "d": "--ours"}  # colours in page.css


class Series(NamedTuple):
    """One bar in every group of :func:`bars`."""

    colour: str  # as in CSS
    metrics: Mapping[str, Any]
    name: str  # of the distance


def errors(metrics: Mapping[str, Any]) -> str:
    """Errors of every distance that is known, on all, moving and static pixels."""
    if page.look_up(metrics, "d_mse_x100") is None:
        return '<p class="soft">No ground truth: distance errors are not known.</p>'
    rows = []
    for name in DISTANCES:
        if page.look_up(metrics, f"{name}_mse_x100") is None:
            continue
        title, note = ROWS[name]
        named = f'<b>{title}</b> <span class="soft note">{note}</span>'
        rows.append((_mark(name), [named, *error_cells(metrics, name)]))
    text = "Mean squared error of the distance, m² &times; 100, and its root."
    return f'<p class="soft">{text}</p>{page.table(error_head(metrics), rows)}'


def error_head(metrics: Mapping[str, Any]) -> list[str]:
    """Titles of the columns of :func:`errors`, with shares of pixels."""
    head = [""]
    for group, name in COLUMNS.items():
        share = f"{page.number(metrics, f'{group}share', 'percent')} of all" if group else "&nbsp;"
        head.append(f"{name}<span class='soft'>{share}</span>")
    return head


def error_cells(metrics: Mapping[str, Any], name: str) -> list[str]:
    """Errors of one distance, in the columns of :func:`errors` behind its name."""
    return [_error_and_root(metrics, f"{group}{name}_mse_x100") for group in COLUMNS]


def facts(metrics: Mapping[str, Any]) -> str:
    """Other values of metrics.json, each with a short explanation."""
    items = "".join(
        f"<li><b>{page.number(metrics, key, form)}</b>{name}</li>"
        for name, key, form in FACTS
        if key not in OPTIONAL or page.look_up(metrics, key) is not None
    )
    return f'<ul class="facts">{items}</ul>'


def series_of(metrics: Mapping[str, Any]) -> dict[str, Series]:
    """What :func:`bars` shows of one run."""
    return {ROWS[name][0]: Series(f"var({colour})", metrics, name) for name, colour in BARS.items()}


def bars(series: Mapping[str, Series]) -> str:
    """Bars of errors [cm] at edges and inside, of moving and of static pixels; empty without truth.

    Args:
        series: What is drawn, by its label.
    """
    groups = {
        f"{group}, {kind}": f"classes.{group}.{kind}"
        for group in ("moving", "static")
        for kind in ("edge", "interior")
    }
    values = {
        (key, label): page.look_up(one.metrics, f"{key}.{one.name}_mse_x100")
        for key in groups.values()
        for label, one in series.items()
    }
    known = {cell: value for cell, value in values.items() if value is not None}
    if not known:
        return ""
    largest = max(*known.values(), 1e-9) ** 0.5  # roots are drawn
    rows = ""
    for title, key in groups.items():
        drawn = "".join(
            f'<i style="--part: {known[key, label] ** 0.5 / largest:.4f}; --colour: {one.colour}">'
            f"{page.number(one.metrics, f'{key}.{one.name}_mse_x100', 'rms_cm')}</i>"
            for label, one in series.items()
            if (key, label) in known
        )
        if drawn:
            share = page.number(next(iter(series.values())).metrics, f"{key}.share", "percent")
            rows += f'<b>{title}<span class="soft">{share}</span></b><div>{drawn}</div>'
    labels = [label for label in series if any(label == known_label for _, known_label in known)]
    key = "".join(
        f'<span style="--colour: {series[label].colour}">{page.escape(label)}</span>'
        for label in labels
    )
    return f'<div class="key">{key}</div><div class="bars">{rows}</div>'


def by_class(metrics: Mapping[str, Any]) -> str:
    """Errors of moving and of static pixels at edges, and inside by the slope of the truth."""
    html = ""
    for group in ("moving", "static"):
        key, head, rows = f"classes.{group}", [""], []
        for kind, name in OF_CLASS.items():
            share = page.number(metrics, f"{key}.{kind}.share", "percent")
            head.append(f"{name}<span class='soft'>{share}</span>")
        for name in DISTANCES:
            keys = [f"{key}.{kind}.{name}_mse_x100" for kind in OF_CLASS]
            if any(page.look_up(metrics, one) is not None for one in keys):
                cells = [page.number(metrics, one, "error") for one in keys]
                rows.append((_mark(name), [f"<b>{ROWS[name][0]}</b>", *cells]))
        html += f"<h3>{PIXELS[f'{group}.'].capitalize()}</h3>"
        html += page.table(head, rows) if rows else '<p class="soft">There are none.</p>'
    return html


def _mark(name: str) -> str:
    """Class of the row of a distance."""
    return "ours" if name == "d" else ""


def _error_and_root(metrics: Mapping[str, Any], key: str) -> str:
    if page.look_up(metrics, key) is None:
        return page.number(metrics, key, "error")
    error, root = (page.number(metrics, key, form) for form in ("error", "rms_cm"))
    return f'{error} <span class="soft">{root}</span>'
