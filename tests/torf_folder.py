"""TöRF folders that tests make themselves, file by file:
a camera and a colour camera move in front of a wall.
"""

import numpy as np

DEPTH_RANGE = 10.0  # [m]
WALL_Z = 3.0  # [m]
# ToF from colour camera
RELATIVE = np.array([[1, 0, 0, 0.05], [0, 0.8, -0.6, 0.01], [0, 0.6, 0.8, 0], [0, 0, 0, 1.0]])


def poses(count, speed=0.2):
    """camera_from_world [N, 4, 4] of a camera that moves right and nearer."""
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, 3] = np.arange(count)[:, None] * speed * np.array([-1.0, 0.0, -1.0])
    return result


def intrinsics(height, width):
    """For integer pixel centres; cx is not half the width."""
    return np.array(
        [[0.8 * width, 0, (width - 1) / 2], [0, 0.9 * width, (height - 1) / 2], [0, 0, 1]]
    )


def images(
    count, height=6, width=8, *, speed=0.2, noise=0.0, phase_offset=0.0, depth_range=DEPTH_RANGE
):
    """Phasors [N, H, W, 3] and true distances [N, H, W] [m], float32."""
    matrix, pose = intrinsics(height, width), poses(count, speed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    sx, sy = (x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1]
    z = WALL_Z + pose[:, 2, 3][:, None, None]
    wall_x = sx * z - pose[:, 0, 3][:, None, None]
    distance = z * np.sqrt(1 + sx**2 + sy**2)
    amplitude = (0.5 + 0.4 * np.sin(7.0 * wall_x) * np.cos(5.0 * sy * z)) / distance**2
    phase = 4 * np.pi * distance / depth_range + phase_offset
    phasor = np.stack([2 * amplitude * np.cos(phase), 2 * amplitude * np.sin(phase)], axis=-1)
    phasor += noise * np.random.default_rng(0).standard_normal(phasor.shape)
    length = np.hypot(phasor[..., :1], phasor[..., 1:])
    return np.concatenate([phasor, length], axis=-1).astype(np.float32), distance.astype(np.float32)


def colour_images(count, height=12, width=16):
    """Random colour [N, h, w, 3], float32."""
    return np.random.default_rng(1).random((count, height, width, 3)).astype(np.float32)


def build(folder, count=3, *, first_id=0, matlab=False, truth="distance", height=6, width=8, **how):
    """Write a folder: ``first_id`` 1 and ``matlab`` make it like the original recordings.

    ``how`` goes to :func:`images`. Without ``matlab`` everything is .npy, as in synthetic sets.
    """
    import scipy.io

    phasors, distance = images(count, height, width, **how)
    colour = colour_images(count)
    for name in ("tof", "color", "cams", truth):
        (folder / name).mkdir(parents=True)
    for i in range(count):
        np.save(folder / f"tof/{i + first_id:04d}.npy", phasors[i])
        np.save(folder / f"color/{i + first_id:04d}.npy", colour[i])
        np.save(folder / f"{truth}/{i + first_id:04d}.npy", distance[i])
    numbers = {
        "tof_intrinsics": ("K", intrinsics(height, width)),
        "color_intrinsics": ("K", np.array([[20.0, 0, 7.0], [0, 21.0, 5.0], [0, 0, 1]])),
        "depth_range": ("depth_range", how.get("depth_range", DEPTH_RANGE)),
        "phase_offset": ("P", how.get("phase_offset", 0.0)),
    }
    for name, (key, value) in numbers.items():
        if matlab:
            scipy.io.savemat(folder / f"cams/{name}.mat", {key: value})
        else:
            np.save(folder / f"cams/{name}.npy", value)
    np.save(folder / "cams/tof_extrinsics.npy", poses(count, how.get("speed", 0.2)))
    np.save(folder / "cams/relative_pose.npy", RELATIVE)
    return folder
