"""One training step in plain torch, the oracle of recon/step.py and recon/stepper.py.

Shares with them the renderer, the motion models, the schedule, the order of raw frames and the
densification. Its own are the losses (losses/), the mean over the images, gradient clipping, Adam
(torch.optim) and the sums. Every rendering is a call of the public ``rasterize``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gftorf_warp.losses.image import similarity
from gftorf_warp.losses.prior import flow_error, image_motion, motion_size
from gftorf_warp.losses.tof import quad_error
from gftorf_warp.recon import densify
from gftorf_warp.recon.observations import Observations
from gftorf_warp.recon.optimiser import EPSILON, frozen, rates_at
from gftorf_warp.recon.settings import Norm, ReconSettings
from gftorf_warp.recon.state import State
from gftorf_warp.recon.stepper import densify_after, draw
from gftorf_warp.recon.terms import render_settings_at
from gftorf_warp.render import fused
from gftorf_warp.render.api import Background, Rendering, rasterize
from gftorf_warp.render.buffers import RenderSettings
from gftorf_warp.scene.gaussians import GaussianField
from gftorf_warp.scene.motion import Motion, Still

NEAREST = 1e-6  # [m] of a surface where there is none


@dataclass
class PlainImage:
    """The weighted terms of one image, and its renderings."""

    terms: dict[str, Tensor]
    tof: Rendering | None = None
    colour: Rendering | None = None
    squared: Tensor | None = None

    @property
    def primary(self) -> Rendering | None:
        """The rendering that densification is based on."""
        return self.tof or self.colour


def plain_weights(settings: ReconSettings, images: int) -> dict[str, float]:
    """Weight of every term after so many images."""
    schedule, weights = settings.schedule, settings.weights
    flow = images >= schedule.flow_from and images // settings.cycle % schedule.flow_every == 0
    distortion = images >= schedule.distortion_from * schedule.images
    return {
        "quads": weights.quads,
        "depth": weights.depth,
        "distortion": weights.distortion * distortion,
        "colour": weights.colour * (images >= schedule.colour_from),
        "motion_size": weights.motion_size,
        "flow": schedule.flow_every * weights.flow * flow,
    }


def plain_image(
    field: GaussianField,
    motion: Motion | None,
    binding: Tensor,
    observations: Observations,
    frame: int,
    settings: ReconSettings,
    *,
    first: int = 0,
    number: int = 0,
    seed: int | None = None,
) -> PlainImage:
    """Render the image of one raw frame and compare it.

    Args:
        field: Gaussians.
        motion: Their motion; None: nothing moves.
        binding: Of the Gaussians to it.
        observations: What is compared.
        frame: The raw frame.
        settings: Of the run.
        first: Optimised images before the step, for weights and the degree of harmonics.
        number: Of this image, for its background.
        seed: Of backgrounds; None: black.
    """
    sequence, image = observations.sequence, PlainImage({})
    weights = {
        name: weight for name, weight in plain_weights(settings, first).items() if weight > 0
    }
    render, ssim = render_settings_at(settings, first), settings.weights.ssim
    quartet, camera, sensor = (
        frame // sequence.cycle,
        observations.cameras[frame],
        observations.sensor_at(frame),
    )

    def displacement_at(time: float):
        return (torch.zeros_like(field.mean), None) if motion is None else motion.at(binding, time)

    def background(channels: int, camera, stream: int) -> Tensor | None:
        if seed is None or settings.background == 0:
            return None
        origin = torch.tensor([seed, number], dtype=torch.int32, device=field.device)
        return fused.uniform(
            (channels, camera.height, camera.width), origin, settings.background, stream=stream
        )

    displacement = displacement_at(observations.time_at(frame))
    compared: dict[str, Tensor] = {}
    if weights.keys() & {"quads", "depth", "distortion"}:
        light = ("phasor", 3) if observations.phasors else ("quads", 1)
        behind = {light[0]: background(light[1], camera, 0)} if "quads" in weights else {}
        moved = replace(field, colour_sh=None).moved(*displacement)
        image.tof = tof = _rendered(moved, camera, sensor, render, behind, settings)
        if "quads" in weights and observations.phasors:
            compared["quads"], image.squared = plain_loss(
                tof.phasor[:2], observations.phasors[frame], ssim
            )
        elif "quads" in weights:
            compared["quads"], image.squared = plain_loss(
                tof.quads, observations.quads[frame][None], ssim
            )
        if "depth" in weights and quartet in observations.closed_form:
            measured = observations.closed_form[quartet]
            compared["depth"], _ = plain_loss(tof.distance[None], measured, ssim, Norm.L1)
        compared["distortion"] = tof.distortion.mean()
    if "colour" in weights and frame in observations.colour:
        moved, taken_by = (
            field.moved(*displacement_at(float(sequence.times[frame]))),
            observations.colour_cameras[frame],
        )
        behind = {"colour": background(3, taken_by, 1)}
        image.colour = _rendered(moved, taken_by, sensor, render, behind, settings)
        measured, norm = observations.colour[frame], settings.weights.colour_norm
        compared["colour"], squared = plain_loss(image.colour.colour, measured, ssim, norm)
        image.squared = squared if image.squared is None else image.squared
    if motion is not None:
        compared["motion_size"] = motion_size(displacement[0]).mean()
        if "flow" in weights and frame % sequence.cycle == 0 and quartet in observations.flow:
            compared["flow"] = plain_flow(field, motion, binding, observations, frame, render)
    image.terms = {
        name: weights[name] * value for name, value in compared.items() if name in weights
    }
    return image


def plain_loss(
    rendered: Tensor, measured: Tensor, ssim: float, norm: Norm = Norm.L2
) -> tuple[Tensor, Tensor]:
    """(1 - ssim) times the mean L1 or L2 difference + ssim (1 - SSIM),
    and the mean squared difference.
    """
    squared = quad_error(rendered, measured).mean()
    difference = squared if norm == Norm.L2 else (rendered - measured).abs().mean()
    return (1.0 - ssim) * difference + ssim * (
        1.0 - similarity(rendered, measured).mean()
    ), squared.detach()


def plain_flow(
    field: GaussianField,
    motion: Motion,
    binding: Tensor,
    observations: Observations,
    frame: int,
    render,
) -> Tensor:
    """Squared difference to the measured flow [px^2] to both neighbours of a quartet;
    blending is held fixed.
    """
    cycle, times = observations.sequence.cycle, motion.key_times.tolist()
    times, quartet, camera = motion.times, frame // cycle, observations.cameras[frame]
    start = motion.at(binding, times[quartet])
    ends = {
        step: motion.at(binding, times[quartet + step])
        for step in (1, -1)
        if 0 <= quartet + step < len(times)
    }
    still = replace(field, colour_sh=None).moved(*start).map(torch.Tensor.detach)
    channels = torch.cat([end.offset - start.offset for end in ends.values()], dim=1)
    seen = rasterize(still, camera, observations.sensor_at(frame), render, extra=channels)
    later = [
        observations.cameras[min(max(frame + cycle * step, 0), len(observations.cameras) - 1)]
        for step in ends
    ]
    measured = [observations.flow[quartet][(1, -1).index(step)] for step in ends]
    rays = torch.from_numpy(camera.centre), camera.rays(dtype=torch.float64)
    rays = [ray.to(seen.distance) for ray in rays]
    return plain_flow_error(seen.distance, seen.extra, measured, camera, later, rays)


def plain_flow_error(
    distance: Tensor, displacement: Tensor, measured, camera, later, rays
) -> Tensor:
    """Sum over flows of the mean squared difference [px^2] to the flow that displacements cause.

    Args:
        distance: Of the surface [m].
        displacement: Composited displacements to the end of each flow [m], three channels each.
        measured: The flows [px]; NaN: unknown.
        camera: At the start.
        later: The camera at the end of each flow.
        rays: Centre of the camera [m], and unit vectors through its pixels.
    """
    centre, ray = rays
    surface = centre + ray * distance.detach().clamp_min(NEAREST)[..., None]
    ends = zip(displacement.split(3), measured, later, strict=True)
    errors = [
        flow_error(image_motion(surface, moved, camera.project, then.project), flow)
        for moved, flow, then in ends
    ]
    return torch.stack([error.mean() for error, _ in errors]).sum()


def _rendered(
    field, camera, sensor, render: RenderSettings, behind: dict, settings: ReconSettings
) -> Rendering:
    behind = {name: light for name, light in behind.items() if light is not None}
    watched = settings.densify.every is not None
    return rasterize(
        field, camera, sensor, render, background=Background(**behind), screen_gradient=watched
    )


def plain_step(state: State, observations: Observations, settings: ReconSettings) -> bool:
    """Advance a state by one batch; False: loss or gradient were not finite and no parameter
    changed.
    """
    frames, before = draw(state, observations, settings), state.images
    state.images += len(frames)
    if state.motion.follows_means:
        state.binding = state.motion.bind(state.optimiser.field)
    rests, leaves = frozen(settings, before), state.optimiser.leaves
    moves = before >= settings.schedule.warm_up and not isinstance(state.motion, Still)
    field = state.optimiser.field
    field = field.map(torch.Tensor.detach) if rests else field
    images, total = [], [torch.zeros_like(leaf) for leaf in leaves]
    touched = [False] * len(leaves)
    for n, frame in enumerate(frames):
        images.append(
            plain_image(
                field,
                state.motion if moves else None,
                state.binding,
                observations,
                frame,
                settings,
                first=before,
                number=before + n,
                seed=state.noise_seed,
            )
        )
        if not images[-1].terms:
            continue
        learning = [
            k for k, _ in enumerate(leaves) if not rests or k >= len(state.optimiser.tensors)
        ]
        loss = torch.stack([*images[-1].terms.values()]).sum()
        wanted = [leaves[k] for k in learning]
        # the graph through the binding is shared by the images
        found = torch.autograd.grad(loss, wanted, allow_unused=True, retain_graph=True)
        for k, gradient in zip(learning, found, strict=True):
            if gradient is not None:
                total[k] += gradient / len(frames)
                touched[k] = True
    values = [value for image in images for value in image.terms.values()]
    valid = all(bool(value.isfinite().all()) for value in [*values, *total])
    if valid:
        _add_up(state, observations, frames, images)
        rates = rates_at(
            settings,
            before,
            state.rate_factor,
            reset_at=state.reset_at,
            revived_at=state.revived_at,
        )
        if (
            densify.densification_is_due(before, state.images, settings.densify, settings.schedule)
            and settings.densify.loses_step
        ):
            rates = {name: rate if name == "motion" else 0.0 for name, rate in rates.items()}
        gradients = [
            gradient if used else None for gradient, used in zip(total, touched, strict=True)
        ]
        plain_adam(state.optimiser, gradients, rates, settings.motion_gradient_max)
    densify_after(state, observations, before, settings)
    return valid


def plain_adam(
    optimiser, gradients: list[Tensor | None], rates: dict[str, float], longest: float | None
) -> None:
    """Adam of torch on the moments of an optimiser; a group of rate 0 has no gradient."""
    for leaf, gradient, group in zip(optimiser.leaves, gradients, optimiser.groups, strict=True):
        leaf.grad = gradient if rates[group] > 0 else None
    if longest is not None:
        torch.nn.utils.clip_grad_norm_(optimiser.motion, longest)
    for leaf, group in zip(optimiser.leaves, optimiser.groups, strict=True):
        if leaf.grad is None:
            continue
        adam = torch.optim.Adam(
            [leaf], lr=rates[group], betas=optimiser.betas, eps=EPSILON, foreach=False
        )
        step, first, second = optimiser.moments_of(leaf)
        count = step.cpu()  # torch keeps it there
        adam.state[leaf] = {"step": count, "exp_avg": first, "exp_avg_sq": second}
        adam.step()
        step.copy_(count)
        leaf.grad = None


def _add_up(
    state: State, observations: Observations, frames: list[int], images: list[PlainImage]
) -> None:
    """Add images to the sums of the log and to the statistics of densification."""
    for frame, image in zip(frames, images, strict=True):
        if image.primary is None:
            continue
        with torch.no_grad():
            values = {name: value.detach() for name, value in image.terms.items()}
            values |= {
                "loss": torch.stack([*values.values()]).sum(),
                "opacity": image.primary.opacity.mean(),
            }
            values |= {"quad_mse": image.squared, "count": torch.ones_like(values["loss"])}
            for name, value in values.items():
                state.sums[name] = state.sums.get(name, 0.0) + value
            screen = image.primary.screen
            if screen is not None:
                camera = (observations.cameras if image.tof else observations.colour_cameras)[frame]
                half = screen.gradient.new_tensor([0.5 * camera.width, 0.5 * camera.height])
                state.statistics = replace(
                    state.statistics,
                    gradient=state.statistics.gradient
                    + screen.pixels * (half * screen.gradient).norm(dim=1),
                    pixels=state.statistics.pixels + screen.pixels,
                    weight=state.statistics.weight + screen.weight,
                )
