"""Pictures beyond the ToF camera: novel views, and renderings of the colour camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from ..data.sequence import Sequence
from ..recon.settings import Method
from ..scene.measured import colour_camera_of
from . import page, pictures
from .poses import middle
from .previews import srgb
from .provenance import method_of
from .views import finite

if TYPE_CHECKING:
    from ..recon.run import Run

STRIP_VIEWS = 5  # columns of a strip
STRIP_SIZE_MAX = 240  # [px]
NORMALISED_MIN = 0.5  # [1] novel views show distance / opacity from this opacity on


@dataclass(frozen=True, kw_only=True, eq=False)
class Novel:
    """M novel views at one time."""

    poses: list[int]
    """Their indices among those of the sequence."""
    time: float
    """Time [s]."""
    distance: Float[np.ndarray, "M H W"]
    """Mean distance divided by opacity [m]; NaN where opacity is below one half."""
    colour: Float[np.ndarray, "M H W 3"] | None
    """Linear RGB in the units of the sequence's colour images; None if the run has no colour."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Colour:
    """Colour images of some raw frames, linear RGB in the units of the sequence's."""

    frames: list[int]
    """The raw frames n."""
    measured: Float[np.ndarray, "C h w 3"]
    """Recorded images."""
    rendered: Float[np.ndarray, "C h w 3"]
    """Renderings at the same times and poses."""


def novel_views(run: Run, sequence: Sequence, count: int = STRIP_VIEWS) -> Novel | None:
    """Views from up to ``count`` of the novel poses of a sequence, in the middle of it.

    None if the sequence has none, or if nothing was fitted: a closed form has one view.

    Raises:
        DivergedError: If a rendering is not finite.
    """
    fits = Method(method_of(run.config)).fits
    if sequence.novel_from_world is None or not len(sequence.novel_from_world) or not fits:
        return None
    total = len(sequence.novel_from_world)
    chosen = np.linspace(0, total - 1, min(count, total)).round().astype(int).tolist()
    time = middle(sequence)
    distances, colours = [], []
    for m in chosen:
        rendering = run.render(time, run.camera.at(sequence.novel_from_world[m]))
        opacity = finite(rendering.opacity, f"novel view {m}", run)
        distance = finite(rendering.distance, f"novel view {m}", run)
        distance /= np.maximum(opacity, NORMALISED_MIN)
        distances.append(np.where(opacity >= NORMALISED_MIN, distance, np.nan))
        if rendering.colour is not None:
            image = finite(rendering.colour, f"colour of novel view {m}", run)
            colours.append(image.transpose(1, 2, 0))
    colour = np.stack(colours) if colours else None
    return Novel(poses=chosen, time=time, distance=np.stack(distances), colour=colour)


def colour_views(run: Run, sequence: Sequence, frames: list[int]) -> Colour | None:
    """Colour images of the raw frames that have one, rendered from the colour camera.

    None if the sequence has no calibrated colour camera, none of the frames has an image, or the
    run has no colour.

    Raises:
        DivergedError: If a rendering is not finite.
    """
    if not run.has_colour:  # a closed form has no other view either
        return None
    triples = []
    for n in (n for n in frames if n in sequence.colour.images):
        camera = colour_camera_of(sequence, n)
        rendered = None if camera is None else run.render(float(sequence.times[n]), camera).colour
        if rendered is None:
            return None
        image = finite(rendered, f"colour of raw frame {n}", run)
        triples.append((n, sequence.colour.images[n], image.transpose(1, 2, 0)))
    if not triples:
        return None
    chosen, measured, images = zip(*triples, strict=True)
    return Colour(frames=list(chosen), measured=np.stack(measured), rendered=np.stack(images))


def novel_strip(novel: Novel, scale: pictures.Scale) -> str:
    """Distance, and colour if there is any, of the novel views as HTML."""
    notes = [f"pose {m}" for m in novel.poses]
    distances = [pictures.colour_mapped(_thinned(image), scale) for image in novel.distance]
    strip = _row(distances, "distance / opacity", notes)
    strip += f'<div class="wide">{page.colour_bar(scale)}</div>'
    if novel.colour is not None:
        white = float(np.percentile(novel.colour, 99.5))
        strip += _row([_shown(image, white) for image in novel.colour], "colour", notes)
    return strip


def colour_strip(colour: Colour) -> str:
    """Measured and rendered colour at a few frames, with one white level, as HTML."""
    chosen = sorted({round(x) for x in np.linspace(0, len(colour.frames) - 1, STRIP_VIEWS)})
    white = float(np.percentile(colour.measured, 99.5))
    notes = [f"frame {colour.frames[c]}" for c in chosen]
    measured, rendered = (
        [_shown(images[c], white) for c in chosen] for images in (colour.measured, colour.rendered)
    )
    return _row(measured, "measured colour", notes) + _row(rendered, "rendered colour", notes)


def _row(images: list[np.ndarray], title: str, notes: list[str]) -> str:
    pairs = zip(images, notes, strict=True)
    return page.row([page.plain_picture(rgb, title, note) for rgb, note in pairs], kind="strip")


def _shown(linear: Float[np.ndarray, "H W 3"], white: float) -> UInt8[np.ndarray, "h w 3"]:
    return srgb(_thinned(linear) / (white if white > 0 else 1.0))


def _thinned(image: np.ndarray) -> np.ndarray:
    return pictures.thinned(image, STRIP_SIZE_MAX)
