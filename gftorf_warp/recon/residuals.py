"""How well a run explains the measured quads, without ground truth.

In every pixel of a complete quartet, chi-square is the mean over its raw frames of (rendered -
measured)^2 / sigma^2, with the noise sigma that is estimated from the recording: 1 where the run
explains everything but noise. Images are compared at the size at which they were fitted, each raw
frame at its own time and pose. A pixel is *unexplained* if the same mean exceeds ``CHI_SQUARE_MAX``
after an error of ``MODEL_ERROR`` of the amplitude was added to the noise: splats are no exact
surfaces, and a few per cent of the amplitude are a few centimetres.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data.noise import amplitudes_of, quad_noise
from ..data.sequence import Sequence
from ..errors import InputError
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.sensor import Sensor, channel_of
from .observations import reduced
from .settings import Method

LOG = logging.getLogger("gftorf_warp")
CHI_SQUARE_MAX = 6.0  # noise alone exceeds it in 1e-4 of the pixels, with four raw frames
MODEL_ERROR = 0.05  # [1] of the amplitude: 6 cm at 20 MHz
TINY = 1e-30  # [quad units^2] instead of no variance
# [1] of unexplained pixels; the good fit of `gftorf demo` has 0.008, bad ones of random scenes 0.1
WARNING_SHARE = 0.02
CENTRAL = (0.05, 0.95)  # quantiles of the unexplained pixels that a message names


class Fitted(Protocol):
    """What is needed of a :class:`gftorf_warp.recon.run.Run`."""

    @property
    def config(self) -> dict:
        """Content of config.json."""

    @property
    def camera(self) -> Camera:
        """The camera of raw frame 0 at the sequence's own resolution."""

    @property
    def sensor(self) -> Sensor:
        """The sensor, with the four canonical shifts."""

    def renderer(
        self, images: Iterable[str], *, f_mod_hz: float | None
    ) -> Callable[[float, Camera], Rendering]:
        """A function of time [s] and camera."""


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
            **(self.ranges() or dict.fromkeys(("columns", "rows", "frames"))),
        }


@torch.no_grad()
def residuals(run: Fitted, sequence: Sequence) -> Residuals | None:
    """Render every raw frame of all complete quartets of the run's sequence and compare.

    Returns:
        None where nothing was fitted to quads (closed forms, colour alone), or no quartet is
        complete.
    """
    settings = run.config.get("settings", {})
    fitted = settings.get("method", Method.GAUSSIANS) == Method.GAUSSIANS
    if not fitted or not settings.get("weights", {}).get("quads", 1.0) > 0:
        return None
    width, height = run.config.get("size_optimised", (sequence.width, sequence.height))
    measured, camera = reduced(sequence, width), run.camera.resized(width, height)
    try:
        noise = quad_noise(measured)
    except InputError:  # shifts that determine no phase can be fitted, but not decoded
        return None
    if noise is None:
        return None
    render = {f: run.renderer(("quads", "phasor"), f_mod_hz=f) for f in sequence.frequencies}
    chi_square, scaled = [], []
    for i in measured.complete_quartets:
        frames = range(measured.frames)[measured.quartet_frames(i)]
        apart = torch.stack([_difference(run, measured, n, render, camera) for n in frames])
        square = np.square(apart.double().cpu().numpy())
        amplitude = amplitudes_of(measured, i)
        variance = np.square(noise.sigma(amplitude))
        tolerated = np.maximum(variance + np.square(MODEL_ERROR * amplitude), TINY)
        chi_square.append((square / np.maximum(variance, TINY)).mean(axis=0))
        scaled.append((square / tolerated).mean(axis=0))
    return Residuals(
        quartets=measured.complete_quartets,
        chi_square=np.stack(chi_square).astype(np.float32),
        noisy=bool((noise.floor + noise.gain > 0).all()),
        # not finite counts as unexplained
        unexplained=~(np.stack(scaled) <= CHI_SQUARE_MAX),
        scale=sequence.width / width,
        cycle=sequence.cycle,
    )


def _difference(
    run: Fitted,
    measured: Sequence,
    n: int,
    render: dict[float, Callable[[float, Camera], Rendering]],
    camera: Camera,
) -> Float[Tensor, "H W"]:
    """Rendered minus measured quad of raw frame n."""
    at = camera.at(measured.camera_from_world[n])
    rendering = render[float(measured.frame_frequencies[n])](float(measured.times[n]), at)
    quad = quad_of_shift(rendering, run.sensor, float(measured.shifts[n]))
    return quad - torch.as_tensor(measured.quads[n], device=quad.device)


def warn(found: Residuals | None) -> None:
    """Log a warning if more than a few per cent of the pixels are unexplained."""
    if found is not None and found.unexplained_share > WARNING_SHARE:
        LOG.warning("%s", sentence(found.as_json()))


def sentence(found: Mapping[str, Any]) -> str:
    """What :meth:`Residuals.as_json` says, in words."""
    text = f"the fit does not explain {found['unexplained_share']:.1%} of the pixels"
    if found["reduced_chi_square"] is not None:
        text += f" (reduced chi-square of the quads {found['reduced_chi_square']:.3g})"
    if found["columns"] is not None:
        ranges = {name: "{} to {}".format(*found[name]) for name in ("columns", "rows", "frames")}
        text += (
            f", most of them in columns {ranges['columns']}, rows {ranges['rows']}, raw frames "
            f"{ranges['frames']}"
        )
    return text


def quad_of_shift(rendering: Rendering, sensor: Sensor, shift: float) -> Tensor:
    """The quad [H, W] of any phase shift [rad] of a rendering.

    If not rendered, it is (re cos shift + im sin shift + dc_offset amplitude) / 2 of the phasor.
    """
    channel = channel_of(sensor.shifts, shift)
    if channel is not None:
        return rendering.quads[channel]
    re, im, amplitude = rendering.phasor
    return 0.5 * (re * math.cos(shift) + im * math.sin(shift) + sensor.dc_offset * amplitude)
