"""``gftorf check``: what a sequence holds, where each value is from, what it says about itself, what looks wrong."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..constants import FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError
from . import estimates, specs
from .arrays import as_float32, read_array
from .calibration import FORMAT
from .decode import closed_form_distance, largest_amplitude, quad_scale
from .ftorf import numbered, read, read_truth
from .sequence import Sequence, Truth

DC_TOLERANCE = 0.1  # [1] real differential quads stay within a few hundredths of 0, unipolar ones are at 1
SATURATED_SHARE = 1e-3  # of the pixels of a frame at the very extreme: light repeats itself only where it is cut off
SATURATED_PIXELS = 10  # and no fewer, so that the one brightest pixel of a small image is none
NARROW_VIEW = 5.0  # focal length in image widths: a view below 11 degrees is more often a mistake in units
MATCH_MIN = 0.9  # of the correlation of stored phasors with the quads: motion alone costs a few per cent
RANGE_TOLERANCE = 0.02  # relative, of the depth_range that the truth implies
OFFSET_TOLERANCE_RAD = 0.05  # [rad] 6 cm at 20 MHz
DECODED_M = 1e-3  # [m] a "truth" this close to the decoded quads, where those change by more, was decoded from them
DECODED_SHARE = 0.9  # of the changing pixels
CHANGING_PIXELS = 100  # a static scene without noise is decoded to its truth, and nothing is wrong with that


@dataclass(kw_only=True)
class Report:
    """Outcome of a check; ``str`` of it is what is printed."""

    path: Path
    """The sequence."""
    lines: list[str] = field(default_factory=list)
    """Facts, one a line."""
    warnings: list[str] = field(default_factory=list)
    """What looks wrong, or was assumed."""

    def __str__(self) -> str:
        flags = [f"warning: {text}" for text in self.warnings] or ["no warnings"]
        return "\n".join([f"{self.path}: F-ToeRF sequence", *(f"  {line}" for line in self.lines), *flags])


def check(path: str | Path) -> Report:
    """Read a sequence, print-ready, with estimates that betray a wrong order, offset or scale.

    Args:
        path: The folder.

    Raises:
        InputError: If the sequence cannot be read at all.
    """
    sequence = read(path)
    report = Report(path=Path(path))
    _facts(sequence, report)
    _assumptions(sequence, report)
    if sequence.complete_quartets and np.abs(sequence.quads).max() > 0:
        _quads(sequence, report)
        _phasors(sequence, report)
        _truth(sequence, report)
    else:
        report.warnings.append("no complete quartet with light: nothing can be decoded or estimated")
    _flow(sequence, report)
    return report


def _facts(sequence: Sequence, report: Report) -> None:
    """Counts and values, each with its source."""
    measured, sources = int(sequence.measured.sum()), sequence.sources
    degrees = np.round(np.degrees(sequence.shifts[:FRAMES_PER_QUARTET])).astype(int).tolist()
    period = np.diff(sequence.times)
    report.lines += [
        f"raw frames      {measured} of {sequence.frames} measured, {len(sequence.complete_quartets)} complete "
        f"quartets, {sequence.width}x{sequence.height} pixels; {sources['measured']}",
        f"quads           {sequence.quads.min():.4g} .. {sequence.quads.max():.4g}; {sources['quads']}",
        f"shifts          {', '.join(map(str, degrees))} degrees in time; {sources['shifts']}",
        f"times           0 .. {sequence.times[-1]:.4g} s"
        + (f", {period.min():.4g} to {period.max():.4g} s apart" if len(period) else "")
        + f"; {sources['times']}",
        f"f_mod_hz        {sequence.f_mod_hz / 1e6:.6g} MHz, unambiguous to "
        f"{SPEED_OF_LIGHT / (2 * sequence.f_mod_hz):.4g} m; {sources['f_mod_hz']}",
        f"phase_offset    {sequence.phase_offset:.6g} rad; {sources['phase_offset']}",
        f"dc_offset       {sequence.dc_offset:.6g}; {sources['dc_offset']}",
        f"quad_scale      {'none' if sequence.quad_scale is None else f'{sequence.quad_scale:.6g}'}; "
        f"{sources['quad_scale']}",
        f"intrinsics      fx {sequence.fx:.6g}, fy {sequence.fy:.6g} px; {sources['fx']}",
        f"principal point {sequence.cx:.6g}, {sequence.cy:.6g} px, centres at i + 0.5; {sources['cx']}",
        f"poses           {sources['camera_from_world']}",
        f"colour          {sources['colour']}",
        f"forward flow    {sources['forward_flow']}",
        f"backward flow   {sources['backward_flow']}",
    ]
    assert sequence.path is not None
    for pattern in (p for f in specs.fields(FORMAT).values() for p in f.paths if "{id}" in p):
        for slot in range(FRAMES_PER_QUARTET if "{slot}" in pattern else 1):
            name = pattern.replace("{slot}", str(slot))
            ids = list(numbered(sequence.path, name))
            if ids:
                steps = ", ".join(f"{step} ({count}x)" for step, count in _counts(np.diff(ids)))
                report.lines.append(f"ids {name:<28} {len(ids)} from {ids[0]} to {ids[-1]}, steps {steps or 'none'}")


def _assumptions(sequence: Sequence, report: Report) -> None:
    """Everything that was not in a file and would matter, and what is missing."""
    sources, missing = sequence.sources, np.flatnonzero(~sequence.measured)
    if len(missing):
        shown = ", ".join(f"{n}" for n in missing[:10]) + (" .." if len(missing) > 10 else "")
        report.warnings.append(f"{len(missing)} raw frames were not measured: {shown}")
    if sequence.frames % FRAMES_PER_QUARTET:
        report.warnings.append(f"the last quartet is truncated after {sequence.frames % FRAMES_PER_QUARTET} frames")
    if sources["times"].startswith("default"):
        report.warnings.append("frame rate assumed: 120 Hz; cams/frame_times.npy states another")
    if sources["f_mod_hz"].startswith("default"):
        report.warnings.append("modulation frequency assumed: no cams/depth_range.npy")
    if sources["pixel_centre"].startswith("inferred"):
        report.warnings.append(f"pixel centres {sources['pixel_centre']}; state them in cams/pixel_centre.json")
    if "other poses" in sources["camera_from_world"]:
        report.warnings.append(f"poses: {sources['camera_from_world']}; cams/poses.json makes them count")
    if "amplitude, not colour" in sources["colour"]:
        report.warnings.append("colour: three equal channels: amplitude, not colour")
    if "warped copies" in sources["measured"]:
        report.warnings.append(f"quads: {sources['measured']}")
    for name, focal, size in (("fx", sequence.fx, sequence.width), ("fy", sequence.fy, sequence.height)):
        if focal > NARROW_VIEW * size:
            angle = math.degrees(2 * math.atan(size / (2 * focal)))
            report.warnings.append(f"{name} {focal:.4g} at {size} px is a view of {angle:.1f} degrees: millimetres?")
    if not (0 <= sequence.cx <= sequence.width and 0 <= sequence.cy <= sequence.height):
        report.warnings.append(f"the principal point {sequence.cx:.4g}, {sequence.cy:.4g} lies outside the image")


def _quads(sequence: Sequence, report: Report) -> None:
    """Amplitude, constant part, order and saturation."""
    factor, source = quad_scale(sequence)
    report.lines.append(
        f"amplitude       largest phasor {largest_amplitude(sequence):.6g}; quads times {factor:.6g}; {source}"
    )
    estimate = estimates.dc_offset(sequence)
    report.lines.append(
        f"dc estimate     {estimate:.4f} = mean(Q0 + Q1 + Q2 + Q3) / (4 mean a), {sequence.dc_offset:g} in use"
    )
    if abs(estimate - sequence.dc_offset) > DC_TOLERANCE:
        report.warnings.append(f"dc_offset {sequence.dc_offset:g} is in use, but the quads say {estimate:.3f}")
    stated, shares = estimates.pairings(sequence)
    texts = ["".join(f"(q{a},q{b})" for a, b in pairs) for pairs in estimates.PAIRINGS]
    found = ", ".join(f"{text} on {share:.0%}" for text, share in zip(texts, shares, strict=True))
    report.lines.append(f"order           opposite pairs fit best: {found} of bright static pixels")
    if stated is not None and shares[stated] < max(shares):
        best = int(np.argmax(shares))
        report.warnings.append(
            f"quad order doubtful: stored pairing {texts[stated]} fits {shares[stated]:.0%} of static pixels, "
            f"{texts[best]} {shares[best]:.0%}; check tof_permutation.npy"
        )
    extremes = float(sequence.quads.min()), float(sequence.quads.max())
    pixels = sequence.height * sequence.width
    at_extreme = np.isin(sequence.quads[sequence.measured], extremes).sum(axis=(1, 2))
    cut = at_extreme[at_extreme >= max(SATURATED_PIXELS, SATURATED_SHARE * pixels)]
    if len(cut):
        report.warnings.append(
            f"saturation: up to {cut.max() / pixels:.1%} of the pixels of {len(cut)} raw frames sit at the extreme "
            f"values {extremes[0]:.4g} and {extremes[1]:.4g}, which biases phase"
        )


def _phasors(sequence: Sequence, report: Report) -> None:
    """Stored phasors against those of the quads."""
    assert sequence.path is not None
    spec = specs.fields(FORMAT)["phasor"]
    size = {"H": sequence.height, "W": sequence.width}
    for pattern in spec.paths:
        files = {n: f for n, f in numbered(sequence.path, pattern).items() if n % FRAMES_PER_QUARTET == 0}
        stored = {n: as_float32(f, spec, read_array(f, spec, size))[0] for n, f in files.items() if n < sequence.frames}
        match = estimates.phasor_match(sequence, stored) if stored else None
        if match is None:
            continue
        folder = pattern.partition("/")[0]
        report.lines.append(
            f"phasors         {folder}: correlation {match.correlation:.4f} at {math.degrees(match.angle):+.2f} "
            f"degrees with the quads, {match.factor:.4g} times their length"
        )
        if match.correlation < MATCH_MIN or abs(match.angle) > OFFSET_TOLERANCE_RAD:
            mirrored = "; mirrored phase fits better" if match.conjugate > match.correlation else ""
            report.warnings.append(f"quads and {folder} disagree: wrong order, sign or offset{mirrored}")


def _truth(sequence: Sequence, report: Report) -> None:
    """Decoded static pixels against the stored distance."""
    assert sequence.path is not None
    try:
        truth = read_truth(sequence.path, frames=sequence.frames)
    except InputError as error:
        report.warnings.append(f"synthetic_depth cannot be read: {error.where}: {error.what}, {error.why}")
        return
    if truth is None:
        report.lines.append("truth           none")
        return
    seen = truth.distance[np.isfinite(truth.distance)]
    unambiguous = SPEED_OF_LIGHT / (2 * sequence.f_mod_hz)
    report.lines.append(
        f"truth           {int(truth.known.sum())} frames in synthetic_depth"
        + (f", {seen.min():.4g} .. {seen.max():.4g} m" if len(seen) else ", no known pixel")
    )
    if _is_decoded(sequence, truth):
        report.warnings.append("synthetic_depth was decoded from these quads: it is no truth, do not compare with it")
        return
    if len(seen) and seen.max() > unambiguous:
        report.warnings.append(f"range wraps: distances to {seen.max():.4g} m, unambiguous to {unambiguous:.4g} m")
    fit = estimates.phase_fit(sequence, truth)
    if fit is None:
        report.lines.append("phase fit       too few static pixels")
        return
    report.lines.append(
        f"phase fit       depth_range {fit.depth_range:.5g} m, phase_offset {fit.phase_offset:+.4f} rad, "
        f"rms {fit.rms_m * 1e3:.1f} mm on {fit.pixels} static pixels"
    )
    used = SPEED_OF_LIGHT / sequence.f_mod_hz
    offset = abs(np.angle(np.exp(1j * (fit.phase_offset - sequence.phase_offset))))
    if abs(fit.depth_range / used - 1) > RANGE_TOLERANCE or offset > OFFSET_TOLERANCE_RAD:
        report.warnings.append(
            f"truth implies depth_range {fit.depth_range:.4g} m and phase_offset {fit.phase_offset:+.3f} rad, "
            f"in use are {used:.4g} m and {sequence.phase_offset:+.3f} rad"
        )


def _is_decoded(sequence: Sequence, truth: Truth) -> bool:
    """Whether the stored distance follows the decoded one even where noise and motion change it."""
    quartets = sequence.complete_quartets
    decoded = {i: closed_form_distance(sequence, i) for i in quartets}
    changing = agreeing = 0
    for before, i in itertools.pairwise(quartets):
        changes = np.abs(decoded[i] - decoded[before]) > DECODED_M
        changing += int(changes.sum())
        agreeing += int((np.abs(truth.distance[FRAMES_PER_QUARTET * i] - decoded[i]) < DECODED_M)[changes].sum())
    return changing >= CHANGING_PIXELS and agreeing > DECODED_SHARE * changing


def _flow(sequence: Sequence, report: Report) -> None:
    """Whether given flow explains the motion between frames of one shift."""
    for name, images, step in (
        ("forward", sequence.forward_flow, FRAMES_PER_QUARTET),
        ("backward", sequence.backward_flow, -FRAMES_PER_QUARTET),
    ):
        match = estimates.flow_match(sequence, images, step)
        if match is None:
            continue
        report.lines.append(
            f"{name + ' flow':<15} mean difference where it moves: unwarped {match[0]:.4g}, warped {match[1]:.4g}, "
            f"sign flipped {match[2]:.4g}, dx and dy swapped {match[3]:.4g}"
        )
        if match[1] > min(match):
            report.warnings.append(f"{name} flow does not explain the motion: check its sign, channels and frame step")


def _counts(steps: np.ndarray) -> list[tuple[int, int]]:
    """Each different step with how often it occurs."""
    values, counts = np.unique(steps, return_counts=True)
    return list(zip(values.tolist(), counts.tolist(), strict=True))
