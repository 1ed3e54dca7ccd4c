"""A finished run in memory whose Gaussians come and go and turn brighter from some sides, with its
sequence on disk and a camera that moves.
"""

from dataclasses import replace

import numpy as np
import torch
from cases import gaussians
from sequences import sequence_of

from gftorf_warp.constants import CANONICAL_SHIFTS, FRAME_RATE_HZ
from gftorf_warp.data.write import write
from gftorf_warp.recon.run import Run
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.scene.windows import Windows

WIDTH, HEIGHT, FRAMES = 24, 18, 8  # two quartets
CAMERA = Camera.from_fov(WIDTH, HEIGHT, 60.0)
NEAR = {"near": 0.1, "far": 20.0, "support": "alpha", "stop": "inclusive"}


def poses():
    """[F, 4, 4] a camera that turns about the vertical and steps aside."""
    found = np.tile(np.eye(4), (FRAMES, 1, 1))
    for n, angle in enumerate(np.linspace(0.0, 0.1, FRAMES)):
        found[n, :3, :3] = [
            [np.cos(angle), 0.0, np.sin(angle)],
            [0.0, 1.0, 0.0],
            [-np.sin(angle), 0.0, np.cos(angle)],
        ]
        found[n, 0, 3] = 0.02 * n
    return found


def sequence():
    """Raw frames without content, for times, poses and intrinsics."""
    return sequence_of(
        quads=np.ones((FRAMES, HEIGHT, WIDTH), np.float32),
        measured=np.ones(FRAMES, dtype=bool),
        shifts=np.array([CANONICAL_SHIFTS[n % 4] for n in range(FRAMES)]),
        times=np.arange(FRAMES) / FRAME_RATE_HZ,
        f_mod_hz=Sensor().f_mod_hz,
        fx=CAMERA.fx,
        fy=CAMERA.fy,
        cx=CAMERA.cx,
        cy=CAMERA.cy,
        camera_from_world=poses(),
    )


def moving_gaussians(count, colour):
    """Gaussians of three labels: always there, in the first quartet, in the second."""
    field = gaussians(count, CAMERA, seed=3, opacity=(0.4, 0.9), colour=colour)
    layer = torch.arange(count) % 3
    keys = torch.arange(3, dtype=torch.float64) * 4 / FRAME_RATE_HZ
    nodes = field.mean[[1 % count, 2 % count]]
    velocity = torch.tensor([[0.4, 0.0, 0.1], [0.0, -0.3, 0.0]])
    motion = Windows(keys, nodes, torch.tensor([1, 2]), velocity)
    return replace(field, layer=layer), motion


def exportable(folder, *, colour=True, count=60):
    """The run, optimised at half the size of its sequence, whose folder is below ``folder``."""
    write("ftorf", folder / "seq", sequence())
    field, motion = moving_gaussians(count, colour)
    render = NEAR | {"clamp_gradient": "exact", "distortion": "paper", "low_pass": 0.3}
    return Run(
        path=folder / "run",
        config={
            "settings": {"render": render},
            "size_optimised": [WIDTH // 2, HEIGHT // 2],
            "colour_scale": 0.5,
            "camera": {"width": WIDTH, "height": HEIGHT},
            "sequence": str(folder / "seq"),
            "frame_rate_hz": FRAME_RATE_HZ,
        },
        camera=CAMERA,
        sensor=Sensor(shifts=CANONICAL_SHIFTS),
        quad_scale=3.0,
        field=field,
        motion=motion,
        binding=motion.bind(field),
    )
