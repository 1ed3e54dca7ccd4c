"""The offline page of a comparison: results in pictures and numbers, and how they were made."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

from ..data.decode import unambiguous_range
from ..data.threads import KeptThreads
from ..recon.residuals import problems
from ..render.buffers import available_threads
from . import figures, gallery, page, panels, provenance, tables
from .legend import PHASORS_TO_READ, TO_READ
from .panels import Comparison

WITHOUT_GAUSSIANS = {
    "ctof": "the closed form itself",
    "temporal": "the closed form, averaged over time where nothing moves",
    "flow2d": "the closed form of raw frames that optical flow brought to one time",
}
COUNTED = {3: "three", 4: "four", 5: "five", 6: "six", 8: "eight"}
ALONG_TEXT = (
    "Rendered over black at a few fixed raw frames, at the size of the optimisation, which does "
    "not use these numbers. Where d and d_ToF differ on static pixels, light is explained by "
    "layers instead of surfaces"
)


def report(
    *,
    title: str,
    metrics: Mapping[str, Any],
    config: Mapping[str, Any],
    log: Sequence[Mapping[str, float]],
    comparison: Comparison,
    diagnostics: Sequence[Mapping[str, float]] = (),
    installed: str = "",
    data_card: str | None = None,
    simulated: str | None = None,
) -> str:
    """The page, from the files of the run.

    ``metrics`` is the content of metrics.json, source of all printed results; ``log`` and
    ``diagnostics`` are rows of metrics.jsonl and diagnostics.jsonl; ``installed`` is the software
    of the comparison, ``data_card`` the statement on the truth in the sequence's README, and
    ``simulated`` the command there that made it.
    """
    s = panels.row_to_show(comparison)
    # pictures are encoded without the GIL
    with KeptThreads("gftorf-report", available_threads()) as pool:
        distances = pool.submit(_distance_pictures, comparison, s)
        measured = pool.submit(panels.measured_quartet, comparison, s)
        residual = pool.submit(panels.quad_residual, comparison, s)
        explained = pool.submit(_explained, metrics, comparison, s)
        sliders = pool.submit(panels.sliders, comparison, s)
        film = pool.submit(panels.film_of_run, comparison)
        strip = pool.submit(panels.strip_over_time, comparison)
        beyond = pool.submit(_beyond, metrics, comparison)
        curves = pool.submit(_curves, comparison, log)
    about_phasors = PHASORS_TO_READ if comparison.sequence.from_phasors else ""
    made = provenance.how(config, data_card, installed, compared=metrics, simulated=simulated)
    sections = [
        f"<h1>{page.escape(title)}</h1>"
        f'<div class="soft">gftorf compare, version {page.number(metrics, "version", "text")}</div>'
        f'<p class="verdict">{verdict(metrics)}</p>',
        page.section("Before and after", _sliders_text(comparison, s), sliders.result()),
        *_film(film.result()),
        page.section("Errors", tables.errors(metrics), tables.facts(metrics)),
        *_by_class(metrics),
        page.section("Distance", _distance_text(comparison, s), distances.result()),
        page.section("What was measured", _measured_text(comparison, s), measured.result()),
        page.section("Quads", _quad_text(comparison, s), residual.result()),
        *explained.result(),
        page.section("Over time", strip.result()),
        *beyond.result(),
        *_along(metrics, diagnostics),
        page.section("Curves", curves.result()),
        page.section("How it was made", made),
        page.section("How to read it", TO_READ, about_phasors),
    ]
    return page.document(f"{title} - gftorf compare", "".join(sections))


def verdict(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences of HTML, with the numbers of metrics.json."""
    text = _result(metrics)
    if problems(metrics.get("explained")):
        warning = '<span class="naive">The fit does not explain what was measured</span>'
        text += f" {warning}, see below."
    for caveat in metrics.get("caveats", ()):
        text += f' <span class="naive">{page.escape(caveat)}</span>'
    return text


def _result(metrics: Mapping[str, Any]) -> str:
    """The errors in one or two sentences."""
    number = functools.partial(page.number, metrics)
    if page.look_up(metrics, "d_mse_x100") is None:
        psnr = f'<span class="ours">{number("quad_psnr_db", "decibel")}</span>'
        unknown = "There is no ground truth, so distance errors are unknown."
        return f"{unknown} The PSNR of rendered quads is {psnr}."
    group = "moving." if page.look_up(metrics, "moving.d_mse_x100") is not None else ""
    if metrics.get("method") in WITHOUT_GAUSSIANS:
        where, which = "on moving pixels" if group else "over all pixels", metrics["method"]
        return (
            f"This run is {WITHOUT_GAUSSIANS[which]}: nothing was optimised. Its error is "
            f"{number(f'{group}d_mse_x100', 'rms_cm')} {where} (root mean square)."
        )
    naive, ours = f"{group}closed_form_mse_x100", f"{group}d_mse_x100"
    pixels = "Over all pixels"
    if group:
        pixels = f"On moving pixels ({number('moving.share', 'percent')} of all)"
    text = (
        f'{pixels}, the <span class="naive">closed form is off by {number(naive, "rms_cm")}</span> '
        f'and <span class="ours">ours by {number(ours, "rms_cm")}</span> (root mean square): '
        f"{_comparison(metrics, naive, ours)}."
    )
    if group and page.look_up(metrics, "static.d_mse_x100") is not None:
        was = number("static.closed_form_mse_x100", "rms_cm")
        text += f" On static pixels, it is {was} against {number('static.d_mse_x100', 'rms_cm')}."
    return text


def _comparison(metrics: Mapping[str, Any], naive: str, ours: str) -> str:
    """Our error relative to that of the closed form, in words."""
    was, now = page.look_up(metrics, naive), page.look_up(metrics, ours)
    before, after = (page.number(metrics, key, "error") for key in (naive, ours))
    values = f"{before} against {after} m² &times; 100"
    if not (was > 0 and now > 0):
        return f"a squared error of {values}"
    if now <= was:
        return f"{page.ratio(metrics, naive, ours)} times less squared error, {values}"
    return f"{page.ratio(metrics, ours, naive)} times <em>more</em> squared error, {values}"


def _by_class(metrics: Mapping[str, Any]) -> list[str]:
    """The section of errors at edges and on slopes; none without truth."""
    if page.look_up(metrics, "classes") is None:
        return []
    text = "Root mean squared error by the shape of the true distance around a pixel."
    more = "<summary>In m² &times; 100, all distances and slopes</summary>"
    details = f"<details>{more}{tables.by_class(metrics)}</details>"
    return [
        page.section(
            "Edges and slopes", page.caption(text), tables.bars(tables.series_of(metrics)), details
        )
    ]


def _sliders_text(comparison: Comparison, s: int) -> str:
    frame = comparison.views.frames[s]
    return page.caption(
        f"Raw frame {frame}: the closed form, as a camera computes it, and ours. The scroll bar, a "
        "swipe or the arrow keys move the edge."
    )


def _film(html: str) -> list[str]:
    """The section of the film, if there is one."""
    text = "The first raw frame of every quartet, slowed down."
    return [page.section("Quartet by quartet", page.caption(text), html)] if html else []


def _distance_text(comparison: Comparison, s: int) -> str:
    reason, scale = "most moving pixels", "the truth's"
    if comparison.judgement is None:
        reason, scale = "the largest change of quads", "one"
    return page.caption(
        f"Distance along the ray, on {scale} scale, of raw frame {comparison.views.frames[s]}: the "
        f"one with {reason} in the middle half of the sequence."
    )


def _measured_text(comparison: Comparison, s: int) -> str:
    frame, sequence = comparison.views.frames[s], comparison.sequence
    if sequence.from_phasors:
        return page.caption(f"The phasor of raw frame {frame}. Red is positive, blue negative.")
    count = COUNTED.get(sequence.cycle, str(sequence.cycle))
    differ = "phase shift" if len(sequence.frequencies) == 1 else "phase shift, frequency"
    return page.caption(
        f"The quartet of raw frame {frame}: {count} raw frames, each with its own {differ} and its "
        f"own time. Distances are known modulo {unambiguous_range(sequence):.4g} m. Red is "
        "positive, blue negative."
    )


def _distance_pictures(comparison: Comparison, s: int) -> str:
    html = panels.distances(comparison, s)
    if comparison.judgement is None:
        return html
    html += f"<h3>Absolute error</h3>{panels.error_maps(comparison.judgement, s)}"
    html += page.caption(
        "One scale for all three, defined by the errors of the closed form on moving pixels; "
        "larger errors are clamped."
    )
    close_up = panels.close_up(comparison, comparison.judgement, s)
    return html + (f"<h3>Close-up of moving pixels</h3>{close_up}" if close_up else "")


def _quad_text(comparison: Comparison, s: int) -> str:
    which = f"The quad of raw frame {comparison.views.frames[s]}"
    if comparison.sequence.from_phasors:
        which = "The quad of shift zero, half the real part of the phasor"
    return page.caption(
        f"{which}, measured and rendered at its time and pose over a black background; the "
        "residual should look like noise."
    )


def _explained(metrics: Mapping[str, Any], comparison: Comparison, s: int) -> list[str]:
    """The section on how well the quads are explained; none if they were not fitted."""
    if page.look_up(metrics, "explained") is None:
        return []
    share = page.number(metrics, "explained.unexplained_share", "percent")
    text = f"{share} of the pixels are not explained by the fit"
    if page.look_up(metrics, "explained.reduced_chi_square") is not None:
        mean = page.number(metrics, "explained.reduced_chi_square", "ratio")
        text += f"; the reduced chi-square of the quads is {mean}, and one for noise alone"
    if page.look_up(metrics, "explained.changing_unexplained_share") is not None:
        changing = page.number(metrics, "explained.changing_unexplained_share", "percent")
        text += f"; of those that change over time, {changing} are not explained"
    if page.look_up(metrics, "explained.contradicted_share") is not None:
        wrong = page.number(metrics, "explained.contradicted_share", "percent")
        text += f"; of those that do not, {wrong} are far from the distance of their temporal mean"
    text = page.caption(f"{text}. Each raw frame at its own time, at the size of the fit.")
    html = panels.explained(comparison, s)
    if page.look_up(metrics, "source") is not None:
        shares = [
            f"{name} {page.number(metrics, f'source.{key}', 'percent')}"
            for key, name in panels.SOURCE_NAMES.items()
        ]
        html += page.caption(f"Where our distance is from: {', '.join(shares)}.") + panels.source(
            comparison, s
        )
    return [page.section("How well the quads are explained", text, html)]


def _beyond(metrics: Mapping[str, Any], comparison: Comparison) -> list[str]:
    """Sections of colour and of novel views, where there are any."""
    sections = []
    if comparison.colour is not None:
        psnr = page.number(metrics, "colour_psnr_db", "decibel")
        text = f"From the colour camera, at the time of the raw frame. Its PSNR is {psnr}."
        sections.append(
            page.section("Colour", page.caption(text), gallery.colour_strip(comparison.colour))
        )
    if comparison.novel is not None:
        text = "The reconstruction in the middle of the sequence, from its novel poses."
        text = page.caption(f"{text} Grey: opacity below one half.")
        strip = gallery.novel_strip(comparison.novel, comparison.distance_scale)
        sections.append(page.section("Novel views", text, strip))
    return sections


def _along(metrics: Mapping[str, Any], rows: Sequence[Mapping[str, float]]) -> list[str]:
    """The section of diagnostics; none if there were none."""
    drawings = figures.along_run(rows)
    if not drawings:
        return []
    along = metrics.get("diagnostics") or {}

    def number(name: str, form: str) -> str:
        return page.number(metrics, f"diagnostics.{name}", form)

    text = ALONG_TEXT
    if along.get("criterion_m_least") is not None:
        text += (
            f"; their difference is least, {number('criterion_m_least', 'length_cm')}, after "
            f"{number('images_at_criterion', 'count')} images"
        )
        if along.get("d_mse_x100_at_criterion") is not None:
            text += f", where the error of d is {number('d_mse_x100_at_criterion', 'error')}"
    text += "."
    if along.get("d_mse_x100_least") is not None:
        text += (
            f" The error of d is least, {number('d_mse_x100_least', 'error')}, after "
            f"{number('images_at_least', 'count')} images."
        )
    return [
        page.section("Along the run", page.caption(text), page.charts(drawings, "Along the run"))
    ]


def _curves(comparison: Comparison, log: Sequence[Mapping[str, float]]) -> str:
    charts = []
    training = figures.training_curves(log)
    if training:
        charts.append(("During optimisation", training))
    if comparison.judgement is not None:
        errors = {name: comparison.judgement.errors[name] for name in panels.TITLES}
        charts += panels.error_charts(comparison, comparison.judgement, errors).items()
    return "".join(f"<h3>{title}</h3>{page.charts(drawings, title)}" for title, drawings in charts)
