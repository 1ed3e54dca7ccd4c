"""Sequences and folders that the tests of data/ make themselves."""

import hashlib
from pathlib import Path

import numpy as np
from sequences import sequence_of, values_of

from gftorf_warp import Truth
from gftorf_warp.constants import CANONICAL_SHIFTS, SPEED_OF_LIGHT

SAMPLE = Path(__file__).parent / "data" / "ftorf_sample_box"
REAL_ORDER = (2, 0, 1, 3)  # -cos, +sin, +cos, -sin in time
IMAGES = ("colour", "forward_flow", "backward_flow")
CAPTURE_ONLY = {
    "frequencies_hz",
    "cycle_length",
    "distortion",
    "exposures",
    "tap_sums",
    "sensor",
    "amplitude",
    "body",
    "layers",
}  # what only format capture stores


def scene(
    frames=8,
    height=6,
    width=8,
    permutation=REAL_ORDER,
    phase_offset=0.3,
    dc_offset=0.2,
    distance=None,
    **changes,
):
    """A noise-free recording of a static wall in front of a camera, and its truth."""
    generator = np.random.default_rng(frames * 1000 + height * 100 + width)
    if distance is None:
        distance = np.linspace(1.0, 4.0, height * width).reshape(
            height, width
        ) + 0.1 * generator.random((height, width))
    distance = np.broadcast_to(distance, (frames, height, width)).astype(np.float32)
    shifts = np.array(CANONICAL_SHIFTS)[np.argsort(permutation)[np.arange(frames) % 4]]
    f_mod_hz = SPEED_OF_LIGHT / 15.0
    phase = 4 * np.pi * distance / 15.0 + phase_offset
    reflectivity = 0.2 + 0.8 * generator.random((height, width))
    quads = reflectivity / distance**2 * (np.cos(phase - shifts[:, None, None]) + dc_offset)
    fields = {
        "quads": quads.astype(np.float32),
        "measured": np.ones(frames, dtype=bool),
        "shifts": shifts,
        "times": np.arange(frames) / 120.0,
        "f_mod_hz": f_mod_hz,
        "phase_offset": phase_offset,
        "dc_offset": dc_offset,
        "fx": 0.85 * width,
        "fy": 0.85 * width,
        "cx": width / 2,
        "cy": height / 2,
        "camera_from_world": np.tile(np.eye(4), (frames, 1, 1)),
    }
    truth = Truth(distance=distance.copy(), known=np.ones(frames, dtype=bool))
    return sequence_of(**fields | changes), truth


def random_poses(frames, generator):
    """Rigid motions that nothing relates."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(generator.normal(size=(frames, 3, 3)))[0]
    poses[:, :3, 0] *= np.linalg.det(poses[:, :3, :3])[:, None]
    poses[:, :3, 3] = generator.normal(size=(frames, 3))
    return poses


def assert_same(got, want):
    """Two sequences hold the same bits, apart from where they are from."""
    got, want = values_of(got), values_of(want)
    for name, b in want.items():
        a = got[name]
        if name in IMAGES:
            assert a.keys() == b.keys(), name
            for n in a:
                assert_same_bits(a[n], np.asarray(b[n], dtype=np.float32), f"{name}[{n}]")
        elif isinstance(b, np.ndarray):
            assert_same_bits(a, b, name)
        else:
            assert a == b, name


def assert_same_bits(got, want, name):
    """Two arrays agree in type, shape and every bit."""
    assert (got.dtype, got.shape) == (want.dtype, want.shape), name
    assert got.tobytes() == want.tobytes(), name


def fingerprint(folder):
    """Every file below a folder with its content and time of change."""
    files = sorted(path for path in Path(folder).rglob("*") if path.is_file())
    return [
        (
            str(f.relative_to(folder)),
            f.stat().st_mtime_ns,
            hashlib.sha256(f.read_bytes()).hexdigest(),
        )
        for f in files
    ]
