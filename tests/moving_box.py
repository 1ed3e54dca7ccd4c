"""A textured box slides and comes nearer in front of a textured wall: quads,
exact flow and truth in closed form.
"""

from dataclasses import replace

import numpy as np
from sequences import changed, sequence_of

from gftorf_warp import Truth
from gftorf_warp.constants import CANONICAL_SHIFTS, FRAME_RATE_HZ, SPEED_OF_LIGHT

HEIGHT, WIDTH, FRAMES = 36, 48, 16
FOCAL = 42.0  # [px]
WALL_Z, BOX_Z = 3.6, 2.4  # [m] z-depths at frame 0
BOX = (-0.75, 0.05, -0.40, 0.35)  # [m] left, right of the box at frame 0; top, bottom
STEP = np.array([0.035, 0.004, -0.008])  # [m] per raw frame
NOISE = 0.0004  # [quad units]
BASELINE = 0.06  # [m] the colour camera stands to the right of the other


def ray_slopes():
    """[H, W] x / z and y / z of the ray through every pixel centre."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return (x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL


def seen(n):
    """[H, W] at raw frame n: distance along the ray [m], reflectivity,
    and whether it is the box.
    """
    sx, sy = ray_slopes()
    z = BOX_Z + STEP[2] * n
    x, y = sx * z - STEP[0] * n, sy * z - STEP[1] * n
    box = (x > BOX[0]) & (x < BOX[1]) & (y > BOX[2]) & (y < BOX[3])
    pattern = 0.6 + 0.25 * np.sin(9.0 * x) * np.cos(7.0 * y + 0.5)
    wall = 0.5 + 0.15 * np.sin(5.0 * sx * WALL_Z + 1.0) * np.cos(6.0 * sy * WALL_Z)
    z_depth = np.where(box, z, WALL_Z)
    return z_depth * np.sqrt(1.0 + sx**2 + sy**2), np.where(box, pattern, wall), box


def flow(n, frames):
    """[2, H, W] motion [px] of what raw frame n sees until ``frames`` later; zero off the box."""
    sx, sy = ray_slopes()
    z = BOX_Z + STEP[2] * n
    moved = np.stack([sx * z, sy * z, np.full_like(sx, z)]) + frames * STEP[:, None, None]
    uv = np.stack([moved[0] / moved[2] - sx, moved[1] / moved[2] - sy]) * FOCAL
    return np.where(seen(n)[2], uv, 0.0).astype(np.float32)


def recording(
    *,
    frames=FRAMES,
    order=(0, 1, 2, 3),
    phase_offset=0.0,
    dc_offset=0.0,
    noise=NOISE,
    with_flow=True,
    **changes,
):
    """The sequence and its truth; slot k shows canonical shift ``order[k]``."""
    shifts = np.array(CANONICAL_SHIFTS)[np.array(order)[np.arange(frames) % 4]]
    slope = 4.0 * np.pi / 15.0
    images = [seen(n) for n in range(frames)]
    quads = np.stack(
        [
            r / d**2 * (np.cos(slope * d + phase_offset - s) + dc_offset)
            for (d, r, _), s in zip(images, shifts, strict=True)
        ]
    )
    quads += noise * np.random.default_rng(0).standard_normal(quads.shape)
    starts = range(0, frames, 4)
    fields = {
        "quads": quads.astype(np.float32),
        "measured": np.ones(frames, dtype=bool),
        "shifts": shifts,
        "times": np.arange(frames) / FRAME_RATE_HZ,
        "f_mod_hz": SPEED_OF_LIGHT / 15.0,
        "phase_offset": phase_offset,
        "dc_offset": dc_offset,
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "camera_from_world": np.tile(np.eye(4), (frames, 1, 1)),
    }
    if with_flow:
        fields["forward_flow"] = {n: flow(n, 4) for n in starts if n + 4 < frames}
        fields["backward_flow"] = {n: flow(n, -4) for n in starts if n >= 4}
    truth = Truth(
        distance=np.stack([d for d, _, _ in images]).astype(np.float32),
        known=np.ones(frames, dtype=bool),
    )
    return sequence_of(**fields | changes), truth


def turned(degrees, position=(0.0, 0.0, 0.0)):
    """World-to-camera pose of a camera at ``position`` turned about the vertical axis."""
    a = np.radians(degrees)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def with_colour(sequence, *, size=(2 * WIDTH, 2 * HEIGHT)):
    """The sequence with smooth images of a colour camera of its own at quartet starts."""
    width, height = size
    y, x = np.mgrid[0:height, 0:width] / 20.0
    image = 40.0 * np.stack(
        [0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.3 + 0.0 * x], axis=-1
    ).astype(np.float32)
    poses = sequence.camera_from_world.copy()
    poses[:, 0, 3] -= BASELINE
    zoom = width / WIDTH
    return changed(
        sequence,
        colour=dict.fromkeys(range(0, sequence.frames, 4), image),
        colour_intrinsics=(zoom * FOCAL, zoom * FOCAL, width / 2, height / 2),
        colour_from_world=poses,
    )


def as_phasors(sequence):
    """What a camera that combines quartets itself would have delivered."""
    quads = sequence.quads.reshape(-1, 4, *sequence.quads.shape[1:])
    re, im = quads[:, 0] - quads[:, 1], quads[:, 2] - quads[:, 3]
    halves = np.stack([re, -re, im, -im], axis=1) / 2
    times = sequence.times - (np.arange(sequence.frames) % 4) / 120
    return replace(
        sequence, quads=halves.reshape(sequence.quads.shape), times=times, from_phasors=True
    )
