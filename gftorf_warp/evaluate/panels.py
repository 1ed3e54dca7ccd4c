"""The pictures of a report: the chosen frames and pixels, on common scales."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ..constants import SPEED_OF_LIGHT
from ..data.decode import quartet_phasor
from ..data.sequence import Sequence
from ..data.unwrap import CONFIDENT
from . import page, pictures
from .gallery import Colour, Novel
from .views import Views

STRIP_FRAMES = 5  # columns of the strip over time
STRIP_SIZE_MAX = 160  # [px]
ANIMATION_FRAMES_MAX = 48
ANIMATION_PERIOD_S = 0.25  # [s] slow enough to compare panels
CLOSE_UP_MIN = 24  # [px] smallest side of a close-up
CLOSE_UP_MARGIN = 0.25  # around the moving pixels, as a fraction of their extent
CLOSE_UP_SHARE_MAX = 0.6  # a larger close-up would repeat the whole picture
PHASOR_TEXT = "The camera delivered real and imaginary part, taken as simultaneous."
QUARTET_TEXT = (
    "Each raw frame has its own time, during which objects move. The closed form takes the "
    "frames as simultaneous, "
    "hence the false distances along moving outlines."
)
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """The arrays of a comparison, from which a report is drawn."""

    sequence: Sequence
    """The measurement."""
    views: Views
    """Rendered and decoded images."""
    judgement: Judgement | None
    """Truth and errors; None without ground truth."""
    colour: Colour | None = None
    """Measured and rendered colour; None if one of both has no colour."""
    novel: Novel | None = None
    """Novel views; None if the sequence has none."""

    @functools.cached_property
    def distance_scale(self) -> pictures.Scale:
        """One scale for every distance in the report: the truth's,
        else that of the closed form and of ours.
        """
        known = (
            [self.views.closed_form, self.views.d]
            if self.judgement is None
            else [self.judgement.truth]
        )
        return pictures.distance_scale(known)


def telling_row(found: Findings) -> int:
    """The row of the frame to show: in the middle half, the one with most moving pixels.

    Without ground truth, motion is estimated by the change between quads of one shift.
    """
    count = len(found.views.frames)
    middle = range(count // 4, max(count // 4 + 1, -(-3 * count // 4)))

    def telling(s: int) -> tuple[float, float]:
        judged = found.judgement
        changed = (
            _change(found.sequence, found.views.frames[s])
            if judged is None
            else float(judged.moving[s].sum())
        )
        return changed, -abs(s - count / 2)  # of equals, the one nearest to the middle

    return max(middle, key=telling)


def measured_quartet(found: Findings, s: int) -> str:
    """The quads of the quartet, or the phasor, and the decoded images."""
    sequence, frame = found.sequence, found.views.frames[s]
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
        measured = [
            page.picture(
                sequence.quads[n],
                scale,
                f"raw frame {n}",
                f"shift {np.degrees(sequence.shifts[n]):.0f}°, {1e3 * sequence.times[n]:.1f} ms"
                + (
                    f", {sequence.frame_frequencies[n] / 1e6:.4g} MHz"
                    if len(sequence.frequencies) > 1
                    else ""
                ),
            )
            for n in raw
        ]
    phase, amplitude = np.arctan2(im, re) % (2.0 * np.pi), np.hypot(re, im)
    decoded = [
        page.picture(phase, pictures.phase_scale(), "measured phase", "mod 2π"),
        page.picture(
            amplitude, pictures.amplitude_scale([amplitude]), "measured amplitude", "of the phasor"
        ),
        page.picture(
            found.views.closed_form[s], found.distance_scale, "closed form", "phase as distance"
        ),
    ]
    text = f'<p class="soft">{PHASOR_TEXT if sequence.from_phasors else QUARTET_TEXT}</p>'
    figures = [*measured, *decoded, *_by_frequency(found, s), text]
    return "".join(page.row(figures[k : k + 4], columns=4) for k in range(0, len(figures), 4))


def _by_frequency(found: Findings, s: int) -> list[str]:
    """Distances decoded from each of several frequencies alone, and their agreement."""
    views = found.views
    if views.single is None or views.confidence is None:
        return []
    pictures_of = []
    for f, image in zip(found.sequence.frequencies, views.single[s], strict=True):
        scale = pictures.Scale(
            low=0.0, high=SPEED_OF_LIGHT / (2.0 * f), colours="viridis", unit="m"
        )
        pictures_of.append(
            page.picture(image, scale, f"{f / 1e6:.4g} MHz alone", f"wraps at {scale.high:.3g} m")
        )
    share = float((views.confidence[s] < CONFIDENT).mean())
    note = f"{100.0 * share:.2g} % ambiguous"
    return [
        *pictures_of,
        page.picture(views.confidence[s], _share_scale(1.0), "confidence of the turn", note),
    ]


def distances(found: Findings, s: int, window: Window = WHOLE) -> str:
    """Closed form, ours and truth, on one scale."""
    scale = found.distance_scale
    return page.row(
        [page.picture(image[window], scale, title) for title, image in _distances(found, s).items()]
    )


def error_maps(judged: Judgement, s: int, window: Window = WHOLE) -> str:
    """Absolute errors on one scale, in the order of :func:`distances`; under the truth,
    moving pixels.
    """
    scale = pictures.error_scale([_scale_errors(judged, s)])
    figures = [
        page.picture(np.sqrt(judged.errors[name][s][window]), scale, f"error of {title}")
        for name, title in TITLES.items()
    ]
    moves = judged.moving[s][window].astype(np.float32)
    return page.row([*figures, page.picture(moves, _share_scale(1.0), "moving pixels")])


def close_up(found: Findings, judged: Judgement, s: int) -> str:
    """Distances and errors around the moving pixels; empty if that is most of the image."""
    moving = judged.moving[s]
    if not moving.any():
        return ""
    window = _window(moving)
    if moving[window].size > CLOSE_UP_SHARE_MAX * moving.size:
        return ""
    return distances(found, s, window) + error_maps(judged, s, window)


def quad_residual(found: Findings, s: int) -> str:
    """The quad of the frame: measured, rendered and the residual."""
    measured, rendered = found.views.quad_measured[s], found.views.quad_rendered[s]
    scale = pictures.signed_scale([measured])
    residual, left = measured - rendered, 1.0 - found.views.opacity[s]
    figures = [
        page.picture(measured, scale, "measured quad", f"raw frame {found.views.frames[s]}"),
        page.picture(rendered, scale, "rendered quad", "same time and shift"),
        page.picture(
            residual, pictures.signed_scale([residual]), "measured minus rendered", "its own scale"
        ),
        page.picture(
            left,
            _share_scale(max(0.01, float(left.max()))),
            "transmittance",
            "1 \N{MINUS SIGN} opacity",
        ),
    ]
    return page.row(figures)


def strip_over_time(found: Findings) -> str:
    """Distances at a few frames, one row each, on one scale."""
    count = len(found.views.frames)
    chosen = sorted({round(x) for x in np.linspace(0, count - 1, STRIP_FRAMES)})
    scale = found.distance_scale
    rows = []
    for title in (name for name in _distances(found, 0) if name != TITLES["d_tof"]):
        figures = [
            page.plain_picture(
                pictures.colour_mapped(
                    pictures.thinned(_distances(found, s)[title], STRIP_SIZE_MAX), scale
                ),
                title,
                f"frame {found.views.frames[s]}",
            )
            for s in chosen
        ]
        rows.append(page.row(figures))
    return "".join(rows) + f'<div class="wide">{page.colour_bar(scale)}</div>'


def animation(found: Findings) -> str:
    """The first frames of all quartets: measured quad, rendered quad, closed form, ours."""
    starts = [s for s, n in enumerate(found.views.frames) if n % found.sequence.cycle == 0]
    starts = starts[:: -(-len(starts) // ANIMATION_FRAMES_MAX)]
    if len(starts) < 2:
        return ""
    views, quad, metres = (
        found.views,
        pictures.signed_scale([found.views.quad_measured]),
        found.distance_scale,
    )

    def frame(s: int) -> np.ndarray:
        panels = [
            (views.quad_measured, quad),
            (views.quad_rendered, quad),
            (views.closed_form, metres),
            (views.d, metres),
        ]
        return pictures.side_by_side(
            [
                pictures.colour_mapped(pictures.thinned(image[s], STRIP_SIZE_MAX), scale)
                for image, scale in panels
            ]
        )

    data = pictures.animated_webp([frame(s) for s in starts], ANIMATION_PERIOD_S)
    source = pictures.data_uri(data, "image/webp")
    titles = ("measured quad", "rendered quad", "closed form", "ours, d")
    captions = "".join(f'<b class="caption">{title}</b>' for title in titles)
    return (
        f'<div class="row" style="--columns: 4">{captions}</div>'
        f'<img class="picture" src="{source}" alt="animation: {", ".join(titles)}">'
        f'<div class="row" style="--columns: '
        f'2">{page.colour_bar(quad)}{page.colour_bar(metres)}</div>'
    )


def _distances(found: Findings, s: int) -> dict[str, np.ndarray]:
    """Images [m] by title: closed form, ours, and truth if known."""
    views, judged = found.views, found.judgement
    images = {
        TITLES["closed_form"]: views.closed_form[s],
        TITLES["d"]: views.d[s],
        TITLES["d_tof"]: views.d_tof[s],
    }
    return images if judged is None else images | {"truth": judged.truth[s]}


def _scale_errors(judged: Judgement, s: int) -> np.ndarray:
    """Absolute errors [m] of the closed form, on moving pixels if there are any,
    which define the scale.
    """
    error = np.sqrt(judged.errors["closed_form"][s])
    return error[judged.moving[s]] if judged.moving[s].any() else error


def _share_scale(high: float) -> pictures.Scale:
    return pictures.Scale(low=0.0, high=high, colours="gray", unit="")


def _change(sequence: Sequence, n: int) -> float:
    """Largest mean change [quad units] to the quads of the same shift one quartet earlier and
    later.
    """
    near = [m for m in (n - sequence.cycle, n + sequence.cycle) if 0 <= m < sequence.frames]
    changes = [
        float(np.abs(sequence.quads[m] - sequence.quads[n]).mean())
        for m in near
        if sequence.measured[m]
    ]
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
