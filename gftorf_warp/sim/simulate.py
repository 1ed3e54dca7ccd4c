"""A named scene to a sequence on disk, with its ground truth and a data card."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..constants import CANONICAL_SHIFTS, FRAMES_PER_QUARTET
from ..errors import UsageError
from ..scene.sensor import Sensor
from .card import outcome_card, settings_card
from .readout import contrast
from .record import ENGINES, Progress, frame_times, needs_mesh, record
from .scene import overridden
from .scene_file import read_scene
from .scenes import SCENES, Scene
from .splat import clearance

CARD = "README.md"
CLEARANCE = 0.5  # [m] nearer bodies fill the image, and a cover of them would need millions of splats
FORMATS = {  # what every folder of a layout holds
    "ftorf": ("cams/depth_range.npy", "tofType0"),
    "torf": ("cams/depth_range.npy", "tof"),
}


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
    fresh: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Record a moving scene with an asynchronous C-ToF sensor and write it as a sequence.

    Raw frame n is an image of the scene at its own time, of which only the quad of slot n % 4 is kept and read out.
    Beside it stands the analytic distance along each pixel's centre ray at that very time. A camera that moves has a
    pose for each raw frame; a colour camera adds an image per quartet. The folder appears only when it is complete; if
    it is already there and was made with the same settings, it is left as it is.

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
        format: Layout on disk: 'ftorf', raw quads, or 'torf', one phasor per quartet with the time, pose and truth of
            its first raw frame.
        fresh: Whether another sequence in ``out`` is moved aside, to ``out-old-1``, instead of being an error.
        progress: Called with (raw frames done, raw frames in all).

    Returns:
        The folder.

    Raises:
        UsageError: If an option cannot be meant that way, the format cannot express the sensor, or ``out`` holds
            something else.
        InputError: If a TOML file does not describe a scene.
    """
    found = overridden(_scene(scene), overrides)
    _check_options(found, frames, size, seed, exposure_samples, format)
    _check_engine(found, engine, bounces, paths, device)
    if flow and format == "torf":
        raise UsageError(
            "a ToeRF folder has no place for optical flow",
            where="--flow",
            why="flow belongs to the raw quads of an F-ToeRF folder",
            fix="leave --flow out, or --format ftorf",
        )
    _check_sensor(found.sensor)
    _check_duration(found, frames)
    options: dict[str, Any] = {
        "frames": found.frames if frames is None else frames,
        "size": (found.width, found.height) if size is None else tuple(size),
        "seed": seed,
        "sync": sync,
        "noise": noise,
        "flow": flow,
        "exposure_samples": exposure_samples,
        "engine": engine,
        "bounces": bounces,
        "paths": paths,
    }
    card = settings_card(found, options, format)
    out = Path(out).absolute() if fresh else Path(out)
    if not _check_folder(out, card, fresh=fresh):
        return out
    if format == "torf":
        from ..data.torf_write import write
    else:
        from ..data.ftorf_write import write
    recording = record(found, **options, device=device, progress=progress)
    if fresh:
        _set_aside(out)
    write(out, recording.sequence, recording.truth, readme=card + outcome_card(recording))
    return out


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


def _check_options(scene: Scene, frames, size, seed: int, exposure_samples: int, layout: str) -> None:
    least = FRAMES_PER_QUARTET if layout == "torf" else 1  # a phasor needs a whole quartet
    wanted = {
        "--frames": (frames is None or frames >= least, f"{frames}", f"at least {least}, for example {scene.frames}"),
        "--size": (
            size is None or (len(size) == 2 and min(size) >= 1),
            "x".join(map(str, size or ())),
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


def _refuse(wanted: dict[str, tuple[bool, str, str]]) -> None:
    """Raise what is wrong with the first option of {option: (whether it is good, what it is, what is wanted)}."""
    for where, (good, got, want) in wanted.items():
        if not good:
            raise UsageError(f"cannot simulate with {got}", where=where, why=f"expected {want}", fix="change it")


def _check_sensor(sensor: Sensor) -> None:
    turns = sorted(round(math.degrees(shift), 4) % 360.0 for shift in sensor.shifts)
    if turns != sorted(math.degrees(shift) for shift in CANONICAL_SHIFTS):
        raise UsageError(
            "an F-ToeRF folder cannot express this sensor",
            where="sensor.shifts",
            why=f"it holds the four shifts 0, 90, 180 and 270 deg in some order, not {turns} deg",
            fix="use those four shifts",
        )
    if sensor.noise and not sensor.unipolar and contrast(sensor) * (1 + abs(float(sensor.dc_offset))) > 1:
        raise UsageError(
            "a tap of this sensor would hold negative light",
            where="sensor.dc_offset",
            why=f"differential taps allow contrast (1 + |dc_offset|) <= 1, not {contrast(sensor):g} (1 + "
            f"{abs(float(sensor.dc_offset)):g})",
            fix="lower the contrast or the DC offset, or make the sensor unipolar",
        )


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


def _check_folder(out: Path, card: str, *, fresh: bool) -> bool:
    """Whether there is anything to do: False if ``out`` holds what these settings give.

    Raises:
        UsageError: If ``out`` holds anything else that may not be moved aside.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return True
    sequence = any(all((out / mark).exists() for mark in marks) for marks in FORMATS.values())
    text = (out / CARD).read_text(errors="replace") if sequence and (out / CARD).is_file() else ""
    if not fresh and text.startswith(card):
        return False
    if fresh and sequence:
        return True
    raise UsageError(
        "the folder is not empty" if out.is_dir() else "not a folder",
        where=out,
        why="it holds a sequence made with other settings" if sequence else "it holds something that is no sequence",
        fix="choose another --out" + (", or move this one aside with --fresh" if sequence else ""),
    )


def _set_aside(out: Path) -> None:
    """Rename a folder with content to the first free ``out-old-N``."""
    if out.exists() and any(out.iterdir()):
        number = 1
        while out.with_name(f"{out.name}-old-{number}").exists():
            number += 1
        out.rename(out.with_name(f"{out.name}-old-{number}"))
