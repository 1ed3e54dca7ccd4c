"""``gftorf check``: content of a sequence, source of each value, estimates and warnings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..constants import FRAMES_PER_QUARTET, SPEED_OF_LIGHT
from ..errors import InputError, UsageError
from . import findings, phase, reprojection, specs, timing, units
from .capture_json import MANIFEST
from .check_sheet import check_sheet
from .constant import spread
from .cycles import frequencies_by_order
from .decode import unambiguous_range
from .files import as_errors, atomic_write
from .folder import format_of, numbered
from .read import read
from .report import Report
from .sequence import Sequence

QUARTETS_MAX = 24  # complete quartets that are decoded: medians over more change little
COARSE_PIXELS = 5000  # enough for a median, in every quartet

NUMBERS = (
    units.frequency,
    units.offset_unit,
    units.focal_length,
    units.principal_point,
    units.half_pixel,
    units.pose_unit,
    timing.time_unit,
    timing.exposure,
    timing.gaps,
    timing.repeats,
)
"""Rules that decode nothing."""
IMAGES = (
    findings.light,
    findings.frequencies,
    phase.phase,
    reprojection.pose_convention,
    findings.camera,
)
"""Rules that need a complete quartet with light."""


def check(
    path: str | Path,
    sheet: str | Path | None = None,
    *,
    rules: Iterable[Callable[[Sequence, Report], None]] = (),
) -> Report:
    """Report on a sequence folder, with estimates that reveal a wrong order, offset or scale.

    Args:
        path: The folder.
        sheet: A picture (PNG) to write, with hypotheses on the order of the shifts.
        rules: Further rules, which add what they find to the report.

    Raises:
        InputError: If the sequence cannot be read at all.
        UsageError: If the picture cannot be written there, or its name is not that of a PNG.
    """
    if sheet is not None and Path(sheet).suffix.lower() != ".png":
        why, fix = "expected a name that ends in .png", f"for example {Path(sheet).stem}.png"
        raise UsageError("not a PNG", where=sheet, why=why, fix=fix)
    sequence = read(path)
    report = Report(path=Path(path), form=format_of(Path(path)))
    _facts(sequence, report)
    _assumptions(sequence, report)
    examine(sequence, report)
    for rule in rules:
        rule(sequence, report)
    if report.findings and (Path(path) / MANIFEST).is_file():
        why = "has the SHA-256 of every file: after a change of your own remove it"
        report.add("manifest", f"{MANIFEST} {why}, or the folder is refused")
    if sheet is not None:
        with as_errors(Path(sheet)):
            atomic_write(sheet, check_sheet(_thinned(sequence), report))
    return report


def examine(sequence: Sequence, report: Report) -> None:
    """Add the findings in a sequence, which may exist in memory only; truth is that of its folder.

    Decoded are a few quartets, spread over the sequence, so that memory and time stay bounded.
    """
    for rule in NUMBERS:
        rule(sequence, report)
    some = _thinned(sequence)
    has_light = some.complete_quartets and np.abs(some.quads).max() > 0
    try:
        unambiguous_range(sequence)
    except InputError as error:
        report.warn("common range", f"{error.what}: {error.why}; nothing is decoded")
    else:
        if has_light:
            timing.slip(_coarse(sequence), report)
            for rule in IMAGES:
                rule(some, report)
            _of_format(some, report)
        else:
            warning = "no complete quartet with light: nothing can be decoded or estimated"
            report.warn("no light", warning)
    findings.flow(sequence, report)


def _thinned(sequence: Sequence) -> Sequence:
    """The sequence with a few of its complete quartets only, spread evenly; the other raw frames
    count as not measured.
    """
    chosen = spread(sequence.complete_quartets, QUARTETS_MAX)
    if len(chosen) == len(sequence.complete_quartets):
        return sequence
    measured = np.zeros(sequence.frames, dtype=bool)
    for i in chosen:
        measured[sequence.quartet_frames(i)] = True
    return replace(sequence, measured=measured)


def _coarse(sequence: Sequence) -> Sequence:
    """The sequence with every n-th row and column, a few thousand pixels."""
    step = max(1, math.isqrt(sequence.height * sequence.width // COARSE_PIXELS))
    return replace(sequence, quads=sequence.quads[:, ::step, ::step])


def _of_format(sequence: Sequence, report: Report) -> None:
    """Findings in what only some formats or recordings have."""
    if sequence.from_phasors and report.form == "torf":
        findings.third_channel(sequence, report)
    elif not sequence.from_phasors:
        findings.constant_part(sequence, report)
    if report.form == "ftorf" and sequence.path is not None:
        findings.phasors(sequence, report)
    if sequence.path is not None:
        findings.truth(sequence, report)


def _facts(sequence: Sequence, report: Report) -> None:
    """Counts and values, each with its source."""
    stated, tof = sequence.calibration, sequence.intrinsics
    measured, sources, colour = int(sequence.measured.sum()), sequence.sources, sequence.colour.size
    inferred = "inferred from shifts and frequencies"
    cycle = inferred if stated.cycle_length is None else sources["cycle_length"]
    scale = "none" if stated.quad_scale is None else f"{stated.quad_scale:.6g}"
    degrees = np.round(np.degrees(sequence.shifts[: sequence.cycle])).astype(int).tolist()
    period = np.diff(sequence.times[:: sequence.cycle if sequence.from_phasors else 1])
    apart = f", {period.min():.4g} to {period.max():.4g} s apart" if len(period) else ""
    size = "" if colour is None else f", {colour[1]}x{colour[0]} pixels"

    def fact(name: str, text: str, source: str) -> None:
        report.add(name, f"{text}; {sources[source]}")

    quartets, range_m = len(sequence.complete_quartets), SPEED_OF_LIGHT / (2 * stated.f_mod_hz)
    text = f"{measured} of {sequence.frames} measured, {quartets} complete quartets, "
    fact("raw frames", f"{text}{sequence.width}x{sequence.height} pixels", "measured")
    report.add("cycle", f"{sequence.cycle} raw frames; {cycle}")
    fact("quads", f"{sequence.quads.min():.4g} .. {sequence.quads.max():.4g}", "quads")
    fact("shifts", f"{', '.join(map(str, degrees))} degrees in time", "shifts")
    fact("times", f"0 .. {sequence.times[-1]:.4g} s{apart}", "times")
    text = f"{stated.f_mod_hz / 1e6:.6g} MHz, unambiguous to {range_m:.4g} m"
    fact("f_mod_hz", text, "f_mod_hz")
    fact("phase_offset", f"{stated.phase_offset:.6g} rad", "phase_offset")
    fact("adc_zero", f"{stated.adc_zero:.6g}", "adc_zero")
    fact("dc_offset", f"{stated.dc_offset:.6g}", "dc_offset")
    fact("quad_scale", scale, "quad_scale")
    fact("intrinsics", f"fx {tof.fx:.6g}, fy {tof.fy:.6g} px", "fx")
    fact("principal point", f"{tof.cx:.6g}, {tof.cy:.6g} px, centres at i + 0.5", "cx")
    report.add("poses", sources["camera_from_world"])
    report.add("colour", f"{sources['colour']}{size}")
    poses = f"poses: {sources['colour_from_world']}"
    report.add("colour camera", f"{sources['colour_intrinsics']}; {poses}")
    report.add("novel views", sources["novel_from_world"])
    report.add("forward flow", sources["forward_flow"])
    report.add("backward flow", sources["backward_flow"])
    assert sequence.path is not None
    if sequence.frequencies_hz is not None:
        several = ", ".join(f"{f / 1e6:.6g}" for f in frequencies_by_order(sequence.frequencies_hz))
        alone = ", ".join(f"{SPEED_OF_LIGHT / (2 * f):.4g}" for f in sequence.frequencies)
        fact("frequencies", f"{several} MHz, unambiguous to {alone} m alone", "frequencies_hz")
    if tof.distortion is not None:
        names = zip(("k1", "k2", "p1", "p2", "k3"), tof.distortion, strict=True)
        fact("lens", ", ".join(f"{name} {value:.4g}" for name, value in names), "distortion")
    if sequence.exposures is not None:
        low, high = 1e3 * sequence.exposures.min(), 1e3 * sequence.exposures.max()
        fact("exposures", f"{low:.4g} .. {high:.4g} ms", "exposures")
    patterns = [p for f in specs.fields(report.form).values() for p in f.paths if "{id}" in p]
    for pattern in dict.fromkeys(patterns):
        for slot in range(FRAMES_PER_QUARTET if "{slot}" in pattern else 1):
            name = pattern.replace("{slot}", str(slot))
            ids = list(numbered(sequence.path, name))
            if ids:
                steps = ", ".join(f"{step} ({count}x)" for step, count in _counts(np.diff(ids)))
                text = f"{len(ids)} from {ids[0]} to {ids[-1]}, steps {steps or 'none'}"
                report.add(f"ids {name:<28}", text)


def _assumptions(sequence: Sequence, report: Report) -> None:
    """Values that were assumed, and what is missing."""
    sources, warn = sequence.sources, report.warn
    kind, missing = "raw frames", np.flatnonzero(~sequence.measured)
    if len(missing):
        if sequence.from_phasors:
            kind, missing = "phasors", missing[:: sequence.cycle] // sequence.cycle
        shown = ", ".join(map(str, missing[:10])) + (" .." if len(missing) > 10 else "")
        warn("missing", f"{len(missing)} {kind} were not measured: {shown}")
    if sequence.frames % sequence.cycle:
        warn(
            "truncated",
            f"the last quartet is truncated after {sequence.frames % sequence.cycle} frames",
        )
    if sources["times"].startswith("default"):
        warn(
            "assumed",
            f"frame rate assumed: {sources['times'][8:]}; cams/frame_times.npy states another",
        )
    if sources["f_mod_hz"].startswith("default"):
        warn("assumed", "modulation frequency assumed: no cams/depth_range.npy")
    if sources["pixel_centre"].startswith("inferred"):
        warn(
            "assumed",
            f"pixel centres {sources['pixel_centre']}; state them in cams/pixel_centre.json",
        )
    if "other poses" in sources["camera_from_world"]:
        warn("assumed", f"poses: {sources['camera_from_world']}; cams/poses.json makes them count")
    for name in ("colour_intrinsics", "colour_from_world"):
        if sources[name].startswith("inferred") or "replaces" in sources[name]:
            warn("assumed", f"{name}: {sources[name]}")
    if "amplitude, not colour" in sources["colour"]:
        warn("grey colour", "colour: three equal channels: amplitude, not colour")
    if "warped copies" in sources["measured"]:
        warn("warped copies", f"quads: {sources['measured']}")


def _counts(steps: np.ndarray) -> list[tuple[int, int]]:
    """Distinct steps and the number of times each occurs."""
    values, counts = np.unique(steps, return_counts=True)
    return list(zip(values.tolist(), counts.tolist(), strict=True))
