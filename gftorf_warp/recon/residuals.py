"""How well a run explains the measured quads, without ground truth.

In every pixel of a complete quartet, chi-square is the mean over its raw frames of (rendered -
measured)^2 / sigma^2, with the noise sigma that is estimated from the recording: 1 where the run
explains everything but noise. Images are compared at the size at which they were fitted, each raw
frame at its own time and pose. A pixel is *unexplained* if the same mean exceeds ``CHI_SQUARE_MAX``
after an error of ``MODEL_ERROR`` of the amplitude was added to the noise: splats are no exact
surfaces, and a few per cent of the amplitude are a few centimetres. Where phasors were fitted,
quads are compared without their constant part, which phasors do not contain.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..constants import SPEED_OF_LIGHT
from ..data import temporal
from ..data.constant import constant_of
from ..data.decode import closed_form_distance, quartet_phasors, unambiguous_range
from ..data.noise import QuadNoise, amplitudes_of, quad_noise
from ..data.sequence import Sequence
from ..errors import InputError
from ..render.api import Rendering
from ..scene.sensor import Sensor, channel_of, quad_from_phasor
from .observations import as_compared, input_of, reduced
from .raw_frames import Fitted, RawFrames
from .settings import Input, Method

LOG = logging.getLogger("gftorf_warp")
CHI_SQUARE_MAX = 6.0  # noise alone exceeds it in 1e-4 of the pixels, with four raw frames
MODEL_ERROR = 0.05  # [1] of the amplitude: 6 cm at 20 MHz
TINY = 1e-30  # [quad units^2] instead of no variance
# Limits of shares of pixels; in brackets a good fit (`gftorf demo`), and bad ones of random scenes
UNEXPLAINED_MAX = 0.02  # of all (0.008; 0.03 to 0.11)
FAILED_MIN = 0.05  # of all, of a fit that failed (0.08 to 0.17 injected; good ones at most 0.03)
CHANGING_MAX = 0.5  # of those that change, unexplained (0.1; 0.7)
CONTRADICTED_MAX = 0.05  # of those that do not, at another distance (0.004; 0.13)
CHANGING_MIN = 1e-3  # of all: noise alone makes 2e-4 of the pixels change
CONTRADICTION = 0.025  # [unambiguous ranges of the first frequency] 19 cm at 20 MHz
SIGMAS = 3.0  # [standard deviations of the temporal mean] that are no contradiction
CENTRAL = (0.05, 0.95)  # quantiles of the unexplained pixels that a message names


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Residuals of the Q complete quartets of a recording, at the size of the fit."""

    quartets: list[int]
    """Their numbers."""
    chi_square: Float[np.ndarray, "Q H W"]
    """Mean squared residual over the variance of the noise [1]."""
    noisy: bool
    """Whether the recording has noise; else a thousandth of the amplitude stands for it."""
    unexplained: Bool[np.ndarray, "Q H W"]
    """Where the run fails, see the module."""
    changes: Bool[np.ndarray, "Q H W"] | None
    """Where the quartet does not agree with its pixel's median; None: the camera moves."""
    contradicted: Bool[np.ndarray, "Q H W"]
    """Where the quartet agrees, and the distance of the fit is far from that of the temporal mean,
    whole turns aside: quads do not determine it, and it is wrong."""
    scale: float
    """Columns of the sequence per column of these images [1]."""
    cycle: int
    """Raw frames per quartet."""

    @property
    def reduced_chi_square(self) -> float | None:
        """Mean of chi-square over all pixels [1]; None: the recording has no noise."""
        return float(self.chi_square.mean(dtype=np.float64)) if self.noisy else None

    @property
    def unexplained_share(self) -> float:
        """Unexplained pixels over all [1]."""
        return float(self.unexplained.mean())

    @property
    def changing_unexplained_share(self) -> float | None:
        """Unexplained pixels over all that change [1]; None: hardly any does, or the camera
        moves.
        """
        if self.changes is None or self.changes.mean() < CHANGING_MIN:
            return None
        return float(self.unexplained[self.changes].mean())

    @property
    def contradicted_share(self) -> float | None:
        """Pixels at a wrong distance over all that do not change [1]; None: there are none."""
        if self.changes is None or self.changes.all():
            return None
        return float(self.contradicted.sum() / (~self.changes).sum())

    def ranges(self) -> dict[str, list[int]] | None:
        """First and last column, row and raw frame of the sequence around the central 90 % of the
        unexplained pixels along each axis; None if there are none.
        """
        if not self.unexplained.any():
            return None
        quartet, row, column = np.nonzero(self.unexplained)
        frames = self.cycle * np.array(self.quartets)[quartet]
        result = {}
        for name, values, factor, width in (
            ("columns", column, self.scale, self.scale),
            ("rows", row, self.scale, self.scale),
            ("frames", frames, 1.0, self.cycle),
        ):
            low, high = (np.quantile(values, q, method="nearest") for q in CENTRAL)
            result[name] = [int(factor * low), int(factor * high + width) - 1]
        return result

    def as_json(self) -> dict[str, object]:
        """Numbers for config.json and metrics.json."""
        return {
            "reduced_chi_square": self.reduced_chi_square,
            "unexplained_share": self.unexplained_share,
            "changing_unexplained_share": self.changing_unexplained_share,
            "contradicted_share": self.contradicted_share,
            **(self.ranges() or dict.fromkeys(("columns", "rows", "frames"))),
        }


@torch.no_grad()
def residuals(
    run: Fitted,
    sequence: Sequence,
    rendered: RawFrames | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Residuals | None:
    """Render every raw frame of all complete quartets of the run's sequence and compare.

    Args:
        run: What was fitted.
        sequence: Its sequence, at its own size.
        rendered: Renderings with quads, phasor and distance that are used if they are of the size
            of the fit; None: new ones.
        progress: Called with (raw frames done, raw frames in all).

    Returns:
        None where nothing was fitted to quads (closed forms, colour alone), or no quartet is
        complete.
    """
    settings = run.config.get("settings", {})
    fitted = Method(settings.get("method", Method.GAUSSIANS)).fits
    if not fitted or not settings.get("weights", {}).get("quads", 1.0) > 0:
        return None
    width = run.config.get("size_optimised", (sequence.width, sequence.height))[0]
    wanted = Input(run.config.get("input", Input.QUADS))
    measured = as_compared(reduced(sequence, width), wanted)
    phasors = input_of(measured, wanted) == Input.PHASOR
    try:
        noise = quad_noise(measured)
    except InputError:  # shifts that determine no phase can be fitted, but not decoded
        return None
    if noise is None:
        return None
    if rendered is None or rendered.sequence.quads.shape != measured.quads.shape:
        rendered = RawFrames(run, measured, ("quads", "phasor", "distance"))
    chi_square, scaled, distance = [], [], []
    for i in measured.complete_quartets:
        apart, first = _quartet(run, measured, i, rendered)
        distance.append(first)
        if phasors:
            apart = _without_constant(apart, measured, i)
        square = np.square(apart)
        amplitude = amplitudes_of(measured, i)
        variance = np.square(noise.sigma(amplitude))
        tolerated = np.maximum(variance + np.square(MODEL_ERROR * amplitude), TINY)
        chi_square.append((square / np.maximum(variance, TINY)).mean(axis=0))
        scaled.append((square / tolerated).mean(axis=0))
        if progress is not None:
            count = sequence.cycle * len(measured.complete_quartets)
            progress(sequence.cycle * len(scaled), count)
    changes, contradicted = _contradictions(measured, noise, np.stack(distance))
    return Residuals(
        quartets=measured.complete_quartets,
        changes=changes,
        contradicted=contradicted,
        chi_square=np.stack(chi_square).astype(np.float32),
        noisy=bool((noise.floor + noise.gain > 0).all()),
        # not finite counts as unexplained
        unexplained=~(np.stack(scaled) <= CHI_SQUARE_MAX),
        scale=sequence.width / width,
        cycle=sequence.cycle,
    )


def explained(
    run: Fitted, rendered: RawFrames, progress: Callable[[int, int], None] | None = None
) -> Residuals | None:
    """``run.explained``, which is then known, from renderings that others use too.

    Args:
        run: A :class:`gftorf_warp.recon.run.Run`.
        rendered: Of its sequence, with quads, phasor and distance.
        progress: Called with (raw frames done, raw frames in all).
    """
    known = vars(run)
    if "explained" not in known:  # as functools.cached_property stores it
        sequence = rendered.sequence
        known["explained"] = residuals(run, sequence, rendered=rendered, progress=progress)
    return known["explained"]


def _quartet(
    run: Fitted, measured: Sequence, i: int, rendered: RawFrames
) -> tuple[Float[np.ndarray, "K H W"], Float[np.ndarray, "H W"]]:
    """Rendered minus measured quads of quartet i, each at its time, pose and frequency, and the
    distance [m] rendered at the first.
    """
    apart: list[Tensor] = []
    distance: list[Tensor] = []
    for n in range(measured.frames)[measured.quartet_frames(i)]:
        rendering = rendered(n, float(measured.frame_frequencies[n]))
        quad = quad_of_shift(rendering, run.sensor, float(measured.shifts[n]))
        apart.append(quad - torch.as_tensor(measured.quads[n], device=quad.device))
        if not distance:
            distance.append(rendering.distance.clone())  # the next rendering overwrites it
    return torch.stack(apart).double().cpu().numpy(), distance[0].cpu().numpy()


def _without_constant(
    apart: Float[np.ndarray, "K H W"], measured: Sequence, i: int
) -> Float[np.ndarray, "K H W"]:
    """Differences of the quads of quartet i without what no phasor contains."""
    result, first = apart.copy(), measured.quartet_frames(i).start
    for frames, _ in quartet_phasors(measured, i):
        slots = np.array(frames) - first
        result[slots] -= constant_of(apart[slots], measured.shifts[frames])
    return result


def _contradictions(
    measured: Sequence, noise: QuadNoise, distance: Float[np.ndarray, "Q H W"]
) -> tuple[Bool[np.ndarray, "Q H W"] | None, Bool[np.ndarray, "Q H W"]]:
    """``changes`` and ``contradicted`` of the rendered distances [m] of all complete quartets."""
    if not temporal.camera_rests(measured):
        return None, np.zeros(distance.shape, dtype=bool)
    agrees, averaged = temporal.agreement(measured), temporal.averaged(measured)
    mean = np.stack([closed_form_distance(averaged, i) for i in measured.complete_quartets])
    reach = unambiguous_range(measured)
    apart = np.abs((distance - mean + 0.5 * reach) % reach - 0.5 * reach)
    far = CONTRADICTION * SPEED_OF_LIGHT / (2.0 * measured.frequencies[0])
    sigma = temporal.sigma_of_mean(measured, noise, agrees.sum(axis=0))
    return ~agrees, agrees & ~(apart <= np.maximum(far, SIGMAS * sigma))


def warn(judged: Residuals | None) -> None:
    """Log everything that :func:`problems` finds."""
    for problem in problems(judged.as_json() if judged else None):
        LOG.warning("%s", problem)


def failures(explained: Mapping[str, Any] | None) -> list[str]:
    """Those of :func:`problems` by which a fit failed: all, unless only a few pixels are not
    explained.
    """
    return problems(explained, unexplained_max=FAILED_MIN)


def problems(
    explained: Mapping[str, Any] | None, *, unexplained_max: float = UNEXPLAINED_MAX
) -> list[str]:
    """What is wrong with a run, in sentences, from :meth:`Residuals.as_json`; the same limits for
    every preset. Opaque veils, dead networks, wrong or missing motion and layers at false distances
    all show here.
    """
    if explained is None:
        return []
    sentences = []
    if explained["unexplained_share"] > unexplained_max:
        text = f"the fit does not explain {explained['unexplained_share']:.1%} of the pixels"
        if explained["reduced_chi_square"] is not None:
            text += f" (reduced chi-square of the quads {explained['reduced_chi_square']:.3g})"
        ranges = {
            name: "{} to {}".format(*explained[name]) for name in ("columns", "rows", "frames")
        }
        text += f", most of them in columns {ranges['columns']}, rows {ranges['rows']}, "
        sentences.append(text + f"raw frames {ranges['frames']}")
    if (explained["changing_unexplained_share"] or 0.0) > CHANGING_MAX:
        share = f"{explained['changing_unexplained_share']:.1%} of the pixels that change over time"
        sentences.append(f"motion is missing or wrong: the fit does not explain {share}")
    if (explained["contradicted_share"] or 0.0) > CONTRADICTED_MAX:
        share = f"{explained['contradicted_share']:.1%} of the pixels where nothing changes"
        sentences.append(f"the fitted distance contradicts the measured one in {share}")
    return sentences


def quad_of_shift(rendering: Rendering, sensor: Sensor, shift: float) -> Tensor:
    """The quad [H, W] of any phase shift [rad] of a rendering.

    If not rendered, it is (re cos shift + im sin shift + dc_offset amplitude) / 2 of the phasor.
    """
    channel = channel_of(sensor.shifts, shift)
    if channel is not None:
        return rendering.quads[channel]
    re, im, amplitude = rendering.phasor
    return quad_from_phasor(re, im, sensor.dc_offset * amplitude, shift)
