"""A simulated recording in the codes of a camera, and how people store such recordings."""

import functools
import tempfile
from pathlib import Path

import numpy as np

from gftorf_warp import Sequence
from gftorf_warp.sim.simulate import simulate

SIZE, FRAMES = (16, 12), 9
ZERO = 2048


@functools.cache
def recording():
    """Nine raw frames of a moving scene: shifts 0, 180, 90, 270 degrees, quads in whole codes."""
    with tempfile.TemporaryDirectory() as folder:
        path = simulate("demo", Path(folder) / "seq", frames=FRAMES, size=SIZE, format="capture")
        sequence = Sequence.open(path)
    scale = 1500 / np.abs(sequence.quads).max()
    return sequence, np.rint(sequence.quads * scale).astype(np.int16)


def keys(**changes):
    """Text of a TOML file for the recording; ``sensor__taps="..."`` changes the key sensor.taps,
    None removes it.
    """
    sequence, _ = recording()
    lens = sequence.intrinsics
    degrees = [round(float(np.degrees(shift)), 9) for shift in sequence.shifts[:4]]
    values = {
        "values.zero": ZERO,
        "sensor.f_mod_hz": sequence.calibration.f_mod_hz,
        "sensor.shifts_deg": degrees,
        "sensor.phase_offset_deg": float(np.degrees(sequence.calibration.phase_offset)),
        "sensor.dc_offset": sequence.calibration.dc_offset,
        "time.rate_hz": 1 / sequence.times[1],
        "camera.fx": lens.fx,
        "camera.fy": lens.fy,
        "camera.cx": lens.cx - 0.5,
        "camera.cy": lens.cy - 0.5,
    }
    values |= {name.replace("__", "."): value for name, value in changes.items()}
    lines = [f"{name} = {toml(v)}" for name, v in values.items() if v is not None]
    return "\n".join(lines) + "\n"


def toml(value):
    """A value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    return (
        f"'{value}'"
        if isinstance(value, str)
        else repr(float(value) if "." in f"{value}" else value)
    )
