"""The README.md of a simulated sequence: content, command and sensor."""

from __future__ import annotations

import hashlib
import math
from dataclasses import fields

from .. import __version__
from ..constants import FRAMES_PER_QUARTET
from ..scene.optics import Lens, lens_rows
from .ladder import NAMES, adds_of, resolved
from .paths import Still
from .readout import contrast, electron_gain
from .record import Recording
from .scene import overridden
from .scenes import Scene, named_scene
from .sensors import effect_rows
from .settings import ResolvedSettings, SimSettings

CALLED = "frames size seed sync noise flow exposure_samples engine bounces paths".split()
"""Settings that a call names on a data card, even where they are the defaults."""


def settings_card(requested: Scene, settings: SimSettings) -> str:
    """The part that depends on scene (without level) and settings alone: equal text, same data."""
    scene, used = resolved(requested, settings)
    sensor, noisy = scene.sensor, used.noise and scene.sensor.noise
    camera, n = scene.camera(used.size), used.exposure_samples
    mhz, quads = float(sensor.f_mod_hz) / 1e6, len(sensor.cycle)
    shifts = ", ".join(f"{math.degrees(shift):.0f}" for shift in sensor.shifts)
    together = f"all {'four' if quads == FRAMES_PER_QUARTET else quads} of a quartet at the time of"
    when = f"{together} its first" if used.sync else "each at its own time"
    rows = {
        "modulation frequency": f"{mhz:.9g} MHz, unambiguous to {sensor.unambiguous_range:.4f} m",
        "shifts in time order": f"{shifts} deg",
        "raw frames": f"{1 / sensor.frame_period_s:.6g} per second, {when}",
    }
    if used.format == "torf":
        rows["phasors"] = "one per quartet, with time, pose and truth of its first raw frame"
    if settings.level is not None:
        rows["ladder"] = f"level {settings.level}: {adds_of(settings.level)}"
    rows |= {
        **_camera_rows(scene, used),
        "exposure": f"{1e3 * sensor.exposure_s:g} ms, "
        + (f"mean of {n} instants" if n > 1 else "taken as one instant"),
        "taps": "one, unipolar" if sensor.unipolar else "two, differential",
        "source intensity": f"{float(sensor.source_intensity):g}",
        "phase offset": f"{float(sensor.phase_offset):g} rad",
        "DC offset": f"{float(sensor.dc_offset):g} amplitudes",
        "noise": "shot, read, full well, ADC" if noisy else "none: quads are exact means",
    }
    if noisy:
        gain, ambient = f"{electron_gain(sensor):.4g}", sensor.ambient_electrons
        white = " from white" if ambient and used.engine == "mesh" else ""
        adc = f"{sensor.adc_bits or 'no'} bits, {sensor.electrons_per_code:g}"
        rows |= {
            "electrons per unit of amplitude": f"{gain} in one exposure, both taps together",
            "contrast": f"{contrast(sensor):g}",
            "ambient": f"{ambient:g} electrons per exposure{white}",
            "dark current": f"{sensor.dark_electrons_per_s:g} electrons per second and tap",
            "read noise": f"{sensor.read_noise_electrons:g} electrons per tap",
            "full well": f"{sensor.full_well_electrons:g} electrons per tap",
            "ADC": f"{adc} electrons per code",
        }
    rows |= effect_rows(sensor) | lens_rows(scene.lens)
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return f"""# {scene.name}: simulated C-ToF sequence

{scene.description[:1].upper() + scene.description[1:]}. Motion: {scene.motion}.
{used.frames} raw frames of {camera.width}x{camera.height} pixels, \
{scene.horizontal_fov_deg:g} deg wide. \
{_light(scene, used)}.

    {_command(requested, used, settings.level)}

Made by gftorf-warp {__version__}, \
scene {hashlib.sha256(_fingerprint(scene).encode()).hexdigest()[:16]}. \
This data may be used under the licence of that program, Apache-2.0.

| sensor | |
|---|---|
{table}

Quads are in relative units: reflectance rho met at angle i and distance d gives the amplitude \
rho cos(i) / d^2.
{_engine(scene, used)}

Ground truth is the analytic first hit of the shapes along the ray through each pixel's centre at \
the time of each raw
frame, not a rendering.
"""


def outcome_card(recording: Recording) -> str:
    """The part that is known after the recording: engine against truth, and saturation."""
    agreement = "no such pixel" if recording.gap is None else str(recording.gap)
    return f"""
Ground truth against the distance that the engine sees, on interior pixels of still surfaces \
in all raw frames:
{agreement}.

Saturated: {100 * recording.saturated:.3g} % of all pixels and raw frames.

The static-phasor distance is that which the closed form would decode from four quads taken \
without noise at the time of
a raw frame, all light included. contact_sheet.png is an overview; no program reads it.
"""


def _light(scene: Scene, used: ResolvedSettings) -> str:
    lamp = "Light and camera coincide"
    if any(scene.emitter):
        position = ", ".join(f"{1e3 * x:g}" for x in scene.emitter)
        lamp = f"The light is at ({position}) mm in camera axes and casts shadows"
    if scene.beam_deg is not None:
        lamp += f"; it shines on {scene.beam_deg[0]:g} x {scene.beam_deg[1]:g} deg"
    if not used.bounces:
        return f"{lamp}; direct light only"
    paths = f"from {used.paths} paths per pixel"
    return f"{lamp}; direct light and up to {used.bounces} bounces, {paths}"


def _engine(scene: Scene, used: ResolvedSettings) -> str:
    rays = f"{scene.subsamples}x{scene.subsamples} rays per pixel, averaged"
    if used.engine == "mesh":
        met = "rays meet the surfaces themselves, as triangles, balls and endless planes"
        return f"Engine mesh: {met}; {rays}."
    return f"Engine gaussian: the scene is covered by Gaussians and rendered with {rays}."


def _camera_rows(scene: Scene, used: ResolvedSettings) -> dict[str, str]:
    """Rows on camera motion and colour camera; empty for a static ToF camera at the origin."""
    rows = {}
    if scene.camera_path != Still():
        note = "; every raw frame has the pose of its own time" if scene.camera_moves else ""
        rows["camera path"] = f"{scene.camera_path}{note}"
    if (colour := scene.colour) is not None:
        camera = scene.colour_camera(used.size)
        position = ", ".join(f"{1e3 * x:g}" for x in colour.position)
        rows["colour camera"] = (
            f"{camera.width}x{camera.height} pixels, {colour.horizontal_fov_deg:g} deg wide, at "
            f"({position}) mm in the axes of the ToF camera, turned by {colour.turn_deg} deg; "
            "an image at each quartet start; linear RGB albedo: light from everywhere, no shading, "
            f"no falloff; noise {f'{colour.noise:g}' if used.noise else 'none'}"
        )
    if scene.novel_views:
        rows["novel views"] = f"{len(scene.novel_views)} poses off the path, without images"
    return rows


def _command(scene: Scene, used: ResolvedSettings, level: str | None) -> str:
    """Command that makes the same sequence again; a call in Python for scenes without a name."""
    named = named_scene(scene.name)
    if named is None or overridden(named, scene.overrides) != scene:
        values = {name: getattr(used, name) for name in CALLED}
        values |= {"format": repr(used.format)} if used.format != "ftorf" else {}
        values |= {"level": repr(level)} if level else {}
        values |= {"taps": True} if used.taps else {}
        values |= {"truth": repr(used.truth)} if used.truth != "usual" else {}
        call = ", ".join(f"{k}={v}" for k, v in values.items())
        return f"gftorf_warp.simulate({scene.name}, ..., {call})"
    camera, usual = scene.camera(used.size), resolved(scene, SimSettings(level=level))[1]
    bounces, samples = used.bounces, used.exposure_samples
    other_paths = bounces > 0 and used.paths != usual.paths
    options = (
        *((True, f"--override {text}") for text in scene.overrides),
        (True, f"--frames {used.frames} --size {camera.width}x{camera.height}"),
        (used.flow, "--flow"),
        (used.taps, "--taps"),
        (used.engine != usual.engine, f"--engine {used.engine}"),
        (bounces != usual.bounces or other_paths, f"--bounces {bounces} --paths {used.paths}"),
        (samples != usual.exposure_samples, f"--exposure-samples {samples}"),
        (True, f"--seed {used.seed}"),
        (used.format != "ftorf", f"--format {used.format}"),
        (used.truth != "usual", f"--truth {used.truth}"),
        (level, f"--level {level}"),
        (used.sync and level != NAMES[0], "--sync"),
        (usual.noise and not used.noise, "--no-noise"),
    )
    chosen = " ".join(option for given, option in options if given)
    return f"gftorf simulate {scene.name} --out SEQ {chosen}"


def _fingerprint(scene: Scene) -> str:
    """Every setting of a scene as text, without unused optional ones."""
    unused = {"camera_path": Still(), "emitter": (0.0, 0.0, 0.0), "beam_deg": None, "colour": None}
    unused |= {"novel_views": (), "lens": Lens()}
    values = {f.name: getattr(scene, f.name) for f in fields(scene)}
    del values["closed_form"], values["overrides"]  # follow from the others
    used = [f"{k}={v!r}" for k, v in values.items() if k not in unused or v != unused[k]]
    hues = "" if scene.colour is None else f", hues {[body.texture.hue for body in scene.bodies]}"
    return f"Scene({', '.join(used)}){hues}"
