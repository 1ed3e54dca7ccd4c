"""Renderings of the Gaussians of a run, in the units of its sequence."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ...render.api import Rendering, rasterize
from ...render.replay import Replay
from ...scene.camera import Camera
from ...scene.gaussians import GaussianField
from .stored import StoredRun, at_frequency


def rendering_of(
    run: StoredRun,
    time: float,
    camera: Camera,
    *,
    extra: Float[Tensor, "N D"] | None,
    f_mod_hz: float | None,
) -> Rendering:
    """Images of the Gaussians of a run, see :meth:`gftorf_warp.Run.render`."""
    field = run.field.moved(*run.motion.at(run.binding, time))
    rendering = rasterize(
        widened(run, field, camera),
        camera,
        at_frequency(run.sensor, f_mod_hz),
        run.render_settings,
        extra=extra,
    )
    return replace(
        rendering,
        quads=rendering.quads / run.quad_scale,
        phasor=rendering.phasor / run.quad_scale,
        colour=None if rendering.colour is None else rendering.colour / run.colour_scale,
    )


def replay_of(run: StoredRun, images: Collection[str], f_mod_hz: float | None) -> Replay:
    """:func:`rendering_of` for many renderings, of the named images only."""
    field = run.field if "colour" in images else replace(run.field, colour_sh=None)
    sensor = replace(
        at_frequency(run.sensor, f_mod_hz),
        source_intensity=float(run.sensor.source_intensity) / run.quad_scale,
    )
    known = field, run.motion, run.binding, sensor, run.render_settings, _optimised(run)
    return Replay(*known, frozenset(images), colour_scale=run.colour_scale)


def widened(run: StoredRun, field: GaussianField, camera: Camera) -> GaussianField:
    """Gaussians as wide as during the optimisation, for a camera that resolves more.

    The renderer's low-pass filter widens every Gaussian on the image, by ``low_pass`` at any
    resolution. One that was fitted to smaller images would be thinner here by the difference,
    which is added to it as low_pass ((z / f)^2 of the optimisation - (z / f)^2 of ``camera``)
    [m^2].
    """
    footprint, footprint_here = (_footprint(field, view) for view in (_optimised(run), camera))
    missing = run.render_settings.low_pass * (
        footprint.square() - footprint_here.square()
    ).clamp_min(0.0)
    return replace(field, log_scale=0.5 * (field.scale.square() + missing[:, None]).log())


def _optimised(run: StoredRun) -> Camera:
    """The camera of raw frame 0 at the resolution of the optimisation."""
    return run.camera.resized(*run.config["size_optimised"])


def _footprint(field: GaussianField, camera: Camera) -> Float[Tensor, "N"]:
    """Width of a pixel at each Gaussian [m]."""
    pose = torch.as_tensor(camera.camera_from_world).to(field.mean)
    return (field.mean @ pose[2, :3] + pose[2, 3]) / math.sqrt(camera.fx * camera.fy)
