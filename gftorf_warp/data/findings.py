"""Findings of ``gftorf check`` in images: order, scale, truth, flow, camera motion."""

from __future__ import annotations

import itertools
import math

import numpy as np

from ..constants import SPEED_OF_LIGHT
from ..errors import InputError
from . import constant, estimates, specs, torf
from .arrays import as_float32, read_array
from .decode import (
    closed_form_distance,
    decode_quartet,
    largest_amplitude,
    quad_scale,
    unambiguous_range,
)
from .folder import numbered
from .read import read_truth
from .report import Report
from .sequence import Sequence, Truth

# of the pixels of a frame at an extreme value: light repeats a value only where it is clipped
SATURATED_SHARE = 1e-3
# and at least so many, since the brightest pixel of a small image is not saturation
SATURATED_PIXELS = 10
# of the correlation of stored phasors with the quads: motion alone lowers it by a few per cent
MATCH_MIN = 0.9
RANGE_TOLERANCE = 0.02  # relative, of the depth_range that the truth implies
OFFSET_TOLERANCE_RAD = 0.05  # [rad] 6 cm at 20 MHz
# [m] a stored "truth" this close to the decoded distance where that changes by more is no truth
DECODED_M = 1e-3
DECODED_SHARE = 0.9  # of the changing pixels
CHANGING_PIXELS = 100  # a static scene without noise decodes to its truth
# of the correlation of the third channel with the length of (re, im), where it is an amplitude
THIRD_MATCH_MIN = 0.9
AMBIGUOUS_SHARE = 0.1  # of the pixels: outlines of moving objects and dark corners are fewer
MOVED_SHARE = 0.5  # of the bright pixels: a single object rarely covers as much
BASELINE_MAX_M = 1.0  # [m] two cameras of one housing are centimetres apart
Z_FITS = 0.8  # ratio of residuals: below, the stored numbers are z-depth
FITTED_M = 1e-3  # [m] a residual below this needs no other explanation


def light(sequence: Sequence, report: Report) -> None:
    """Amplitude and saturation."""
    factor, source = quad_scale(sequence)
    largest = largest_amplitude(sequence)
    report.add("amplitude", f"largest phasor {largest:.6g}; quads times {factor:.6g}; {source}")
    extremes = float(sequence.quads.min()), float(sequence.quads.max())
    pixels = sequence.height * sequence.width
    at_extreme = np.isin(sequence.quads[sequence.measured], extremes).sum(axis=(1, 2))
    cut = at_extreme[at_extreme >= max(SATURATED_PIXELS, SATURATED_SHARE * pixels)]
    if len(cut):
        report.warn(
            "saturation",
            f"saturation: up to {cut.max() / pixels:.1%} of the pixels of {len(cut)} raw "
            f"frames sit at the extremes {extremes[0]:.4g} and {extremes[1]:.4g}: biased phase",
        )


def frequencies(sequence: Sequence, report: Report) -> None:
    """Agreement of several modulation frequencies on one distance."""
    if len(sequence.frequencies) < 2:
        return
    decoded = [decode_quartet(sequence, i) for i in sequence.complete_quartets]
    confidence = [
        d.confidence[np.hypot(*d.phasors[0]) > 0] for d in decoded if d.confidence is not None
    ]
    median = float(np.median(np.concatenate(confidence)))
    ambiguous = float(np.mean([d.ambiguous.mean() for d in decoded]))
    text = f"{unambiguous_range(sequence):.4g} m together; median confidence {median:.2f}, "
    report.add("unwrapping", f"{text}{ambiguous:.1%} of the pixels ambiguous")
    if ambiguous > AMBIGUOUS_SHARE:
        report.warn(
            "unwrapping",
            f"frequencies disagree: {ambiguous:.0%} of the pixels would fit another distance as "
            "well; noise, motion within a cycle, or another phase offset at each frequency",
        )


def constant_part(sequence: Sequence, report: Report) -> None:
    """Constant part of raw quads: an additive zero, or a multiple of the amplitude."""
    part, used = constant.constant_part(sequence), sequence.calibration
    text = f"{part.size:.2g} of the amplitude: additive {part.zero:.4g} explains "
    text += f"{part.explained(part.left_by_zero):.0%}, dc_offset {part.dc_offset:.4f} "
    text += f"{part.explained(part.left_by_dc):.0%}; in use is dc_offset {used.dc_offset:g}"
    report.add("constant part", text)
    if not part.is_explained:
        report.warn(
            "constant part",
            f"dc_offset {used.dc_offset:g} leaves {part.left:.2g} of the amplitude: "
            f"{part.advice(sequence, report.form)}",
        )


def third_channel(sequence: Sequence, report: Report) -> None:
    """Third channel of stored phasors compared with the length of the first two."""
    assert sequence.path is not None
    spec = specs.fields(report.form)["phasor"]
    files = torf.stored(sequence.path).files
    images = [as_float32(f, spec, read_array(f, spec))[0] for f in files.values()]
    stored = np.stack(images).astype(np.float64)
    length, third = np.hypot(stored[..., 0], stored[..., 1]), stored[..., 2]
    scale = math.sqrt(float((length**2).sum()) * float((third**2).sum()))
    correlation = float((length * third).sum()) / scale if scale > 0 else 0.0
    ratio = float((length * third).sum() / (length**2).sum())
    text = f"{ratio:.4g} times the length of (re, im), correlation {correlation:.4f}"
    report.add("third channel", text)
    if correlation < THIRD_MATCH_MIN:
        report.warn("third channel", "third channel: not the amplitude of (re, im); it is not used")


def camera(sequence: Sequence, report: Report) -> None:
    """Camera motion without poses, and an implausibly distant colour camera."""
    if (sequence.camera_from_world == np.eye(4)).all():
        share = estimates.changed_share(sequence)
        report.add(
            "change",
            f"{share:.0%} of all but the darkest pixels, from the first to the last quartet",
        )
        if share > MOVED_SHARE:
            report.warn(
                "poses",
                f"poses: all are identity, but {share:.0%} of the pixels change: if the "
                f"camera moved, store its poses in {_places_of_poses(report.form)}",
            )
    if sequence.colour.camera_from_world is not None:
        relative = sequence.camera_from_world @ np.linalg.inv(sequence.colour.camera_from_world)
        baseline = float(np.linalg.norm(relative[:, :3, 3], axis=1).max())
        report.add("baseline", f"{baseline:.4g} m from the colour camera to the ToF camera")
        if baseline > BASELINE_MAX_M:
            away = f"the colour camera is {baseline:.4g} m away"
            report.warn("baseline", f"{away}: millimetres, or another coordinate system?")


def _places_of_poses(form: str) -> str:
    """Where poses are stored so that the format's reader takes them."""
    if form == "capture":
        return specs.location(form, "pose")
    names = ("tof_extrinsics", "poses") if form == "ftorf" else ("tof_extrinsics",)
    return " and ".join(specs.location(form, name) for name in names)


def phasors(sequence: Sequence, report: Report) -> None:
    """Stored phasors compared with those of the quads."""
    assert sequence.path is not None
    spec = specs.fields(report.form)["phasor"]
    size = {"H": sequence.height, "W": sequence.width}
    for pattern in spec.paths:
        stored = {
            n: as_float32(f, spec, read_array(f, spec, size))[0]
            for n, f in numbered(sequence.path, pattern).items()
            if n % sequence.cycle == 0 and n < sequence.frames
        }
        match = estimates.phasor_match(sequence, stored) if stored else None
        if match is None:
            continue
        folder, degrees = pattern.partition("/")[0], math.degrees(match.angle)
        text = f"{folder}: correlation {match.correlation:.4f} at {degrees:+.2f} degrees with the "
        report.add("phasors", f"{text}quads, {match.factor:.4g} times their length")
        if match.correlation < MATCH_MIN or abs(match.angle) > OFFSET_TOLERANCE_RAD:
            mirrored = "; mirrored phase fits better" if match.conjugate > match.correlation else ""
            report.warn(
                "stored phasors",
                f"quads and {folder} disagree: wrong order, sign or offset{mirrored}",
            )


def truth(sequence: Sequence, report: Report) -> None:
    """Stored distance compared with decoded static pixels."""
    assert sequence.path is not None
    patterns = specs.fields(report.form)["distance"].paths
    used = next((p for p in patterns if numbered(sequence.path, p)), patterns[0])
    folder = used.partition("/")[0]
    try:
        truth = read_truth(sequence)
    except InputError as error:
        report.warn(
            "truth unreadable", f"{folder} cannot be read: {error.where}: {error.what}, {error.why}"
        )
        return
    if truth is None:
        report.add("truth", "none")
        return
    # fmin and fmax ignore NaN and copy nothing: truth may be as large as the recording
    nearest, farthest = (float(f.reduce(truth.distance, axis=None)) for f in (np.fmin, np.fmax))
    unambiguous = unambiguous_range(sequence)
    frames = int(truth.known.sum()) // (sequence.cycle if sequence.from_phasors else 1)
    span = "no known pixel" if np.isnan(farthest) else f"{nearest:.4g} .. {farthest:.4g} m"
    report.add("truth", f"{frames} frames in {folder}, {span}")
    if _is_decoded(sequence, truth):
        decoded = "these quads: it is not ground truth, do not compare with it"
        if sequence.from_phasors:
            decoded = "these phasors, or they are without noise: doubtful as ground truth"
        report.warn("truth decoded", f"{folder} was decoded from {decoded}")
        return
    if farthest > unambiguous:
        report.warn(
            "wrap",
            f"range wraps: distances to {farthest:.4g} m, unambiguous to {unambiguous:.4g} m",
        )
    poses = sequence.camera_from_world
    if not sequence.from_phasors and (poses != poses[0]).any():
        report.add("phase fit", "none: the camera moves between the raw frames of a quartet")
        return
    _fit(sequence, truth, folder, report)


def _fit(sequence: Sequence, truth: Truth, folder: str, report: Report) -> None:
    """Range and offset implied by the truth, and whether it is along the ray or z-depth."""
    fit = estimates.phase_fit(sequence, truth)
    if fit is None:
        report.add("phase fit", "too few static pixels")
        return
    text = f"depth_range {fit.depth_range:.5g} m, phase_offset {fit.phase_offset:+.4f} rad, "
    text += f"rms {fit.rms_m * 1e3:.1f} mm on {fit.pixels} static pixels"
    report.add("phase fit", text)
    if_z = Truth(distance=estimates.distance_of_z(sequence, truth), known=truth.known)
    as_z = estimates.phase_fit(sequence, if_z)
    if as_z is not None and fit.rms_m > FITTED_M and as_z.rms_m < Z_FITS * fit.rms_m:
        report.warn(
            "z-depth",
            f"{folder} fits the phase better as z-depth, rms {as_z.rms_m * 1e3:.1f} mm against "
            f"{fit.rms_m * 1e3:.1f} mm: it is read as distance along the ray, convert it",
        )
        return
    used = SPEED_OF_LIGHT / sequence.calibration.f_mod_hz
    offset = abs(np.angle(np.exp(1j * (fit.phase_offset - sequence.calibration.phase_offset))))
    if abs(fit.depth_range / used - 1) > RANGE_TOLERANCE or offset > OFFSET_TOLERANCE_RAD:
        report.warn(
            "truth",
            f"truth implies depth_range {fit.depth_range:.4g} m and phase_offset "
            f"{fit.phase_offset:+.3f} rad, in use are {used:.4g} m and "
            f"{sequence.calibration.phase_offset:+.3f} rad",
        )


def _is_decoded(sequence: Sequence, truth: Truth) -> bool:
    """Whether the stored distance follows the decoded one where that changes by noise or motion."""
    quartets = sequence.complete_quartets
    decoded = {i: closed_form_distance(sequence, i) for i in quartets}
    changing = agreeing = 0
    for before, i in itertools.pairwise(quartets):
        changes = np.abs(decoded[i] - decoded[before]) > DECODED_M
        agrees = np.abs(truth.distance[sequence.cycle * i] - decoded[i]) < DECODED_M
        changing += int(changes.sum())
        agreeing += int(agrees[changes].sum())
    return changing >= CHANGING_PIXELS and agreeing > DECODED_SHARE * changing


def flow(sequence: Sequence, report: Report) -> None:
    """Whether stored flow explains the motion between frames of one shift."""
    for name, images, step in (
        ("forward", sequence.flow.forward, sequence.cycle),
        ("backward", sequence.flow.backward, -sequence.cycle),
    ):
        match = estimates.flow_match(sequence, images, step)
        if match is None:
            continue
        text = f"unwarped {match[0]:.4g}, warped {match[1]:.4g}, sign flipped {match[2]:.4g}, "
        text = f"mean difference where it moves: {text}dx and dy swapped {match[3]:.4g}"
        report.add(f"{name} flow", text)
        if match[1] > min(match):
            warning = "does not explain the motion: check its sign, channels and frame step"
            report.warn("flow", f"{name} flow {warning}")
