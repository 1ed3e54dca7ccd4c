"""What config.json says of a run before its first step: where it is from, all settings,
and what they come to.
"""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import torch

from .. import __version__
from ..data.sequence import Sequence
from ..render.buffers import available_threads
from ..scene.measured import camera_of, frame_period, sensor_of
from . import densify
from .observations import data_hash
from .optimiser import betas_of, rates_at
from .settings import ReconSettings, plain


def config_of(
    sequence: Sequence, settings: ReconSettings, *, seed: int, device: torch.device | str
) -> dict[str, object]:
    """What is known before the first step; the rest of config.json follows."""
    camera, sensor = camera_of(sequence, 0), sensor_of(sequence)
    return {
        "version": __version__,
        "preset": settings.preset,
        "seed": seed,
        "images": settings.schedule.images,
        "images_optimised": None,
        "seconds_reconstruct": None,
        "device": str(device),
        "threads": available_threads() if torch.device(device).type == "cpu" else None,
        "sequence": None if sequence.path is None else str(sequence.path.resolve()),
        "data_sha256": data_hash(sequence),
        "excerpt": sequence.excerpt and [sequence.excerpt.start, sequence.excerpt.stop],
        "frames": sequence.frames,
        "frame_rate_hz": _rate(sequence),
        "times": sequence.sources.get("times"),
        "camera": {
            **{
                name: value
                for name, value in asdict(camera).items()
                if name != "distortion" or camera.distortion
            },
            "camera_from_world": camera.camera_from_world.tolist(),
        },
        "sensor": {
            name: getattr(sensor, name)
            for name in ("f_mod_hz", "phase_offset", "dc_offset", "frame_period_s")
        }
        | ({"further_hz": list(sensor.further_hz)} if sensor.further_hz else {}),
        "init": str(settings.init.kind),
        "motion": str(settings.motion.kind),
        "schedule": resolved(settings),
        "settings": plain(settings),
    }


def _rate(sequence: Sequence) -> float:
    """Raw frames, or phasors, per second, as ``frame_rate_hz`` of the reader."""
    times = sequence.times[:: sequence.cycle if sequence.from_phasors else 1]
    period = float(np.diff(times).mean()) if times[-1] > 0 else frame_period(sequence)
    return round(1.0 / period, 9)  # of a time in seconds, which is no exact decimal


def resolved(settings: ReconSettings) -> dict[str, object]:
    """What the schedule means in images and in rates, computed the way the loop computes it."""
    schedule, options = settings.schedule, settings.densify
    rounds = options.every is not None
    opacity_resets = densify.resets(options, schedule)
    instants = {"first": 0, "after_warm_up": schedule.warm_up, "half_way": schedule.images // 2}
    freeze = schedule.freeze_from
    return {
        "images": schedule.images,
        "batch": str(schedule.batch),
        "betas": list(betas_of(settings)),
        **{f"rates_{name}": rates_at(settings, images) for name, images in instants.items()},
        "rates_last": rates_at(settings, schedule.images),
        "motion_from": schedule.warm_up,
        "colour_from": schedule.colour_from if settings.weights.colour > 0 else None,
        "flow_from": schedule.flow_from if settings.weights.flow > 0 else None,
        "distortion_from": math.ceil(schedule.distortion_from * schedule.images),
        "sh_degree_every": schedule.sh_degree_every,
        "densify_every": options.every,
        "densify_until": math.floor(options.stop_share * schedule.images) if rounds else None,
        "opacity_resets": opacity_resets,
        "motion_rests_after_reset": schedule.pause_after_reset if opacity_resets else None,
        "gaussians_frozen_from": None if freeze is None else math.ceil(freeze * schedule.images),
    }
