"""The README.md of a simulated sequence: what it shows, how to make it again, and every number of the sensor."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import fields

from .. import __version__
from ..constants import FRAMES_PER_QUARTET
from ..scene.optics import Lens, lens_rows
from .ladder import NAMES, adds_of
from .layers import TRUTHS
from .paths import Still
from .readout import contrast, electron_gain
from .record import Recording
from .scene import overridden
from .scenes import SCENES, Scene
from .sensors import effect_rows


def settings_card(
    scene: Scene,
    options: Mapping,
    layout: str = "ftorf",
    *,
    own: Scene | None = None,
    level: str | None = None,
    truth: str = TRUTHS[0],
) -> str:
    """The part that follows from the settings alone, so that equal text means equal settings.

    Args:
        scene: What was recorded.
        options: Keyword arguments of :func:`gftorf_warp.sim.record.record` by name, all resolved.
        layout: Layout on disk; 'torf' has one phasor per quartet.
        own: The scene that was asked for, if a level of the ladder made another of it.
        level: That level.
        truth: How much of it is kept, see sim/layers.py.
    """
    sensor, noisy = scene.sensor, options["noise"] and scene.sensor.noise
    width, height = options["size"]
    rows = {
        "modulation frequency": f"{float(sensor.f_mod_hz) / 1e6:.9g} MHz, unambiguous to "
        f"{sensor.unambiguous_range:.4f} m",
        "shifts in time order": ", ".join(f"{math.degrees(shift):.0f}" for shift in sensor.shifts) + " deg",
        "raw frames": f"{1 / sensor.frame_period_s:.6g} per second, "
        + (_together(len(sensor.cycle)) if options["sync"] else "each at its own time"),
        **(
            {"phasors": "one per quartet, with time, pose and truth of its first raw frame"} if layout == "torf" else {}
        ),
        **({} if level is None else {"ladder": f"level {level}: {adds_of(level)}"}),
        **_camera_rows(scene, options),
        "exposure": f"{1e3 * sensor.exposure_s:g} ms, "
        + (f"mean of {n} instants" if (n := options["exposure_samples"]) > 1 else "taken as one instant"),
        "taps": "one, unipolar" if sensor.unipolar else "two, differential",
        "source intensity": f"{float(sensor.source_intensity):g}",
        "phase offset": f"{float(sensor.phase_offset):g} rad",
        "DC offset": f"{float(sensor.dc_offset):g} amplitudes",
        "noise": "shot, read, full well, ADC" if noisy else "none: quads are exact means",
    }
    if noisy:
        rows |= {
            "electrons per unit of amplitude": f"{electron_gain(sensor):.4g} in one exposure, both taps together",
            "contrast": f"{contrast(sensor):g}",
            "ambient": f"{sensor.ambient_electrons:g} electrons per exposure"
            + (" from white" if sensor.ambient_electrons and options["engine"] == "mesh" else ""),
            "dark current": f"{sensor.dark_electrons_per_s:g} electrons per second and tap",
            "read noise": f"{sensor.read_noise_electrons:g} electrons per tap",
            "full well": f"{sensor.full_well_electrons:g} electrons per tap",
            "ADC": f"{sensor.adc_bits or 'no'} bits, {sensor.electrons_per_code:g} electrons per code",
        }
    rows |= effect_rows(sensor) | lens_rows(scene.lens)
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return f"""# {scene.name}: simulated C-ToF sequence

{scene.description[:1].upper() + scene.description[1:]}. Motion: {scene.motion}.
{options["frames"]} raw frames of {width}x{height} pixels, {scene.horizontal_fov_deg:g} deg wide. \
{_light(scene, options)}.

    {_command(own or scene, options, layout, level, truth)}

Made by gftorf-warp {__version__}, scene {hashlib.sha256(_fingerprint(scene).encode()).hexdigest()[:16]}. \
This data may be used under the licence of that program, Apache-2.0.

| sensor | |
|---|---|
{table}

Quads are in relative units: reflectance rho met at angle i and distance d gives the amplitude rho cos(i) / d^2.
{_engine(scene, options)}

Ground truth is the analytic first hit of the shapes along the ray through each pixel's centre at the time of each raw
frame, not a rendering.
"""


def _together(count: int) -> str:
    return f"all {'four' if count == FRAMES_PER_QUARTET else count} of a quartet at the time of its first"


def outcome_card(recording: Recording) -> str:
    """The part that is known only afterwards: how far the rendering is from the truth, and what saturated."""
    agreement = "no such pixel" if recording.gap is None else str(recording.gap)
    return f"""
Ground truth against the distance that the engine sees, on interior pixels of still surfaces in all raw frames:
{agreement}.

Saturated: {100 * recording.saturated:.3g} % of all pixels and raw frames.

Beside the distance stands the static-phasor distance: what the closed form would decode from four quads taken without
noise at the very time of a raw frame, all light included. contact_sheet.png is a picture for people.
"""


def _light(scene: Scene, options: Mapping) -> str:
    lamp = "Light and camera coincide"
    if any(scene.emitter):
        place = ", ".join(f"{1e3 * x:g}" for x in scene.emitter)
        lamp = f"The light is at ({place}) mm in camera axes and casts shadows"
    if scene.beam_deg is not None:
        lamp += f"; it shines on {scene.beam_deg[0]:g} x {scene.beam_deg[1]:g} deg"
    if not options["bounces"]:
        return f"{lamp}; direct light only"
    return f"{lamp}; direct light and up to {options['bounces']} bounces, from {options['paths']} paths per pixel"


def _engine(scene: Scene, options: Mapping) -> str:
    rays = f"{scene.subsamples}x{scene.subsamples} rays per pixel, averaged"
    if options["engine"] == "mesh":
        return f"Engine mesh: rays meet the surfaces themselves, as triangles, balls and endless planes; {rays}."
    return f"Engine gaussian: the scene is covered by Gaussians and rendered with {rays}."


def _camera_rows(scene: Scene, options: Mapping) -> dict[str, str]:
    """How the cameras move and what the colour camera is; nothing for one ToF camera at rest at the origin."""
    rows = {}
    if scene.camera_path != Still():
        rows["camera path"] = f"{scene.camera_path}" + (
            "; every raw frame has the pose of its own time" if scene.camera_moves else ""
        )
    if scene.colour is not None:
        camera = scene.colour_camera(options["size"])
        position = ", ".join(f"{1e3 * x:g}" for x in scene.colour.position)
        rows["colour camera"] = (
            f"{camera.width}x{camera.height} pixels, {scene.colour.horizontal_fov_deg:g} deg wide, at ({position}) mm "
            f"in the axes of the ToF camera, turned by {scene.colour.turn_deg} deg; an image at each quartet start; "
            "linear RGB albedo: light from everywhere, no shading, no falloff; noise "
            + (f"{scene.colour.noise:g}" if options["noise"] else "none")
        )
    if scene.novel_views:
        rows["novel views"] = f"{len(scene.novel_views)} poses off the path, without images"
    return rows


def _command(scene: Scene, options: Mapping, layout: str, level: str | None, truth: str) -> str:
    """What makes the same sequence again: a command line if there is one for it, else a call."""
    named = SCENES.get(scene.name)
    if named is None or overridden(named, scene.overrides) != scene:
        values = ", ".join(f"{key}={value}" for key, value in options.items())
        more = f", format={layout!r}" if layout != "ftorf" else ""
        more += f", level={level!r}" if level else ""
        more += f", truth={truth!r}" if truth != TRUTHS[0] else ""
        return f"gftorf_warp.simulate({scene.name}, ..., {values}{more})"
    width, height = options["size"]
    command = f"gftorf simulate {scene.name} --out SEQ{''.join(f' --override {text}' for text in scene.overrides)}"
    command += f" --frames {options['frames']} --size {width}x{height}"
    command += " --flow" if options["flow"] else ""
    if level is None:
        command += f" --engine {options['engine']}" if options["engine"] != "gaussian" else ""
        command += f" --bounces {options['bounces']} --paths {options['paths']}" if options["bounces"] else ""
        command += f" --exposure-samples {n}" if (n := options["exposure_samples"]) > 1 else ""
    command += f" --seed {options['seed']}" + (f" --format {layout}" if layout != "ftorf" else "")
    command += f" --truth {truth}" if truth != TRUTHS[0] else ""
    if level is not None:
        return command + f" --level {level}" + (" --sync" if options["sync"] and level != NAMES[0] else "")
    return command + (" --sync" if options["sync"] else "") + ("" if options["noise"] else " --no-noise")


def _fingerprint(scene: Scene) -> str:
    """Every setting of a scene as text; without the optional ones that it does not use, as if they did not exist."""
    optional = {"camera_path": Still(), "emitter": (0.0, 0.0, 0.0), "beam_deg": None, "colour": None, "novel_views": ()}
    optional |= {"lens": Lens()}
    values = {f.name: getattr(scene, f.name) for f in fields(scene)}
    used = {name: value for name, value in values.items() if name not in optional or value != optional[name]}
    del used["closed_form"], used["overrides"]  # follow from the others
    hues = "" if scene.colour is None else f", hues {[body.texture.hue for body in scene.bodies]}"
    return f"Scene({', '.join(f'{name}={value!r}' for name, value in used.items())}){hues}"
