"""The pictures of a report: the chosen frames and pixels, on common scales."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ..constants import SOURCES, SPEED_OF_LIGHT
from ..data.decode import quartet_phasor
from ..data.sequence import Sequence
from ..data.unwrap import CONFIDENT
from ..recon.residuals import Residuals
from . import controls, figures, page, pictures
from .gallery import Colour, Novel
from .metrics import ERROR_UNIT, per_frame_mean
from .views import Views

STRIP_FRAMES = 5  # columns of the strip over time
STRIP_SIZE_MAX = 160  # [px]
FILM_FRAMES_MAX = 48
FILM_PERIOD_S = 0.25  # [s] slow enough to compare panels
CLOSE_UP_MIN = 24  # [px] smallest side of a close-up
CLOSE_UP_MARGIN = 0.25  # around the moving pixels, as a fraction of their extent
CLOSE_UP_SHARE_MAX = 0.6  # a larger close-up would repeat the whole picture
PHASOR_TEXT = "The camera delivered real and imaginary part, taken as simultaneous."
QUARTET_TEXT = (
    "Each raw frame has its own time, during which objects move. The closed form takes the frames "
    "as simultaneous, hence the false distances along moving outlines."
)
SOURCE_NAMES = dict(zip(SOURCES, ("fit", "temporal mean", "closed form", "outline"), strict=True))
CHI_SQUARE_SHOWN = (0.1, 1000.0)  # on a logarithmic scale
TITLES = {"closed_form": "closed form", "d": "ours, d", "d_tof": "ours, d_ToF"}

Window = tuple[slice, slice]
WHOLE: Window = (slice(None), slice(None))


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """The S scored frames against ground truth."""

    truth: Float[np.ndarray, "S H W"]
    """True distance [m], NaN where unknown."""
    errors: Mapping[str, Float[np.ndarray, "S H W"]]
    """Squared errors [m^2] by the name of the distance, NaN where the truth is unknown."""
    moving: Bool[np.ndarray, "S H W"]
    """Pixels that move within their quartet."""
    static: Bool[np.ndarray, "S H W"]
    """Pixels that do not."""
    throughout: Bool[np.ndarray, "S H W"]
    """Of those, pixels whose distance does not change in the whole sequence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """The arrays of a comparison, from which a report is drawn."""

    sequence: Sequence
    """The measurement."""
    views: Views
    """Rendered and decoded images."""
    judgement: Judgement | None
    """Truth and errors; None without ground truth."""
    colour: Colour | None = None
    """Measured and rendered colour; None if one of both has no colour."""
    residuals: Residuals | None = None
    """How well the run explains the quads; None where it was not fitted to them."""
    novel: Novel | None = None
    """Novel views; None if the sequence has none."""

    @functools.cached_property
    def distance_scale(self) -> pictures.Scale:
        """One scale for every distance: the truth's, else that of the closed form and of ours."""
        if self.judgement is None:
            return pictures.distance_scale([self.views.closed_form, self.views.d])
        return pictures.distance_scale([self.judgement.truth])


def row_to_show(comparison: Comparison) -> int:
    """The row of the frame to show: in the middle half, the one with most moving pixels.

    Without ground truth, motion is estimated by the change between quads of one shift.
    """
    count = len(comparison.views.frames)
    middle = range(count // 4, max(count // 4 + 1, -(-3 * count // 4)))

    def rank(s: int) -> tuple[float, float]:
        if comparison.judgement is None:
            changed = _change(comparison.sequence, comparison.views.frames[s])
        else:
            changed = float(comparison.judgement.moving[s].sum())
        return changed, -abs(s - count / 2)  # of equals, the one nearest to the middle

    return max(middle, key=rank)


def measured_quartet(comparison: Comparison, s: int) -> str:
    """The quads of the quartet, or the phasor, and the decoded images."""
    sequence, frame = comparison.sequence, comparison.views.frames[s]
    quartet = frame // sequence.cycle
    re, im = quartet_phasor(sequence, quartet)
    if sequence.from_phasors:
        scale = pictures.signed_scale([re, im])
        note = f"{1e3 * sequence.times[frame]:.1f} ms"
        parts = {"real part": re, "imaginary part": im}
        measured = [page.picture(image, scale, title, note) for title, image in parts.items()]
    else:
        raw = range(sequence.cycle * quartet, sequence.cycle * (quartet + 1))
        scale = pictures.signed_scale([sequence.quads[n] for n in raw])
        measured = []
        for n in raw:
            note = f"shift {np.degrees(sequence.shifts[n]):.0f}°, {1e3 * sequence.times[n]:.1f} ms"
            if len(sequence.frequencies) > 1:
                note += f", {sequence.frame_frequencies[n] / 1e6:.4g} MHz"
            measured.append(page.picture(sequence.quads[n], scale, f"raw frame {n}", note))
    phase, amplitude = np.arctan2(im, re) % (2.0 * np.pi), np.hypot(re, im)
    closed_form, grey = comparison.views.closed_form[s], pictures.amplitude_scale([amplitude])
    decoded = [
        page.picture(phase, pictures.phase_scale(), "measured phase", "mod 2π"),
        page.picture(amplitude, grey, "measured amplitude", "of the phasor"),
        page.picture(closed_form, comparison.distance_scale, "closed form", "phase as distance"),
    ]
    text = f'<p class="soft">{PHASOR_TEXT if sequence.from_phasors else QUARTET_TEXT}</p>'
    figures = [*measured, *decoded, *_by_frequency(comparison, s), text]
    return "".join(page.row(figures[k : k + 4], columns=4) for k in range(0, len(figures), 4))


def _by_frequency(comparison: Comparison, s: int) -> list[str]:
    """Distances decoded from each of several frequencies alone, and their agreement."""
    views = comparison.views
    if views.single is None or views.confidence is None:
        return []
    figures = []
    for f, image in zip(comparison.sequence.frequencies, views.single[s], strict=True):
        reach = SPEED_OF_LIGHT / (2.0 * f)
        scale = pictures.Scale(low=0.0, high=reach, colours="viridis", unit="m")
        note = f"wraps at {reach:.3g} m"
        figures.append(page.picture(image, scale, f"{f / 1e6:.4g} MHz alone", note))
    note = f"{100.0 * float((views.confidence[s] < CONFIDENT).mean()):.2g} % ambiguous"
    title = "confidence of the turn"
    return [*figures, page.picture(views.confidence[s], _share_scale(1.0), title, note)]


def distances(comparison: Comparison, s: int, window: Window = WHOLE) -> str:
    """Closed form, ours and truth, on one scale."""
    scale = comparison.distance_scale
    return page.row(
        [
            page.picture(image[window], scale, title)
            for title, image in _distances(comparison, s).items()
        ]
    )


def error_maps(judged: Judgement, s: int, window: Window = WHOLE) -> str:
    """Absolute errors on one scale, in the order of :func:`distances`, and moving pixels.

    The errors of the closed form define the scale, on moving pixels if there are any.
    """
    scale = error_scale(judged, s)
    figures = [
        page.picture(np.sqrt(judged.errors[name][s][window]), scale, f"error of {title}")
        for name, title in TITLES.items()
    ]
    moves = judged.moving[s][window].astype(np.float32)
    return page.row([*figures, page.picture(moves, _share_scale(1.0), "moving pixels")])


def error_scale(judged: Judgement, s: int) -> pictures.Scale:
    """One scale [m] for all errors of a frame: that of the closed form, on moving pixels if any."""
    error, moving = np.sqrt(judged.errors["closed_form"][s]), judged.moving[s]
    return pictures.error_scale([error[moving] if moving.any() else error])


def close_up(comparison: Comparison, judged: Judgement, s: int) -> str:
    """Distances and errors around the moving pixels; empty if that is most of the image."""
    moving = judged.moving[s]
    if not moving.any():
        return ""
    window = _window(moving)
    if moving[window].size > CLOSE_UP_SHARE_MAX * moving.size:
        return ""
    return distances(comparison, s, window) + error_maps(judged, s, window)


def quad_residual(comparison: Comparison, s: int) -> str:
    """The quad of the frame: measured, rendered and the residual."""
    measured, rendered = comparison.views.quad_measured[s], comparison.views.quad_rendered[s]
    residual, left = measured - rendered, 1.0 - comparison.views.opacity[s]
    scale, finer = (pictures.signed_scale([image]) for image in (measured, residual))
    share = _share_scale(max(0.01, float(left.max())))
    figures = [
        page.picture(measured, scale, "measured quad", f"raw frame {comparison.views.frames[s]}"),
        page.picture(rendered, scale, "rendered quad", "same time and shift"),
        page.picture(residual, finer, "measured minus rendered", "its own scale"),
        page.picture(left, share, "transmittance", "1 \N{MINUS SIGN} opacity"),
    ]
    return page.row(figures)


def explained(comparison: Comparison, s: int) -> str:
    """Where the quads are explained: chi-square of the quartet, and how often each pixel is not."""
    if comparison.residuals is None:
        return ""
    of_quartet = comparison.residuals.quartets.index(
        comparison.views.frames[s] // comparison.sequence.cycle
    )
    maps = []
    if comparison.residuals.noisy:
        values = comparison.residuals.chi_square
        maps.append(chi_square(values[of_quartet], "chi-square", "of this quartet"))
        maps.append(chi_square(values.max(axis=0), "chi-square", "largest of all quartets"))
    often = comparison.residuals.unexplained.mean(axis=0, dtype=np.float32)
    title = "share of quartets that are not explained"
    return page.row([*maps, page.picture(often, _share_scale(1.0), title)], columns=4)


def chi_square(values: Float[np.ndarray, "H W"], title: str, note: str = "") -> str:
    """A picture of chi-square on a logarithmic scale."""
    low, high = np.log10(CHI_SQUARE_SHOWN)
    scale = pictures.Scale(low=low, high=high, colours="magma", unit="power of ten")
    return page.picture(np.log10(np.maximum(values, CHI_SQUARE_SHOWN[0])), scale, title, note)


def error_charts(
    comparison: Comparison,
    judged: Judgement,
    errors: Mapping[str, Float[np.ndarray, "S H W"]],
    styles: figures.Styles = figures.OF_DISTANCES,
) -> dict[str, list[bytes]]:
    """Error of every raw frame, and distribution of errors, by title: on all, moving and static
    pixels.

    Args:
        comparison: Whose frames they are.
        judged: What moves.
        errors: Squared errors [m^2] by the names of ``styles``.
        styles: Colour and label of each curve.
    """
    groups = {"all pixels": np.ones_like(judged.moving)}
    groups |= {"moving pixels": judged.moving, "static pixels": judged.static}
    groups = {name: mask for name, mask in groups.items() if mask.any()}
    per_frame = {
        group: {
            name: [None if v is None else ERROR_UNIT * v for v in per_frame_mean(error, mask)]
            for name, error in errors.items()
        }
        for group, mask in groups.items()
    }
    return {
        "Error of every raw frame": figures.error_over_frames(
            comparison.views.frames, per_frame, styles
        ),
        "Distribution of errors (the first bin holds all below a millimetre)": (
            figures.error_histogram(errors, groups, styles)
        ),
    }


def source(comparison: Comparison, s: int) -> str:
    """Where the distance of every pixel is from, and the fit alone."""
    if comparison.views.source is None or comparison.views.d_fit is None:
        return ""
    scale = pictures.Scale(low=0.0, high=len(SOURCE_NAMES) - 1.0, colours="gray", unit="")
    image, note = comparison.views.source[s].astype(np.float32), ", ".join(SOURCE_NAMES.values())
    alone = page.picture(comparison.views.d_fit[s], comparison.distance_scale, "the fit alone, d")
    picture = page.picture(image, scale, "source", f"black to white: {note}")
    return page.row([picture, alone], columns=4)


def strip_over_time(comparison: Comparison) -> str:
    """Distances at a few frames, one row each, on one scale."""
    count = len(comparison.views.frames)
    chosen = sorted({round(x) for x in np.linspace(0, count - 1, STRIP_FRAMES)})
    scale = comparison.distance_scale
    rows = []
    for title in (name for name in _distances(comparison, 0) if name != TITLES["d_tof"]):
        figures = []
        for s in chosen:
            rgb = _small(_distances(comparison, s)[title], scale)
            figures.append(page.plain_picture(rgb, title, f"frame {comparison.views.frames[s]}"))
        rows.append(page.row(figures, kind="strip"))
    return "".join(rows) + f'<div class="wide">{page.colour_bar(scale)}</div>'


def film(comparison: Comparison, shown: Mapping[str, tuple[np.ndarray, pictures.Scale]]) -> str:
    """The first frames of all quartets; empty if there is one only.

    Args:
        comparison: Whose frames they are.
        shown: By title, the images [S, H, W] of all scored frames, and their scale.
    """
    cycle = comparison.sequence.cycle
    starts = [s for s, n in enumerate(comparison.views.frames) if n % cycle == 0]
    starts = starts[:: -(-len(starts) // FILM_FRAMES_MAX)]
    if len(starts) < 2:
        return ""
    return controls.film(
        {
            title: ([_small(image[s], scale) for s in starts], page.colour_bar(scale))
            for title, (image, scale) in shown.items()
        },
        FILM_PERIOD_S,
    )


def film_of_run(comparison: Comparison) -> str:
    """A film of the measured quad, closed form and ours, and of the truth if known."""
    views = comparison.views
    quad, metres = pictures.signed_scale([views.quad_measured]), comparison.distance_scale
    shown = {
        "measured quad": (views.quad_measured, quad),
        TITLES["closed_form"]: (views.closed_form, metres),
        TITLES["d"]: (views.d, metres),
    }
    if comparison.judgement is None:
        shown["rendered quad"] = views.quad_rendered, quad
    else:
        shown["truth"] = comparison.judgement.truth, metres
    return film(comparison, shown)


def sliders(comparison: Comparison, s: int) -> str:
    """Closed form against ours: their distances, and their errors, or without truth the measured
    quad against the rendered one.
    """
    views, judged, titles = (
        comparison.views,
        comparison.judgement,
        (TITLES["closed_form"], TITLES["d"]),
    )
    pairs = [(views.closed_form[s], views.d[s], comparison.distance_scale, titles)]
    if judged is None:
        measured, rendered = views.quad_measured[s], views.quad_rendered[s]
        quads = pictures.signed_scale([measured])
        pairs.append((measured, rendered, quads, ("measured quad", "rendered quad")))
    else:
        before, after = (np.sqrt(judged.errors[name][s]) for name in ("closed_form", "d"))
        errors = f"error of {titles[0]}", f"error of {titles[1]}"
        pairs.append((before, after, error_scale(judged, s), errors))
    return '<div class="sliders">' + "".join(slider(*pair) for pair in pairs) + "</div>"


def slider(
    left: np.ndarray, right: np.ndarray, scale: pictures.Scale, titles: tuple[str, str]
) -> str:
    """Two images on one scale, one over the other."""
    rgb = [
        pictures.colour_mapped(pictures.thinned(image, page.PICTURE_SIZE_MAX), scale)
        for image in (left, right)
    ]
    bar = f'<div class="wide">{page.colour_bar(scale)}</div>'
    return controls.slider(rgb[0], rgb[1], titles, bar)


def _distances(comparison: Comparison, s: int) -> dict[str, np.ndarray]:
    """Images [m] by title: closed form, ours, and truth if known."""
    views, judged = comparison.views, comparison.judgement
    images = {title: getattr(views, name)[s] for name, title in TITLES.items()}
    return images if judged is None else images | {"truth": judged.truth[s]}


def _small(image: np.ndarray, scale: pictures.Scale) -> np.ndarray:
    return pictures.colour_mapped(pictures.thinned(image, STRIP_SIZE_MAX), scale)


def _share_scale(high: float) -> pictures.Scale:
    return pictures.Scale(low=0.0, high=high, colours="gray", unit="")


def _change(sequence: Sequence, n: int) -> float:
    """Largest mean change [quad units] to the quads of one shift one quartet earlier and later."""
    near = [m for m in (n - sequence.cycle, n + sequence.cycle) if 0 <= m < sequence.frames]
    near = [m for m in near if sequence.measured[m]]
    changes = (float(np.abs(sequence.quads[m] - sequence.quads[n]).mean()) for m in near)
    return max(changes, default=0.0)


def _window(mask: Bool[np.ndarray, "H W"]) -> Window:
    """The rectangle around a mask, with a margin."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return _widened(rows, mask.shape[0]), _widened(columns, mask.shape[1])


def _widened(indices: np.ndarray, size: int) -> slice:
    low, high = int(indices[0]), int(indices[-1]) + 1
    wanted = max(CLOSE_UP_MIN, round((1.0 + 2.0 * CLOSE_UP_MARGIN) * (high - low)))
    start = max(0, min((low + high - wanted) // 2, size - wanted))
    return slice(start, min(size, start + wanted))
