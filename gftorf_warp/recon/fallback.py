"""Where the measurement itself knows the distance better than the fit, pixel by pixel.

During a quartet, seen from the sequence's own camera, the rendered distance of a run gives way to

* the *temporal mean* of all quartets that agree with their pixel's median, or else of a quartet and
  the neighbours in time that measured the same, if the fit is more than a few standard deviations
  of that mean away. Beside a pixel that does not agree, an edge may be passing: there the fit stays
  if it explains the quads as well as the mean does. Where it shows another surface, that may be
  there in one raw frame only, with the quad of what is behind: near a pixel that does not agree,
  it stays if it explains the quads nearly as well;
* the *closed form* of the quartet where no other one measured the same, and one phasor explains its
  raw frames better than the fit does: nothing moved within it. Either the fit does not explain them
  (see residuals.py), or one phasor does so to within the noise, where the fit may be wrong by a few
  per cent of the amplitude. What moved can look like one phasor by chance, at a distance that no
  neighbour has: there it has to explain them still better. A fit that explains no more than black
  images do is replaced wherever it fails.

A moving camera has no temporal mean, and its fits are worse: there the closed form replaces the
distance of a pixel wherever one phasor explains its quads, or explains them as well as the fit
does. Raw frames that were made from phasors are explained by one whatever moved: of a moving camera
they are the closed form throughout, since nothing says where the fit is better. With the setting
``outlines``, that closed form is decoded again from the phasor of the run and resolved where it
mixes two surfaces, see outlines.py.

Along steps of the mean a pixel is a mixture of two surfaces, and the mean a distance between them:
a fit between the two sides stays if it explains the quads. A slope is no step, however steep.

How much is a matter of the odds that the fit is right, from the shares of pixels where residuals.py
finds it wrong: a ratio of chi-squares, twice the logarithm of the odds as a difference of their
sums, and its root in standard deviations. Elsewhere the fit stays. A map of sources says which is
which.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data import temporal
from ..data.decode import closed_form_distance, quartet_phasors, unambiguous_range
from ..data.noise import QuadNoise, amplitudes_of, quad_noise
from ..data.sequence import Sequence
from ..data.steps import STEP_M, grown, near_steps
from ..render.api import Rendering
from ..scene.camera import Camera
from ..scene.measured import extremes
from ..scene.sensor import quad_from_phasor
from . import closed_form
from .collapse import NEAR
from .outlines import at_outlines
from .residuals import CHI_SQUARE_MAX, Residuals

ODDS = (1.5, 1000.0)  # [1] range of the odds: no fit is worse than a guess, and none is sure
SAME_TURN = 0.125  # [unambiguous ranges] the fit may know the turn if it is so near to the mean
AS_GOOD = 2.0  # [1] of the chi-square of a mean: a fit that may be right beside what moves
BESIDE = 0.02  # [width] how far from a pixel that changes a surface may pass without a trace
UNEXPLAINED_SOUND = 0.12  # [1] of the pixels, of a fit that is averaged with the closed form


@dataclass(frozen=True, kw_only=True, eq=False)
class Fallback:
    """Distances of the Q complete quartets of a sequence, at its own size, and where they win."""

    sequence: Sequence
    """What was measured."""
    camera: Camera
    """The camera of raw frame 0."""
    temporal: Float[Tensor, "Q H W"]
    """Distance of the temporal mean [m], in [0, range)."""
    stays: Float[Tensor, "Q H W"]
    """How far from it the fit may be [m]: a few of its standard deviations."""
    rests: Bool[Tensor, "Q H W"]
    """Where it may replace the fit."""
    passes: Bool[Tensor, "Q H W"]
    """But not if the fit shows another surface, which may pass there without a trace."""
    closed_form: Float[Tensor, "Q H W"]
    """Distance of the quartet [m], in [0, range)."""
    moved: Bool[Tensor, "Q H W"]
    """Where it replaces the fit."""
    mixed: Bool[Tensor, "Q H W"]
    """Where the temporal mean may be one of two surfaces."""
    explained: Bool[Tensor, "Q H W"]
    """Where the fit explains the quads."""
    sound: bool
    """Whether the fit explains the quads of most pixels."""

    @classmethod
    def of(
        cls, residuals: Residuals | None, sequence: Sequence, camera: Camera, device: torch.device
    ) -> Fallback | None:
        """Judge a run by its residuals.

        Args:
            residuals: Residuals of the run; None where nothing was fitted to quads.
            sequence: What was measured.
            camera: The camera of raw frame 0, at the size of the sequence.
            device: Where images are rendered.

        Returns:
            None without residuals.
        """
        noise = quad_noise(sequence)
        if residuals is None or noise is None:
            return None
        explained = _enlarged(~residuals.unexplained, sequence)
        chi_square = _enlarged(residuals.chi_square, sequence)
        agrees = temporal.agreement(sequence)
        averaged, count = temporal.averaged_or_locally(sequence)
        quartets = sequence.complete_quartets
        mean = np.stack([closed_form_distance(averaged, i) for i in quartets])
        of_mean = _chi_square(sequence, temporal.stacked_quads(averaged), noise)
        of_phasor = _chi_square(sequence, _phasor_quads(sequence), noise)
        unknowns = 2.0 * len(sequence.frequencies)
        of_phasor *= sequence.cycle / (sequence.cycle - unknowns)
        odds = _odds(residuals.changing_unexplained_share, residuals)
        margin = 2.0 * math.log(odds) / sequence.cycle
        fit_stays = agrees & grown(~agrees) & (chi_square <= of_mean + margin)
        passes = _beside(~agrees & (count == 1)) & (
            chi_square <= AS_GOOD * np.maximum(of_mean, 1.0)
        )
        alone = np.stack([closed_form_distance(sequence, i) for i in quartets])
        if temporal.camera_rests(sequence):
            needed = np.where(_supported(alone), odds, odds**2)
            needed = np.where(_is_useless(residuals, sequence, noise), 0.0, needed)
            moved = chi_square > needed * np.maximum(of_phasor, 1.0)
            moved &= ~explained | (of_phasor <= CHI_SQUARE_MAX)
            moved &= ~agrees & (count == 1)
        else:  # a chi-square that is not finite is none
            moved = (of_phasor <= CHI_SQUARE_MAX) | ~(chi_square < of_phasor)
        stays = math.sqrt(2.0 * math.log(_odds(residuals.contradicted_share, residuals)))

        def tensor(image: np.ndarray) -> Tensor:
            kind = torch.bool if image.dtype == bool else torch.float32
            return torch.as_tensor(image, device=device, dtype=kind)

        return cls(
            sequence=sequence,
            camera=camera,
            temporal=tensor(mean),
            stays=tensor(stays * temporal.sigma_of_mean(sequence, noise, count)),
            rests=tensor((count > 1) & ~fit_stays),
            passes=tensor(passes),
            closed_form=tensor(alone),
            moved=tensor(moved),
            mixed=tensor(near_steps(mean) | np.stack([_at_outlines(image) for image in mean])),
            explained=tensor(explained),
            sound=residuals.unexplained_share <= UNEXPLAINED_SOUND,
        )

    @functools.cached_property
    def camera_moves(self) -> bool:
        """Whether it does, so that there is no temporal mean."""
        return not temporal.camera_rests(self.sequence)

    @property
    def averages(self) -> bool:
        """Whether the closed form is averaged with the fit: of a moving camera, if it is sound."""
        return self.camera_moves and self.sound

    def applied(self, rendering: Rendering, time: float, camera: Camera) -> Rendering:
        """A rendering with its distance replaced where the measurement knows better.

        ``source`` is 0 where the fit stays, everywhere if the time [s] is in no complete quartet or
        the camera is another. Nothing is transparent where the distance was replaced.
        """
        row = closed_form.row_of(self.sequence, time, camera, self.camera)
        fit = rendering.distance
        if row is None:
            return replace(rendering, source=torch.zeros_like(fit, dtype=torch.uint8))
        mean, reach = self.temporal[row], unambiguous_range(self.sequence)
        apart = self._apart(fit, row)
        averaged = self._rests(apart, row) & ~(apart.abs() <= self.stays[row])
        between = _between(fit, mean, STEP_M + 2.0 * self.stays[row])
        averaged &= ~(between & self.mixed[row] & self.explained[row])
        value = torch.where(apart.abs() < SAME_TURN * reach, fit - apart, mean)
        distance = torch.where(averaged, value, fit)
        distance = torch.where(self.moved[row], self.closed_form[row], distance)
        source = averaged.to(torch.uint8) + 2 * self.moved[row].to(torch.uint8)
        opacity = rendering.opacity
        if opacity.numel():
            opacity = torch.where(source > 0, torch.ones_like(opacity), opacity)
        return replace(rendering, distance=distance, opacity=opacity, source=source)

    def rests_at(
        self, rendering: Rendering, time: float, camera: Camera
    ) -> Bool[Tensor, "H W"] | None:
        """Where the temporal mean may replace the distance of a rendering of the fit; None if
        nothing may, as in :meth:`applied`.
        """
        row = closed_form.row_of(self.sequence, time, camera, self.camera)
        if row is None:
            return None
        return self._rests(self._apart(rendering.distance, row), row)

    def _rests(self, apart: Float[Tensor, "H W"], row: int) -> Bool[Tensor, "H W"]:
        return self.rests[row] & ~(self.passes[row] & (apart.abs() > STEP_M))

    def _apart(self, fit: Float[Tensor, "H W"], row: int) -> Float[Tensor, "H W"]:
        """Distance from the temporal mean to the fit [m], whole turns aside."""
        reach = unambiguous_range(self.sequence)
        return torch.remainder(fit - self.temporal[row] + 0.5 * reach, reach) - 0.5 * reach


def _odds(wrong: float | None, residuals: Residuals) -> float:
    """Odds [1] that the fit is right, from a share of pixels where it is wrong; None: of all."""
    wrong = residuals.unexplained_share if wrong is None else wrong
    low, high = ODDS
    return min(max((1.0 - wrong) / max(wrong, 1.0 / high), low), high)


def _is_useless(residuals: Residuals, sequence: Sequence, noise: QuadNoise) -> bool:
    """Whether a fit explains the quads no better than black images do: it failed as a whole."""
    black = _chi_square(sequence, np.zeros_like(temporal.stacked_quads(sequence)), noise)
    return not residuals.chi_square.mean(dtype=float) < (1.0 - NEAR) * black.mean(dtype=float)


def _between(
    fit: Float[Tensor, "H W"], mean: Float[Tensor, "H W"], step: Float[Tensor, "H W"]
) -> Bool[Tensor, "H W"]:
    """Where the mean changes by a step within 3x3 pixels, and the fit is between both sides."""
    low, high = extremes(mean)
    return (high - low > step) & (fit >= low) & (fit <= high)


def _at_outlines(distance: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    return at_outlines(torch.as_tensor(distance)).numpy()


def _enlarged(images: np.ndarray, sequence: Sequence) -> np.ndarray:
    """Images [Q, h, w] at the size of the sequence, by nearest neighbours."""
    rows = np.arange(sequence.height) * images.shape[1] // sequence.height
    columns = np.arange(sequence.width) * images.shape[2] // sequence.width
    return images[:, rows[:, None], columns]


def _beside(mask: Bool[np.ndarray, "Q H W"]) -> Bool[np.ndarray, "Q H W"]:
    """What is near the mask in the image; a pixel of it alone, or two, are noise."""
    import cv2

    side = 2 * max(round(BESIDE * mask.shape[2]), 1) + 1
    kernel = np.ones((side, side), np.uint8)
    counts = (cv2.boxFilter(m.astype(np.uint8), -1, (3, 3), normalize=False) for m in mask)
    return np.stack([cv2.dilate((count > 2).astype(np.uint8), kernel) > 0 for count in counts])


def _supported(distance: Float[np.ndarray, "Q H W"]) -> Bool[np.ndarray, "Q H W"]:
    """Whether a distance [m] is that of its surroundings: within a step of the median of 3x3."""
    import cv2

    medians = [cv2.medianBlur(image.astype(np.float32), 3) for image in distance]
    return np.abs(distance - np.stack(medians)) <= STEP_M


def _chi_square(
    sequence: Sequence, quads: Float[np.ndarray, "Q K H W"], noise: QuadNoise
) -> Float[np.ndarray, "Q H W"]:
    """Mean squared difference to the measured quads over the variance of the noise."""
    apart = np.square(temporal.stacked_quads(sequence) - quads)
    light = [amplitudes_of(sequence, i) for i in sequence.complete_quartets]
    variances = (np.square(noise.sigma(amplitude)) for amplitude in light)
    return np.stack([(a / v).mean(axis=0) for a, v in zip(apart, variances, strict=True)])


def _phasor_quads(sequence: Sequence) -> Float[np.ndarray, "Q K H W"]:
    """Quads of the decoded phasor of every complete quartet, with the DC offset of the sensor."""
    result = np.empty(temporal.stacked_quads(sequence).shape, dtype=np.float32)
    for quads, i in zip(result, sequence.complete_quartets, strict=True):
        for frames, (re, im) in quartet_phasors(sequence, i):
            constant = sequence.calibration.dc_offset * np.hypot(re, im)
            for n in frames:
                shift = float(sequence.shifts[n])
                quads[n - sequence.cycle * i] = quad_from_phasor(re, im, constant, shift)
    return result
