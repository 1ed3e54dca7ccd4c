"""The offline page of several runs of one sequence: numbers, pictures and curves side by side."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float

from . import figures, page, panels, provenance, tables
from .legend import TO_READ
from .panels import Comparison

CLOSED_FORM, TRUTH = "closed form", "truth"
RUN_COLOURS = "#0072b2 #009e73 #e69f00 #cc79a7 #56b4e9 #8c6d31 #666666".split()  # Okabe and Ito
SAID = {  # title of a column: key of metrics.json, how it is printed
    "quad PSNR": ("quad_psnr_db", "decibel"),
    "reduced chi-square": ("explained.reduced_chi_square", "ratio"),
    "not explained": ("explained.unexplained_share", "percent"),
    "Gaussians": ("gaussians", "count"),
    "images": ("images_optimised", "count"),
    "wall clock": ("seconds_reconstruct", "seconds"),
    "device": ("device", "text"),
    "preset": ("preset", "text"),
    "seed": ("seed", "text"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """One of the runs: its numbers, and the images that the page shows."""

    name: str
    """Its folder, as short as it differs from the others'."""
    config: Mapping[str, Any]
    """Content of config.json."""
    metrics: Mapping[str, Any]
    """What ``gftorf compare RUN`` writes to metrics.json."""
    d: Float[np.ndarray, "S H W"]
    """Its distance [m]."""
    error: Float[np.ndarray, "S H W"] | None
    """Squared error of it [m^2], NaN where the truth is unknown; None without truth."""
    chi_square: Float[np.ndarray, "h w"] | None
    """Of the quartet that the page shows [1], at the size of the fit; None: not known."""


def page_of(title: str, comparison: Comparison, runs: Sequence[Scored]) -> str:
    """The page.

    Args:
        title: Its heading.
        comparison: The arrays of the first run: sequence, truth and closed form are those of all.
        runs: All of them.
    """
    s = panels.row_to_show(comparison)
    sections = [
        f"<h1>{page.escape(title)}</h1>"
        f'<div class="soft">gftorf compare, version {page.escape(runs[0].metrics["version"])}'
        f'</div><p class="verdict">{_verdict(runs)}</p>',
        page.section("Errors", _errors(runs), _said(runs)),
        page.section("Side by side", _text(comparison, s), _sliders(comparison, runs, s)),
        *_film(comparison, runs),
        *_by_class(runs),
        page.section("Pictures", *_pictures(comparison, runs, s)),
        *_curves(comparison, runs),
        page.section("What differs", _differing(runs)),
        page.section("How it was made", *map(_made, runs)),
        page.section("How to read it", TO_READ),
    ]
    return page.document(f"{title} - gftorf compare", "".join(sections))


def _verdict(runs: Sequence[Scored]) -> str:
    """Which run is best, in a sentence."""
    first = runs[0].metrics
    if page.look_up(first, "d_mse_x100") is None:
        return "There is no ground truth, so distance errors are unknown."
    group, pixels = "", "over all pixels"
    if page.look_up(first, "moving.d_mse_x100") is not None:
        group, pixels = "moving.", "on moving pixels"
    key = f"{group}d_mse_x100"
    best = min(runs, key=lambda run: page.look_up(run.metrics, key))
    was = page.number(first, f"{group}closed_form_mse_x100", "rms_cm")
    name, error = page.escape(best.name), page.number(best.metrics, key, "rms_cm")
    return (
        f'<span class="ours">{name}</span> has the least error {pixels}: '
        f'<span class="ours">{error}</span> (root mean square); the '
        f'<span class="naive">closed form is off by {was}</span>.'
    )


def _errors(runs: Sequence[Scored]) -> str:
    """Errors of the closed forms, and of d of every run, the least in each column marked."""
    first = runs[0].metrics
    if page.look_up(first, "d_mse_x100") is None:
        return ""
    rows = [
        ("", [f"<b>{tables.ROWS[name][0]}</b>", *tables.error_cells(first, name)])
        for name in ("closed_form", "temporal")
        if page.look_up(first, f"{name}_mse_x100") is not None
    ]
    cells = [tables.error_cells(run.metrics, "d") for run in runs]
    for k, group in enumerate(tables.COLUMNS):
        values = [page.look_up(run.metrics, f"{group}d_mse_x100") for run in runs]
        known = [value for value in values if value is not None]
        for row, value in zip(cells, values, strict=True):
            if value is not None and value == min(known):
                row[k] = f"<strong>{row[k]}</strong>"
    for run, row in zip(runs, cells, strict=True):
        rows.append(("ours", [f"<b>{page.escape(run.name)}, d</b>", *row]))
    text = "Mean squared error of the distance, m² &times; 100, and its root; bold: the least."
    return f'<p class="soft">{text}</p>{page.table(tables.error_head(first), rows)}'


def _said(runs: Sequence[Scored]) -> str:
    """What else is known of every run."""
    rows = [
        (
            "",
            [
                f"<b>{page.escape(run.name)}</b>",
                *(page.number(run.metrics, key, form) for key, form in SAID.values()),
            ],
        )
        for run in runs
    ]
    return f"<h3>Runs</h3>{page.table(['', *SAID], rows)}"


def _text(comparison: Comparison, s: int) -> str:
    frame = comparison.views.frames[s]
    how = "The scroll bar, a swipe or the arrow keys move the edge."
    return page.caption(f"Raw frame {frame}: the first run, and every other one. {how}")


def _sliders(comparison: Comparison, runs: Sequence[Scored], s: int) -> str:
    """The first run against each other one: distance, and error if the truth is known."""
    first, *others = runs
    html, errors = "", panels.error_scale(comparison.judgement, s) if comparison.judgement else None
    for other in others:
        html += panels.slider(
            first.d[s], other.d[s], comparison.distance_scale, (first.name, other.name)
        )
        if first.error is not None and other.error is not None and errors is not None:
            images = np.sqrt(first.error[s]), np.sqrt(other.error[s])
            titles = f"error of {first.name}", f"error of {other.name}"
            html += panels.slider(*images, errors, titles)
    return f'<div class="sliders">{html}</div>'


def _film(comparison: Comparison, runs: Sequence[Scored]) -> list[str]:
    """The section of the film; none if there is one quartet only."""
    scale = comparison.distance_scale
    shown = {CLOSED_FORM: (comparison.views.closed_form, scale)}
    shown |= {run.name: (run.d, scale) for run in runs}
    if comparison.judgement is not None:
        shown[TRUTH] = comparison.judgement.truth, scale
    html = panels.film(comparison, shown)
    text = "Distance at the first raw frame of every quartet, slowed down."
    return [page.section("Quartet by quartet", page.caption(text), html)] if html else []


def _by_class(runs: Sequence[Scored]) -> list[str]:
    """Bars of the errors at edges and inside; none without truth."""
    first = runs[0].metrics
    series = {CLOSED_FORM: tables.Series("var(--naive)", first, "closed_form")}
    coloured = zip(runs, cycle(RUN_COLOURS), strict=False)
    series |= {run.name: tables.Series(colour, run.metrics, "d") for run, colour in coloured}
    bars = tables.bars(series)
    text = "Root mean squared error by the shape of the true distance around a pixel."
    return [page.section("Edges and slopes", page.caption(text), bars)] if bars else []


def _pictures(comparison: Comparison, runs: Sequence[Scored], s: int) -> list[str]:
    """Distances, errors and chi-square of one raw frame."""
    metres, judged = comparison.distance_scale, comparison.judgement
    distances = [page.picture(comparison.views.closed_form[s], metres, CLOSED_FORM)]
    distances += [page.picture(run.d[s], metres, run.name) for run in runs]
    html = []
    if judged is not None:
        distances.append(page.picture(judged.truth[s], metres, TRUTH))
        scale = panels.error_scale(judged, s)
        wrong = {CLOSED_FORM: judged.errors["closed_form"]}
        wrong |= {run.name: run.error for run in runs if run.error is not None}
        errors = [
            page.picture(np.sqrt(error[s]), scale, f"error of {name}")
            for name, error in wrong.items()
        ]
        html = ["<h3>Absolute error</h3>", page.row(errors, columns=4)]
    maps = [
        panels.chi_square(run.chi_square, f"chi-square of {run.name}")
        for run in runs
        if run.chi_square is not None
    ]
    if maps:
        html += ["<h3>Chi-square of the quads</h3>", page.row(maps, columns=4)]
    return [
        f"<h3>Distance, raw frame {comparison.views.frames[s]}</h3>",
        page.row(distances, 4),
        *html,
    ]


def _curves(comparison: Comparison, runs: Sequence[Scored]) -> list[str]:
    """Error of every raw frame, and the histogram of errors; none without truth."""
    judged = comparison.judgement
    if judged is None:
        return []
    errors = {CLOSED_FORM: judged.errors["closed_form"]}
    errors |= {run.name: run.error for run in runs if run.error is not None}
    colours = zip(errors, [figures.COLOURS["closed_form"], *RUN_COLOURS * len(runs)], strict=False)
    styles = {name: (colour, name) for name, colour in colours}
    drawn = panels.error_charts(comparison, judged, errors, styles)
    html = "".join(f"<h3>{title}</h3>{page.charts(svg, title)}" for title, svg in drawn.items())
    return [page.section("Curves", html)]


def differing(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Settings that are not the same in all configs: by dotted name, the value in each; None where
    it is absent.

    Args:
        configs: Content of every config.json by the name of the run.
    """
    flat = [dict(_flat(_chosen(config))) for config in configs.values()]
    names = dict.fromkeys(name for one in flat for name in one)
    rows = {name: [one.get(name) for one in flat] for name in names}
    return {name: row for name, row in rows.items() if any(value != row[0] for value in row)}


def _differing(runs: Sequence[Scored]) -> str:
    """Settings that are not the same in all runs."""
    rows = differing({run.name: run.config for run in runs})
    if not rows:
        return '<p class="soft">No setting: the runs should be the same.</p>'
    head = ["setting", *(page.escape(run.name) for run in runs)]
    return page.table(head, [("", [page.escape(k), *map(_value, row)]) for k, row in rows.items()])


def _chosen(config: Mapping[str, Any]) -> dict[str, Any]:
    """What was chosen for a run."""
    keys = ("preset", "ablation", "seed", "images", "flow", "changes", "device", "version")
    return {**{key: config.get(key) for key in keys}, **config.get("settings", {})}


def _flat(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested settings."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _value(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    return page.escape(value if isinstance(value, str) else json.dumps(value, default=str))


def _made(run: Scored) -> str:
    made: Mapping[str, Any] = run.config
    text = provenance.how(made, None, "", compared=run.metrics)
    return f"<details><summary>{page.escape(run.name)}</summary>{text}</details>"
