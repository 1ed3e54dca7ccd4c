"""The loss of one image, term by term: {name: weighted scalar} (method, section 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..losses.image import similarity
from ..losses.prior import flow_error, image_motion, motion_size
from ..losses.tof import quad_error
from ..render import fused
from ..render.api import Background, Rendering, rasterize
from ..render.buffers import RenderSettings, Workspace
from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.motion import Displacement, Motion
from ..scene.sensor import Sensor
from .observations import Observations
from .settings import Kernels, Norm, ReconSettings, Weights

NEAREST = 1e-6  # [m] of a surface: where nothing is seen nothing moves, wherever that is but at the camera itself


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
    """The weights in force after ``images`` optimised images: terms that have not begun weigh nothing.

    Flow weighs ``flow_every`` times as much in one step of so many, counted as if all steps were quartets, and nothing
    in the others: on average the same.
    """
    schedule, weights = settings.schedule, settings.weights
    flows = images >= schedule.flow_from and images // settings.cycle % schedule.flow_every == 0
    return replace(
        weights,
        distortion=weights.distortion if images >= schedule.distortion_from * schedule.images else 0.0,
        flow=schedule.flow_every * weights.flow if flows else 0.0,
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
    kernel = settings.kernels != Kernels.NONE
    time = observations.time_at(frame)
    still = Displacement(torch.zeros_like(field.mean), None)
    displacement = still if motion is None else motion.at(attachment, time)
    result: dict[str, Tensor] = {}
    tof = colour = squared = None
    if weights.quads > 0 or weights.depth > 0 or weights.distortion > 0:
        moved = replace(field, colour_sh=None).moved(*displacement)
        sensor = observations.sensor_at(frame)
        camera, light = observations.cameras[frame], "phasor" if observations.phasors else "quads"
        tof = rendering_of(moved, camera, sensor, settings, render, weights, backgrounds, light=light)
    if tof is not None and weights.quads > 0:
        if observations.phasors:  # an amplitude is not compared: re and im say it already
            rendered, measured = tof.phasor[:2], observations.phasors[frame]
        else:
            rendered, measured = tof.quads, observations.quads[frame][None]
        loss, squared = image_loss(rendered, measured, weights.ssim, kernel=kernel)
        result["quads"] = weights.quads * loss
    cycle = observations.sequence.cycle
    if tof is not None and weights.depth > 0 and frame // cycle in observations.closed_form:
        measured = observations.closed_form[frame // cycle][None]
        loss, _ = image_loss(tof.distance[None], measured, weights.ssim, Norm.L1, kernel=kernel)
        result["depth"] = weights.depth * loss
    if tof is not None and weights.distortion > 0:
        result["distortion"] = weights.distortion * tof.distortion.mean()
    if weights.colour > 0 and frame in observations.colour:
        taken, then = float(observations.sequence.times[frame]), displacement
        if motion is not None and taken != time:
            then = motion.at(attachment, taken)
        camera = observations.colour_cameras[frame]
        sensor = observations.sensor_at(frame)
        colour = rendering_of(field.moved(*then), camera, sensor, settings, render, weights, backgrounds)
        assert colour.colour is not None
        measured = observations.colour[frame]
        loss, of_colour = image_loss(colour.colour, measured, weights.ssim, weights.colour_norm, kernel=kernel)
        result["colour"] = weights.colour * loss
        squared = of_colour if squared is None else squared
    if motion is not None and weights.motion_size > 0:
        result["motion_size"] = weights.motion_size * motion_size(displacement.offset).mean()
    if motion is not None and weights.flow > 0 and frame % cycle == 0:
        flow = flow_loss(field, motion, attachment, observations, frame, render, kernel=kernel)
        if flow is not None:
            result["flow"] = weights.flow * flow
    return result, Seen(tof=tof, colour=colour, squared=field.mean.new_zeros(()) if squared is None else squared)


def rendering_of(
    field: GaussianField,
    camera: Camera,
    sensor: Sensor,
    settings: ReconSettings,
    render: RenderSettings,
    weights: Weights,
    backgrounds: Mapping[str, Tensor] | None,
    *,
    light: str = "quads",
    flows: Float[Tensor, "N D"] | None = None,
    workspace: Workspace | None = None,
) -> Rendering:
    """One rendering before random light from behind, of what the loss looks at; with colour if the field has any.

    Args:
        field: Gaussians where they are.
        camera: Where from.
        sensor: What quads are.
        settings: What is compared.
        render: How.
        weights: Of the terms.
        backgrounds: Random light, see :func:`terms`.
        light: The image that is compared, quads or phasor.
        flows: Displacements [m], three each, that come along as extra channels; their gradient reaches them alone.
        workspace: Where to render; None: in memory of its own.
    """
    wanted = ("colour",) if field.colour_sh is not None else ("quads", "phasor")
    lights = {name: light for name, light in (backgrounds or {}).items() if name in wanted}
    images = {"opacity"}
    if field.colour_sh is None:  # otherwise colour is what is compared, which comes by itself
        images |= {light, *(["distortion"] if weights.distortion > 0 else [])}
        images |= {"distance"} if weights.depth > 0 or flows is not None else set()
    return rasterize(
        field,
        camera,
        sensor,
        render,
        background=Background(**lights),
        screen_gradient=settings.densify.every is not None,
        images=images,
        extra=flows,
        extra_detached=flows is not None,
        workspace=workspace,
    )


def image_loss(
    rendered: Float[Tensor, "C H W"],
    measured: Float[Tensor, "C H W"],
    ssim: float,
    norm: Norm = Norm.L2,
    *,
    kernel: bool = False,
) -> tuple[Tensor, Tensor]:
    """(1 - ssim) times the mean L1 or L2 difference + ssim (1 - SSIM), and the mean squared difference, detached.

    Args:
        rendered: What gradients reach.
        measured: What they do not reach.
        ssim: Share of the similarity.
        norm: Of the difference.
        kernel: Whether the hand-written kernels do it, in float32; without a similarity torch does.

    Raises:
        ValueError: If the shapes differ.
    """
    if kernel and ssim > 0:
        return fused.image_loss(rendered, measured, ssim, absolute=norm == Norm.L1)[:2]
    squared = quad_error(rendered, measured).mean()
    difference = squared if norm == Norm.L2 else (rendered - measured).abs().mean()
    loss = (1.0 - ssim) * difference
    if ssim > 0:
        loss = loss + ssim * (1.0 - similarity(rendered, measured).mean())
    return loss, squared.detach()


def flow_loss(
    field: GaussianField,
    motion: Motion,
    attachment: Float[Tensor, "N M"],
    observations: Observations,
    frame: int,
    render: RenderSettings,
    *,
    kernel: bool = False,
) -> Tensor | None:
    """Squared difference of rendered and measured flow [px^2] from a quartet's start to both neighbours; None: no flow.

    The mean is over all pixels and both components, unknown ones counting zero. Gradients reach the motion through the
    displacement between keys only: the surface and all weights are held fixed (method, section 5). If the camera moves,
    the flow of its own motion is part of both. ``kernel``: whether the hand-written kernels compare.
    """
    cycle = observations.sequence.cycle
    quartet = frame // cycle
    steps = [step for step in (1, -1) if (quartet, step) in observations.flow]
    if not steps:
        return None
    starts = [motion.times[quartet + step] for step in (0, *steps)]
    here, *there = motion.at_times(attachment, starts)
    still = replace(field, colour_sh=None).moved(*here).map(torch.Tensor.detach)
    camera, sensor = observations.cameras[frame], observations.sensor_at(frame)
    channels, wanted = torch.cat([end.offset - here.offset for end in there], dim=1), ("distance",)
    seen = rasterize(still, camera, sensor, render, extra=channels, images=wanted)
    assert seen.extra is not None
    last = len(observations.cameras) - 1
    later = [observations.cameras[min(frame + cycle * step, last)] for step in steps]
    measured = [observations.flow[quartet, step] for step in steps]
    if kernel:
        return fused.flow_loss(seen.distance, seen.extra, torch.stack(measured)[None], camera, later)
    return flow_between(seen.distance, seen.extra, measured, camera, later, observations.rays_at(frame))


def flow_between(
    distance: Float[Tensor, "H W"],
    displacement: Float[Tensor, "D H W"],
    measured: Sequence[Float[Tensor, "2 H W"]],
    camera: Camera,
    later: Sequence[Camera],
    rays: tuple[Float[Tensor, "3"], Float[Tensor, "H W 3"]],
) -> Tensor:
    """Sum over some flows of the mean squared difference [px^2] to what displacements would show.

    Args:
        distance: Of the surface [m]; without gradient.
        displacement: Composited displacements to the end of each flow [m], three channels each.
        measured: The flows; NaN: unknown.
        camera: Where from.
        later: The camera at the end of each flow.
        rays: Centre of the camera [m] and unit vectors through its pixels, in world axes.
    """
    centre, ray = rays
    surface = centre + ray * distance.detach().clamp_min(NEAREST)[..., None]
    errors = []
    for n, (flow, then) in enumerate(zip(measured, later, strict=True)):
        moved = image_motion(surface, displacement[3 * n : 3 * n + 3], camera.project, then.project)
        errors.append(flow_error(moved, flow)[0].mean())
    return torch.stack(errors).sum()
