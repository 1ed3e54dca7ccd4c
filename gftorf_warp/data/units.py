"""Findings of ``gftorf check`` in single numbers: values in another unit or convention."""

from __future__ import annotations

import math

import numpy as np

from ..constants import SPEED_OF_LIGHT
from .report import Report
from .sequence import Sequence

# [Hz] C-ToF cameras modulate at 0.6 to 300 MHz; what is outside is c/f in millimetres, or kilohertz
FREQUENCIES_HZ = (0.5e6, 500e6)
TURN = 2.0 * math.pi  # [rad] a phase offset is known modulo this: a larger number is no radians
# [deg] between a tele lens and a fisheye; a pinhole outside is more often a mistake in units
VIEWS_DEG = (11.0, 130.0)
# [1] of the image size: lenses are centred within a few per cent, other resolutions are at a
# quarter (half the size) or at one half (twice the size)
OFF_CENTRE = 0.2
HALF_PX = 1e-6  # [px] numbers that were computed, not calibrated, agree to the last digits
SPEED_MAX = 30.0  # [m/s] cameras are carried or driven; millimetres for metres are a thousandfold


def frequency(sequence: Sequence, report: Report) -> None:
    """Modulation frequency that no C-ToF camera has."""
    low, high = FREQUENCIES_HZ
    strange = [f for f in sequence.frequencies if not low <= f <= high]
    if strange:
        named = ", ".join(f"{f / 1e6:.4g} MHz (c/f {SPEED_OF_LIGHT / f:.4g} m)" for f in strange)
        report.warn(
            "frequency",
            f"{named}: C-ToF cameras have {low / 1e6:g} to {high / 1e6:g} MHz; depth_range in "
            "millimetres, or a frequency in kilohertz?",
        )


def offset_unit(sequence: Sequence, report: Report) -> None:
    """Phase offset of more than a turn."""
    offset = sequence.calibration.phase_offset
    if abs(offset) > TURN:
        report.warn(
            "offset unit",
            f"phase_offset {offset:.6g} rad is more than a turn: degrees? then state "
            f"{math.radians(offset):.4f}",
        )


def focal_length(sequence: Sequence, report: Report) -> None:
    """Focal length that makes a very narrow or wide view."""
    tof, (low, high) = sequence.intrinsics, VIEWS_DEG
    for name, focal, size in (("fx", tof.fx, sequence.width), ("fy", tof.fy, sequence.height)):
        view = math.degrees(2.0 * math.atan(size / (2.0 * focal)))
        if not low <= view <= high:
            text = f"{name} {focal:.4g} at {size} px is a view of {view:.1f} degrees"
            report.warn("focal length", f"{text}: millimetres, or of another resolution?")


def principal_point(sequence: Sequence, report: Report) -> None:
    """Principal point far from the middle: outside, or of images of another size."""
    tof, width, height = sequence.intrinsics, sequence.width, sequence.height
    off = max(abs(tof.cx / width - 0.5), abs(tof.cy / height - 0.5))
    at = f"the principal point {tof.cx:.4g}, {tof.cy:.4g}"
    if not (0 <= tof.cx <= width and 0 <= tof.cy <= height):
        report.warn("principal point", f"{at} is outside the image of {width}x{height} pixels")
    elif off > OFF_CENTRE:
        scale = 2.0 * tof.cx / width
        report.warn(
            "principal point",
            f"{at} is {off:.0%} of the image of {width}x{height} pixels from its middle: "
            f"intrinsics of images {scale:.3g} times as wide? then divide all four by that",
        )


def half_pixel(sequence: Sequence, report: Report) -> None:
    """Principal point exactly half a pixel beside the middle of the image, in both directions."""
    tof = sequence.intrinsics
    beside = tof.cx - sequence.width / 2.0, tof.cy - sequence.height / 2.0
    if beside[0] == beside[1] and abs(abs(beside[0]) - 0.5) < HALF_PX:
        other = "integer" if beside[0] < 0 else "half"
        report.warn(
            "half pixel",
            f"cx, cy {tof.cx:g}, {tof.cy:g} are exactly {beside[0]:+g} px beside the middle: "
            f"numbers for {other} pixel centres? then add {-beside[0]:+g} to both",
        )


def pose_unit(sequence: Sequence, report: Report) -> None:
    """Camera that is faster than anything that carries one."""
    if len(np.unique(sequence.times)) < 2:
        return
    centres = np.linalg.inv(sequence.camera_from_world)[:, :3, 3]
    travelled = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    speed = travelled / float(sequence.times[-1] - sequence.times[0])
    if speed > SPEED_MAX:
        report.warn(
            "pose unit",
            f"the camera travels {travelled:.4g} m at {speed:.4g} m/s: poses in millimetres, or "
            "times in another unit?",
        )
