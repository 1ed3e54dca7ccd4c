"""A named scene to a sequence on disk, with its ground truth and a data card."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET
from ..data import capture_write, ftorf_write, torf_write
from ..data.contact_sheet import SHIFTS_MIN, contact_sheet
from ..data.files import atomic_write
from ..data.sequence import Sequence
from ..errors import UsageError
from ..scene.sensor import Sensor
from .card import outcome_card, settings_card
from .ladder import NAMES, Errors, at_level, closed_form_errors, ladder_table
from .layers import TRUTHS
from .readout import why_impossible
from .record import ENGINES, Progress, frame_times, needs_mesh, record
from .scene import overridden
from .scene_file import read_scene
from .scenes import SCENES, Scene
from .splat import clearance
from .unfinished import needs_recording, set_aside, unfinished

CLEARANCE = 0.5  # [m] nearer bodies fill the image, and a cover of them would need millions of splats
FORMATS = ("ftorf", "torf", "capture")


def simulate(
    scene: str | Scene,
    out: str | Path,
    *,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    sync: bool = False,
    noise: bool = True,
    flow: bool = False,
    exposure_samples: int = 1,
    overrides: Iterable[str] = (),
    engine: str = "gaussian",
    bounces: int = 0,
    paths: int = 64,
    device: str = "cpu",
    format: str = "ftorf",
    level: str | None = None,
    truth: str = "usual",
    fresh: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Record a moving scene with an asynchronous C-ToF sensor and write it as a sequence.

    Raw frame n is an image of the scene at its own time, of which only the quad of its own shift and frequency is kept
    and read out. Beside it stands the analytic distance along each pixel's centre ray at that very time. A camera that
    moves has a pose for each raw frame; a colour camera adds an image per quartet. The folder appears only when it is
    complete; if it is already there and was made with the same settings, it is left as it is. After an interruption the
    same call goes on at the next raw frame: what was finished waits in OUT.partial, and the bytes are the same in the
    end.

    Args:
        scene: Name of a scene, see ``SCENES``, a TOML file of one, or a scene.
        out: Folder to write.
        frames: Number of raw frames; None is the scene's own. A last quartet may be incomplete.
        size: (width, height) of the image [px]; None is the scene's own.
        seed: Of the noise. The same seed gives the same bytes, and frame n of a shorter recording is that of a longer.
        sync: Control mode: all raw frames of a quartet are taken at the time of its first.
        noise: False switches shot and read noise, full well and ADC off.
        flow: Whether exact optical flow at quartet starts is stored beside the quads: how images move, so that of a
            camera that moves includes its own motion.
        exposure_samples: Instants that a raw frame averages over the exposure, centred on its time; 1: no motion blur.
        overrides: Single settings of the scene, its sensor and its bodies to change, as texts like
            ``sensor.f_mod_hz=30e6`` or ``bodies.1.path.velocity=3,0,0``.
        engine: 'gaussian': splats cover the scene and are rendered. 'mesh': rays meet its surfaces; shares nothing with
            the renderer that `reconstruct` uses, and can have the light beside the camera, a beam, and bounces.
        bounces: Surfaces that light may meet after the first one; 0: direct light only. More of them need 'mesh'.
        paths: Random paths per pixel and raw frame for the light that bounces.
        device: Where engine 'mesh' traces; the other one renders on the CPU.
        format: Layout on disk: 'ftorf', raw quads; 'torf', one phasor per quartet with the time, pose and truth of its
            first raw frame; 'capture', our own, which holds any shifts, exposures, amplitude and objects too.
        level: Step of the ladder from ideal to realistic, see ``LEVELS`` of sim/ladder.py; it decides about the engine,
            bounces, blur, noise and what of the sensor is ideal. None: everything as it is asked for.
        truth: What a capture of engine mesh keeps beside distances, amplitude and objects: 'usual' or 'all', see
            sim/layers.py; 'all' needs that engine and that format.
        fresh: Whether another sequence in ``out`` is moved aside, to ``out-old-1``, instead of being an error, and an
            unfinished one begun again.
        progress: Called with (raw frames done, raw frames in all).

    Returns:
        The folder.

    Raises:
        UsageError: If an option cannot be meant that way, the format cannot express the sensor, ``out`` or what is
            unfinished beside it holds something else, or the place cannot be written to.
        BusyError: If another process records the same sequence.
        InputError: If a TOML file does not describe a scene.
    """
    own = scene_of(scene, overrides)
    options: dict[str, Any] = {
        "frames": own.frames if frames is None else frames,
        "size": (own.width, own.height) if size is None else tuple(size),
        "seed": seed,
        "sync": sync,
        "noise": noise,
        "flow": flow,
        "exposure_samples": exposure_samples,
        "engine": engine,
        "bounces": bounces,
        "paths": paths,
    }
    found, options = (own, options) if level is None else at_level(own, level, options)
    _check_options(found, options, format)
    _check_engine(found, options["engine"], options["bounces"], options["paths"], device)
    _check_truth(truth, options["engine"], format)
    if flow and format == "torf":
        raise UsageError(
            "a ToeRF folder has no place for optical flow",
            where="--flow",
            why="flow belongs to raw quads",
            fix="leave --flow out, or --format ftorf",
        )
    _check_sensor(found.sensor, format)
    _check_rows(found.sensor, format, options["engine"], flow=flow)
    _check_lens(found, options["size"], format)
    _check_duration(found, frames)
    card = settings_card(found, options, format, own=own, level=level, truth=truth)
    out = Path(out).absolute() if fresh else Path(out)
    if not needs_recording(out, card, fresh=fresh):
        return out
    write = {"ftorf": ftorf_write, "torf": torf_write, "capture": capture_write}[format].write
    with unfinished(out, card, fresh=fresh) as keep:
        kept = truth if format == "capture" else None
        recording = record(found, **options, device=device, truth=kept, progress=progress, keep=keep)
        if fresh:
            set_aside(out)
        sheet = contact_sheet(recording.sequence, recording.truth, card.partition("\n")[0].removeprefix("# "))
        write(out, recording.sequence, recording.truth, readme=card + outcome_card(recording), sheet=sheet)
    return out


def simulate_ladder(
    scene: str | Scene, out: str | Path, *, progress: Progress | None = None, **options: Any
) -> dict[str, Errors]:
    """Record a scene at every level of the ladder, into OUT/sync, OUT/L0 and so on, and say what each level costs.

    ``OUT/ladder.md`` holds the table. Levels that are there already with the same settings are left as they are.

    Args:
        scene: As for :func:`simulate`.
        out: Folder of the folders.
        progress: Called with (raw frames done, raw frames in all) of each level in turn.
        options: Those of :func:`simulate`, but for ``level``.

    Returns:
        Errors of the closed form by name of the level.

    Raises:
        UsageError, InputError, BusyError: As :func:`simulate`.
    """
    out, rows = Path(out), {}
    for name in NAMES:
        sequence = Sequence.open(simulate(scene, out / name, level=name, progress=progress, **options))
        rows[name] = closed_form_errors(sequence, sequence.truth())
    title = scene if isinstance(scene, str) else scene.name
    lines = "\n".join(f"    {line}" for line in ladder_table(rows))
    atomic_write(out / "ladder.md", f"# {title}: what each level of the ladder costs\n\n{lines}\n".encode())
    return rows


def scene_of(scene: str | Scene, overrides: Iterable[str] = ()) -> Scene:
    """A scene by its name or file, with single settings changed; as for :func:`simulate`.

    Raises:
        UsageError: If there is no such scene, or a setting cannot be changed so.
        InputError: If a TOML file does not describe a scene.
    """
    return overridden(_scene(scene), overrides)


def _scene(scene: str | Scene) -> Scene:
    if isinstance(scene, Scene):
        return scene
    if scene.endswith(".toml"):
        return read_scene(scene)
    if scene not in SCENES:
        close = difflib.get_close_matches(scene, SCENES, n=1, cutoff=0.5)
        raise UsageError(
            f"there is no scene named {scene!r}",
            where="SCENE",
            why=f"the named scenes are {', '.join(SCENES)}",
            fix=f"did you mean {close[0]!r}?"
            if close
            else "take one of these, `--list` describes them, or a file that ends in .toml",
        )
    return SCENES[scene]


def _check_options(scene: Scene, options: dict[str, Any], layout: str) -> None:
    least = FRAMES_PER_QUARTET if layout == "torf" else 1  # a phasor needs a whole quartet
    frames, size, seed, exposure_samples = (options[k] for k in ("frames", "size", "seed", "exposure_samples"))
    wanted = {
        "--frames": (frames >= least, f"{frames}", f"at least {least}, for example {scene.frames}"),
        "--size": (
            len(size) == 2 and min(size) >= 1,
            "x".join(map(str, size)),
            f"WIDTHxHEIGHT, both at least 1, for example {scene.width}x{scene.height}",
        ),
        "--seed": (seed >= 0, f"{seed}", "0 or more"),
        "exposure_samples": (exposure_samples >= 1, f"{exposure_samples}", "at least 1"),
        "--format": (layout in FORMATS, repr(layout), f"one of {', '.join(FORMATS)}"),
    }
    _refuse(wanted)


def _check_engine(scene: Scene, engine: str, bounces: int, paths: int, device: str) -> None:
    wanted = {
        "--engine": (engine in ENGINES, repr(engine), f"one of {', '.join(ENGINES)}"),
        "--bounces": (bounces >= 0, f"{bounces}", "0 or more"),
        "--paths": (paths >= 1, f"{paths}", "at least 1"),
    }
    _refuse(wanted)
    if engine != "mesh":
        light = "mesh: the light is beside the camera, has a beam or bounces, or a body is glossy or a mesh that moves"
        _refuse({"--engine": (not needs_mesh(scene, bounces), repr(engine), light)})
        _refuse({"--device": (device == "cpu", f"{device} and engine {engine!r}", "cpu, or --engine mesh")})


def _check_truth(truth: str, engine: str, layout: str) -> None:
    _refuse({"--truth": (truth in TRUTHS, repr(truth), f"one of {', '.join(TRUTHS)}")})
    if truth != TRUTHS[0] and (engine, layout) != ("mesh", "capture"):
        raise UsageError(
            f"cannot keep {truth} truth",
            where="--truth",
            why=f"engine {engine} and format {layout} have no layers; engine mesh knows them, a capture holds them",
            fix="add --engine mesh --format capture",
        )


def _refuse(wanted: dict[str, tuple[bool, str, str]]) -> None:
    """Raise what is wrong with the first option of {option: (whether it is good, what it is, what is wanted)}."""
    for where, (good, got, want) in wanted.items():
        if not good:
            raise UsageError(f"cannot simulate with {got}", where=where, why=f"expected {want}", fix="change it")


def _check_sensor(sensor: Sensor, layout: str) -> None:
    turns = sorted(round(math.degrees(shift), 4) % 360.0 for shift in sensor.shifts)
    if layout == "capture" and len(set(turns)) < SHIFTS_MIN:
        raise UsageError(
            "this sensor cannot see a phase",
            where="sensor.shifts",
            why=f"a phase needs {SHIFTS_MIN} different shifts, found {turns} deg",
            fix="give it more of them",
        )
    if layout != "capture" and turns != sorted(math.degrees(shift) for shift in CANONICAL_SHIFTS):
        raise UsageError(
            "an F-ToeRF folder cannot express this sensor",
            where="sensor.shifts",
            why=f"it holds the four shifts 0, 90, 180 and 270 deg in some order, not {turns} deg",
            fix="use those four shifts, or --format capture",
        )
    if sensor.further_hz and layout != "capture":
        raise UsageError(
            "an F-ToeRF folder cannot express this sensor",
            where="sensor.further_hz",
            why=f"it has one modulation frequency, not {1 + len(sensor.further_hz)}",
            fix="leave sensor.further_hz out, or --format capture",
        )
    impossible = why_impossible(sensor) if sensor.noise else None
    if impossible is not None:
        raise UsageError(
            "a tap of this sensor would hold negative light",
            where="sensor.dc_offset",
            why=impossible,
            fix="lower the contrast or the DC offset, or make the sensor unipolar",
        )


def _check_rows(sensor: Sensor, layout: str, engine: str, *, flow: bool) -> None:
    if sensor.row_time_s == 0:
        return
    wrong = {
        "an image of splats has one time": (engine != "mesh", "--engine mesh"),
        "an F-ToeRF folder has no place for the times of rows": (layout != "capture", "--format capture"),
        "flow is from one time to another, and rows have times of their own": (flow, "leave --flow out"),
    }
    for why, (found, fix) in wrong.items():
        if found:
            raise UsageError("a rolling shutter cannot be simulated so", where="sensor.row_time_s", why=why, fix=fix)


def _check_lens(scene: Scene, size: tuple[int, int], layout: str) -> None:
    if not scene.lens.distortion:
        return
    if layout != "capture":
        raise UsageError(
            "an F-ToeRF folder cannot express this lens",
            where="lens.distortion",
            why=f"it holds the matrix of a pinhole, not {scene.lens.distortion}",
            fix="leave lens.distortion out, or --format capture",
        )
    try:
        scene.camera(size)
    except ValueError as error:
        raise UsageError(
            "this lens sees too much",
            where="lens.distortion",
            why=str(error),
            fix="make its coefficients or horizontal_fov_deg smaller, or the image less high",
        ) from error


def _check_duration(scene: Scene, frames: int | None) -> None:
    """Bodies go on along their paths for as long as is asked, but not through the camera."""
    times = frame_times(scene.sensor, max(scene.frames, frames or 0), sync=False)
    centres = np.array([scene.camera(time=float(time)).centre for time in times])
    for body in (body for body in scene.bodies if body.moves):
        near = np.flatnonzero(clearance(body, centres, times) < CLEARANCE)
        if len(near):
            raise UsageError(
                f"something comes nearer to the camera than {CLEARANCE} m",
                where="--frames",
                why=f"scene {scene.name} is made for {scene.frames} raw frames, and it happens at frame {near[0]}",
                fix=f"simulate at most {near[0]} raw frames",
            )
