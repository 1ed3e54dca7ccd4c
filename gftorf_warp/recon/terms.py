"""The terms of the loss: what each one compares, its weight, and when it begins (method, section
5).

A term is one entry of :data:`TERMS`. Its function gets everything that was rendered of one image
and returns a differentiable number; plain torch operations are enough, on a CPU as in a CUDA graph,
as long as they do not wait for the device. Kernels of ``render/fused.py`` are faster.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor

from ..losses.prior import motion_size
from ..render import fused
from ..render.api import Rendering
from ..render.buffers import RenderSettings
from .observations import Observations
from .settings import Norm, ReconSettings

LIGHT = "light"  # among the outputs of a term: the quad or the phasor, whichever is compared


class View(enum.Enum):
    """Which rendering of an image a term reads."""

    TOF = "tof"
    """The ToF camera at the time of the quad or phasor."""
    COLOUR = "colour"
    """The colour camera at the time of its image; reads the colour of the Gaussians."""
    FLOW = "flow"
    """The ToF camera at the start of a quartet. ``extra`` holds the displacement [m] to the next
    quartet and to the previous one in world axes; blending weights are constants in its
    gradient."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BatchImage:
    """One image of a batch: its renderings, and where on the device its measured images are."""

    observations: Observations
    """What was measured."""
    settings: ReconSettings
    """Of the run."""
    renderings: Mapping[View, Rendering]
    """Of those views that a term of this image reads."""
    rows: Mapping[str, Int[Tensor, "1"]]
    """Row of this image among the quads or phasors ('light'), 'colour', closed-form distances
    ('depth') and 'flow' of the observations: device data, since a CUDA graph serves all images."""
    mean: Float[Tensor, "N 3"]
    """Undisplaced centres [m]. On a CPU of the Gaussians that exist at the times of the batch."""
    moved: Float[Tensor, "N 3"] | None
    """Centres at the time of the ToF image [m]; None: nothing moves yet."""
    mean_weight: Float[Tensor, "N"]
    """Weight of every Gaussian in a mean over all Gaussians, and 0 for padding rows."""
    flow_cameras: Float[Tensor, "2 V"]
    """Cameras at both ends of both flows, see :func:`gftorf_warp.render.fused.flow_cameras`."""
    scratch: Callable[[str], fused.Scratch]
    """Memory of an image loss by name of its term."""

    @property
    def displacement(self) -> Float[Tensor, "N 3"] | None:
        """Displacements at the time of the ToF image [m]; None: nothing moves yet."""
        return None if self.moved is None else self.moved - self.mean


@dataclass(frozen=True, kw_only=True)
class Term:
    """One term of the loss."""

    name: str
    """Key in metrics.jsonl."""
    loss: Callable[[BatchImage, Tensor], Tensor]
    """The unweighted term [0-d] of one image. The second argument [3] is device memory for the
    term, its mean squared difference and the mean opacity times channels, which kernels may fill
    themselves; a term that does not is copied there."""
    weight: Callable[[ReconSettings, int], float]
    """Its weight after so many optimised images; 0: it is not computed."""
    view: View | None = View.TOF
    """The rendering that it reads; None: none."""
    outputs: frozenset[str] = frozenset()
    """Images of that rendering besides its opacity: names of ``Rendering``, or ``LIGHT``."""
    applies: Callable[[Observations, int], bool] = lambda _observations, _frame: True
    """Whether the image of a raw frame has this term."""
    needs_motion: bool = False
    """Whether it is left out until Gaussians move."""
    channels: Callable[[Observations], int] | None = None
    """Number of channels compared, of a term that fills all three results: the first such term of
    an image gives the squared difference and the opacity of the log. None: it fills the first
    only."""


def light_loss(image: BatchImage, out: Tensor) -> Tensor:
    """Quad or phasor: (1 - ssim) L2 + ssim (1 - SSIM).
    The amplitude of a phasor is not compared.
    """
    tof, measured = image.renderings[View.TOF], image.observations
    if measured.phasors:
        return _image_loss(image, LIGHT, tof.phasor[:2], measured.phasors.images, tof.opacity, out)
    return _image_loss(image, LIGHT, tof.quads, measured.quads[:, None], tof.opacity, out)


def colour_loss(image: BatchImage, out: Tensor) -> Tensor:
    """Colour: (1 - ssim) L1 or L2 + ssim (1 - SSIM)."""
    seen, norm = image.renderings[View.COLOUR], image.settings.weights.colour_norm
    measured = image.observations.colour.images
    assert seen.colour is not None
    return _image_loss(image, "colour", seen.colour, measured, seen.opacity, out, norm)


def depth_loss(image: BatchImage, out: Tensor) -> Tensor:
    """Rendered against closed-form distance: (1 - ssim) L1 + ssim (1 - SSIM)."""
    distance = image.renderings[View.TOF].distance[None]
    measured = image.observations.closed_form.images
    return _image_loss(image, "depth", distance, measured, None, out, Norm.L1)


def distortion_loss(image: BatchImage, _out: Tensor) -> Tensor:
    """Mean depth distortion [m^2]."""
    return image.renderings[View.TOF].distortion.mean()


def motion_size_loss(image: BatchImage, _out: Tensor) -> Tensor:
    """Mean length of the displacements [m]."""
    assert image.displacement is not None
    return (motion_size(image.displacement) * image.mean_weight).sum()


def flow_loss(image: BatchImage, out: Tensor) -> Tensor:
    """Squared difference of rendered and measured flow [px^2], forward plus backward.

    The mean is over all pixels and both components; unknown ones count zero. Gradients reach only
    the displacements between quartet starts (method, section 5).
    """
    seen = image.renderings[View.FLOW]
    assert seen.extra is not None
    measured = image.observations.flow.images
    row, result = image.rows["flow"], out[:1]
    return fused.flow_loss(
        seen.distance, seen.extra, measured, image.flow_cameras, row=row, out=result
    )


def _image_loss(
    image: BatchImage,
    name: str,
    rendered: Tensor,
    measured: Tensor,
    opacity: Tensor | None,
    out: Tensor,
    norm: Norm = Norm.L2,
) -> Tensor:
    return fused.image_loss(
        rendered,
        measured,
        image.settings.weights.ssim,
        absolute=norm == Norm.L1,
        row=image.rows[name],
        opacity=opacity,
        scratch=image.scratch(name),
        out=out,
    )[0]


def distortion_weight(settings: ReconSettings, images: int) -> float:
    """Weight of the depth distortion, which begins at a share of the run."""
    begins = settings.schedule.distortion_from * settings.schedule.images
    return settings.weights.distortion if images >= begins else 0.0


def colour_weight(settings: ReconSettings, images: int) -> float:
    """Weight of colour."""
    return settings.weights.colour if images >= settings.schedule.colour_from else 0.0


def flow_weight(settings: ReconSettings, images: int) -> float:
    """Weight of the flow: in one of ``flow_every`` steps, and as many times as large there.

    Steps are counted as if all of them compared a whole quartet.
    """
    schedule = settings.schedule
    begun = images >= schedule.flow_from
    return (
        schedule.flow_every * settings.weights.flow
        if begun and images // settings.cycle % schedule.flow_every == 0
        else 0.0
    )


TERMS: tuple[Term, ...] = (
    Term(
        name="quads",
        loss=light_loss,
        weight=lambda settings, _: settings.weights.quads,
        outputs=frozenset({LIGHT}),
        channels=lambda observations: 2 if observations.phasors else 1,
    ),
    Term(
        name="depth",
        loss=depth_loss,
        weight=lambda settings, _: settings.weights.depth,
        outputs=frozenset({"distance"}),
        applies=lambda observations, frame: (
            frame // observations.sequence.cycle in observations.closed_form
        ),
    ),
    Term(
        name="distortion",
        loss=distortion_loss,
        weight=distortion_weight,
        outputs=frozenset({"distortion"}),
    ),
    Term(
        name="colour",
        loss=colour_loss,
        weight=colour_weight,
        view=View.COLOUR,
        applies=lambda observations, frame: frame in observations.colour,
        channels=lambda _: 3,
    ),
    Term(
        name="motion_size",
        loss=motion_size_loss,
        weight=lambda settings, _: settings.weights.motion_size,
        view=None,
        needs_motion=True,
    ),
    Term(
        name="flow",
        loss=flow_loss,
        weight=flow_weight,
        view=View.FLOW,
        outputs=frozenset({"distance"}),
        applies=lambda observations, frame: (
            frame % observations.sequence.cycle == 0
            and frame // observations.sequence.cycle in observations.flow
        ),
        needs_motion=True,
    ),
)
"""All terms; the stepper knows no other."""


def render_settings_at(settings: ReconSettings, images: int) -> RenderSettings:
    """Renderer settings after ``images`` images: the degree of harmonics rises along the run."""
    every = settings.schedule.sh_degree_every
    if every is None:
        return settings.render
    return replace(settings.render, sh_degree=min(images // every, settings.render.sh_degree))
