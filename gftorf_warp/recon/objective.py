"""The loss of one raw frame, term by term: {name: weighted scalar} (method, section 5)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..constants import FRAMES_PER_QUARTET
from ..losses.image import similarity
from ..losses.prior import flow_error, image_motion, motion_size
from ..losses.tof import quad_error
from ..render.api import Background, Rendering, rasterize
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from .observations import Observations
from .settings import ReconSettings, Weights


def weights_at(settings: ReconSettings, images: int) -> Weights:
    """The weights in force after ``images`` optimised images: terms that have not begun weigh nothing."""
    schedule, weights = settings.schedule, settings.weights
    begun = images >= schedule.distortion_from * schedule.images
    return Weights(
        quads=weights.quads,
        ssim=weights.ssim,
        distortion=weights.distortion if begun else 0.0,
        flow=weights.flow if images >= schedule.flow_from else 0.0,
        motion_size=weights.motion_size,
    )


def terms(
    field: GaussianField,
    motion: Motion,
    attachment: Float[Tensor, "N M"],
    observations: Observations,
    frame: int,
    settings: ReconSettings,
    weights: Weights,
    background: Float[Tensor, "1 H W"] | None,
) -> tuple[dict[str, Tensor], Rendering]:
    """Render raw frame ``frame`` and compare it.

    Args:
        field: Gaussians where nothing has moved yet.
        motion: Where they are at the time of the frame.
        attachment: What ``motion.attach`` said of this field.
        observations: What was measured.
        frame: Which raw frame; only its own slot is rendered, at its own time and pose.
        settings: How to render.
        weights: Of the terms; those of weight 0 are left out.
        background: Random light from behind everything [quad units].

    Returns:
        The weighted terms, whose sum is the loss, and the rendering.
    """
    time = float(observations.sequence.times[frame])
    displacement = motion.displacement(attachment, time)
    rendering = rasterize(
        field.moved(displacement),
        observations.cameras[frame],
        observations.sensor_at(frame),
        settings.render,
        background=None if background is None else Background(quads=background),
        screen_gradient=settings.densify.every is not None,
    )
    result = {"quads": weights.quads * quad_loss(rendering.quads, observations.quads[frame][None], weights.ssim)}
    if weights.distortion > 0:
        result["distortion"] = weights.distortion * rendering.distortion.mean()
    if weights.motion_size > 0:
        result["motion_size"] = weights.motion_size * motion_size(displacement).mean()
    if weights.flow > 0 and frame % FRAMES_PER_QUARTET == 0:
        flow = flow_loss(field, motion, attachment, observations, frame, settings)
        if flow is not None:
            result["flow"] = weights.flow * flow
    return result, rendering


def quad_loss(rendered: Float[Tensor, "1 H W"], measured: Float[Tensor, "1 H W"], ssim: float) -> Tensor:
    """(1 - ssim) L2 + ssim (1 - SSIM), means over the pixels."""
    loss = (1.0 - ssim) * quad_error(rendered, measured).mean()
    return loss + ssim * (1.0 - similarity(rendered, measured).mean()) if ssim > 0 else loss


def flow_loss(
    field: GaussianField,
    motion: Motion,
    attachment: Float[Tensor, "N M"],
    observations: Observations,
    frame: int,
    settings: ReconSettings,
) -> Tensor | None:
    """Squared difference of rendered and measured flow [px^2] from a quartet's start to both neighbours; None: no flow.

    The mean is over all pixels and both components, unknown ones counting zero. Gradients reach the motion through the
    displacement between keys only: the surface and all weights are held fixed (method, section 5).
    """
    quartet = frame // FRAMES_PER_QUARTET
    steps = [step for step in (1, -1) if (quartet, step) in observations.flow]
    if not steps:
        return None
    camera = observations.cameras[frame]
    here = motion.key_offset(attachment, quartet)
    offsets = [motion.key_offset(attachment, quartet + step) - here for step in steps]
    still = field.moved(here).map(torch.Tensor.detach)
    seen = rasterize(still, camera, observations.sensor_at(frame), settings.render, extra=torch.cat(offsets, dim=1))
    assert seen.extra is not None
    ray = camera.rays(device=field.device)
    surface = torch.as_tensor(camera.centre).to(ray) + ray * seen.distance.detach()[..., None]
    errors = [
        flow_error(
            image_motion(surface, seen.extra[3 * n : 3 * n + 3], camera.project), observations.flow[quartet, step]
        )[0]
        for n, step in enumerate(steps)
    ]
    return torch.stack([error.mean() for error in errors]).sum()
