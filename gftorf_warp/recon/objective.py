"""The loss of one image, term by term: {name: weighted scalar} (method, section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import FRAMES_PER_QUARTET
from ..losses.image import similarity
from ..losses.prior import flow_error, image_motion, motion_size
from ..losses.tof import phasor_error, quad_error
from ..render.api import Background, Rendering, rasterize
from ..render.buffers import RenderSettings
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from .observations import Observations
from .settings import Norm, ReconSettings, Weights


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What one image of the loss looked like."""

    tof: Rendering | None
    """From the ToF camera; None if nothing of it is compared."""
    colour: Rendering | None
    """From the colour camera; None if no colour is compared."""
    squared: Tensor
    """Mean squared difference of quads, of phasors, or, where only colour counts, of colours [squared units]."""


def weights_at(settings: ReconSettings, images: int) -> Weights:
    """The weights in force after ``images`` optimised images: terms that have not begun weigh nothing."""
    schedule, weights = settings.schedule, settings.weights
    return replace(
        weights,
        distortion=weights.distortion if images >= schedule.distortion_from * schedule.images else 0.0,
        flow=weights.flow if images >= schedule.flow_from else 0.0,
        colour=weights.colour if images >= schedule.colour_from else 0.0,
    )


def render_settings_at(settings: ReconSettings, images: int) -> RenderSettings:
    """The renderer in force after ``images`` optimised images: harmonics gain a degree now and then."""
    every = settings.schedule.sh_degree_every
    if every is None:
        return settings.render
    return replace(settings.render, sh_degree=min(images // every, settings.render.sh_degree))


def terms(
    field: GaussianField,
    motion: Motion | None,
    attachment: Float[Tensor, "N M"],
    observations: Observations,
    frame: int,
    settings: ReconSettings,
    weights: Weights,
    backgrounds: Mapping[str, Tensor] | None = None,
    render: RenderSettings | None = None,
) -> tuple[dict[str, Tensor], Seen]:
    """Render one image and compare it.

    Args:
        field: Gaussians where nothing has moved yet.
        motion: Where they are at the time of the image; None: nothing moves.
        attachment: What ``motion.attach`` said of this field.
        observations: What was measured.
        frame: A raw frame. Of quads only its own slot is rendered, at its own time and pose; a phasor is that of its
            quartet.
        settings: Which terms, in which form.
        weights: Of the terms; those of weight 0 are left out, and nothing is rendered for them.
        backgrounds: Random light from behind everything, by image: quads or phasor [quad units], colour [1].
        render: How to render; None: as the settings say.

    Returns:
        The weighted terms, whose sum is the loss, and what was rendered.
    """
    render = render or settings.render
    time = observations.time_at(frame)
    still = torch.zeros_like(field.mean)
    displacement = still if motion is None else motion.displacement(attachment, time)
    result: dict[str, Tensor] = {}
    tof = colour = squared = None
    if weights.quads > 0 or weights.depth > 0 or weights.distortion > 0:
        moved = replace(field, colour_sh=None).moved(displacement)
        tof = _render(moved, observations.cameras[frame], observations, frame, settings, render, backgrounds)
    if tof is not None and weights.quads > 0:
        loss, squared = _tof_loss(tof, observations, frame, weights.ssim)
        result["quads"] = weights.quads * loss
    if tof is not None and weights.depth > 0 and frame // FRAMES_PER_QUARTET in observations.closed_form:
        measured = observations.closed_form[frame // FRAMES_PER_QUARTET][None]
        result["depth"] = weights.depth * image_loss(tof.distance[None], measured, weights.ssim, Norm.L1)
    if tof is not None and weights.distortion > 0:
        result["distortion"] = weights.distortion * tof.distortion.mean()
    if weights.colour > 0 and frame in observations.colour:
        taken, then = float(observations.sequence.times[frame]), displacement
        if motion is not None and taken != time:
            then = motion.displacement(attachment, taken)
        camera = observations.colour_cameras[frame]
        colour = _render(field.moved(then), camera, observations, frame, settings, render, backgrounds)
        assert colour.colour is not None
        measured = observations.colour[frame]
        result["colour"] = weights.colour * image_loss(colour.colour, measured, weights.ssim, weights.colour_norm)
        if squared is None:
            squared = quad_error(colour.colour.detach(), measured).mean()
    if motion is not None and weights.motion_size > 0:
        result["motion_size"] = weights.motion_size * motion_size(displacement).mean()
    if motion is not None and weights.flow > 0 and frame % FRAMES_PER_QUARTET == 0:
        flow = flow_loss(field, motion, attachment, observations, frame, render)
        if flow is not None:
            result["flow"] = weights.flow * flow
    return result, Seen(tof=tof, colour=colour, squared=still.new_zeros(()) if squared is None else squared)


def _render(
    field: GaussianField,
    camera: Camera,
    observations: Observations,
    frame: int,
    settings: ReconSettings,
    render: RenderSettings,
    backgrounds: Mapping[str, Tensor] | None,
) -> Rendering:
    """One rendering; colour is part of it if the field has any."""
    wanted = ("colour",) if field.colour_sh is not None else ("quads", "phasor")
    lights = {name: light for name, light in (backgrounds or {}).items() if name in wanted}
    return rasterize(
        field,
        camera,
        observations.sensor_at(frame),
        render,
        background=Background(**lights),
        screen_gradient=settings.densify.every is not None,
    )


def _tof_loss(tof: Rendering, observations: Observations, frame: int, ssim: float) -> tuple[Tensor, Tensor]:
    """Loss of the quad or phasor, and its mean squared difference."""
    if observations.phasors:
        measured = observations.phasors[frame]
        squared = phasor_error(tof.phasor, measured).mean()
        return _mixed(squared, tof.phasor[:2], measured, ssim), squared.detach()
    measured = observations.quads[frame][None]
    squared = quad_error(tof.quads, measured).mean()
    return _mixed(squared, tof.quads, measured, ssim), squared.detach()


def image_loss(
    rendered: Float[Tensor, "C H W"], measured: Float[Tensor, "C H W"], ssim: float, norm: Norm = Norm.L2
) -> Tensor:
    """(1 - ssim) times the mean L1 or L2 difference + ssim (1 - SSIM), means over pixels and channels.

    Raises:
        ValueError: If the shapes differ.
    """
    squared = quad_error(rendered, measured)
    difference = squared.mean() if norm == Norm.L2 else (rendered - measured).abs().mean()
    return _mixed(difference, rendered, measured, ssim)


def _mixed(difference: Tensor, rendered: Tensor, measured: Tensor, ssim: float) -> Tensor:
    loss = (1.0 - ssim) * difference
    return loss + ssim * (1.0 - similarity(rendered, measured).mean()) if ssim > 0 else loss


def flow_loss(
    field: GaussianField,
    motion: Motion,
    attachment: Float[Tensor, "N M"],
    observations: Observations,
    frame: int,
    render: RenderSettings,
) -> Tensor | None:
    """Squared difference of rendered and measured flow [px^2] from a quartet's start to both neighbours; None: no flow.

    The mean is over all pixels and both components, unknown ones counting zero. Gradients reach the motion through the
    displacement between keys only: the surface and all weights are held fixed (method, section 5). If the camera moves,
    the flow of its own motion is part of both.
    """
    quartet = frame // FRAMES_PER_QUARTET
    steps = [step for step in (1, -1) if (quartet, step) in observations.flow]
    if not steps:
        return None
    cameras = observations.cameras
    camera = cameras[frame]
    here, *there = motion.key_offsets(attachment, [quartet, *(quartet + step for step in steps)])
    offsets = [offset - here for offset in there]
    still = replace(field, colour_sh=None).moved(here).map(torch.Tensor.detach)
    seen = rasterize(still, camera, observations.sensor_at(frame), render, extra=torch.cat(offsets, dim=1))
    assert seen.extra is not None
    ray = camera.rays(device=field.device)
    surface = torch.as_tensor(camera.centre).to(ray) + ray * seen.distance.detach()[..., None]
    errors = []
    for n, step in enumerate(steps):
        later = cameras[min(frame + FRAMES_PER_QUARTET * step, len(cameras) - 1)]
        moved = image_motion(surface, seen.extra[3 * n : 3 * n + 3], camera.project, later.project)
        errors.append(flow_error(moved, observations.flow[quartet, step])[0].mean())
    return torch.stack(errors).sum()
