"""Sequences of the Cornell-Box data set with motion: path-traced correlation images and truth.

    image k = constant + amplitude cos(phase + 90 degrees k),     k = 0, 1, 2, 3

Every instant has all images, four at each of three frequencies, so that a sensor with one, two or
four taps can be assembled: one takes image k at instant k, two take 0 and 2, then 1 and 3. The
three colour channels are three materials of the scene.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..constants import FRAME_RATE_HZ
from ..data.folder import empty_quads
from ..data.problems import Problems
from ..data.sequence import Calibration, Intrinsics, Truth
from ..data.untrusted import check_links
from ..errors import InputError
from . import camera_keys, pose_keys, regular
from .imported import Imported, Notes
from .keys import Key, Settings
from .radiance import read_radiance
from .sensor_keys import F_MOD_HZ, Modulation

VIEW_DEG = 65.0
FAR_M = 1000.0  # of a pixel that meets nothing
IMAGES = {1: ((0,), (1,), (2,), (3,)), 2: ((0, 2), (1, 3)), 4: ((0, 1, 2, 3),)}
LENS = camera_keys.camera_keys("camera", f"instead of a view of {VIEW_DEG:g} degrees", needed=False)
KEYS = (
    Key(
        name="assemble.taps",
        kind=int,
        about="images of one instant",
        example=2,
        default=1,
        choices=tuple(IMAGES),
    ),
    Key(
        name="assemble.material",
        kind=int,
        about="colour channel: 0 red, 1 green, 2 blue, each another material",
        example=1,
        default=0,
        choices=(0, 1, 2),
    ),
    Key(
        name="assemble.first",
        kind=int,
        about="first instant",
        example=4,
        default=0,
        least=0,
    ),
    replace(
        F_MOD_HZ,
        about="frequencies of a cycle, one after the other: 20e6, 50e6, 70e6 [Hz]",
        default=(20e6,),
        needed=False,
    ),
    Key(
        name="time.rate_hz",
        kind=float,
        about="instants per second [Hz]",
        example=30.0,
        default=FRAME_RATE_HZ,
        above=0.0,
    ),
    *regular.pixel_centres_half(LENS),
    *pose_keys.KEYS,
)


@dataclass(frozen=True, kw_only=True)
class Slot:
    """A raw frame of a cycle."""

    instant: int
    """Its instant since that of the first."""
    image: int
    """Its image k."""
    f_mod_hz: float
    """Its modulation frequency [Hz]."""


def read(source: Path, settings: Settings) -> Imported:
    """A sequence as a sensor with so many taps would take it, with its true distance.

    Raises:
        UsageError, InputError: If files are missing or damaged, or keys do not fit to them.
    """
    notes, cycle = Notes(), _cycle(settings)
    taken = _taken(source, cycle, settings, notes)
    quads, truth = _images(source, taken, settings["assemble.material"])
    modulation = _modulation(source, cycle, taken[0], settings, notes)
    rate, stated = settings["time.rate_hz"], settings.source("time.rate_hz")
    notes.understood.append(f"times: {rate:g} instants per second ({stated}); the data have none")
    times = np.array([slot.instant for slot in taken]) / rate
    lens = None if regular.lens_given(settings) else _lens(notes, *quads.shape[1:])
    notes.uncertain.append(
        "precision: RGBE images keep 8 bits, 0.4 % of the largest of the three materials in a "
        "pixel, in quads and in distance"
    )
    if re.match(r"c[ap]_", source.resolve().name) and not settings.given("poses.file"):
        notes.uncertain.append(
            "names that begin with ca_ or cp_ are of a moving camera, whose poses the files do "
            "not have: it is taken to be at rest"
        )
    return regular.imported(
        source, settings, notes, quads, modulation, times, lens=lens, truth=truth
    )


def _taken(source: Path, cycle: list[Slot], settings: Settings, notes: Notes) -> list[Slot]:
    """The raw frames of all instants, which may end within a cycle.

    Raises:
        InputError: If there are too few for one.
    """
    first, period = settings["assemble.first"], cycle[-1].instant + 1
    instants = _instants(source) - first
    if instants < period:
        why = f"expected {period} instants for one cycle from {first} on, found {max(instants, 0)}"
        raise InputError("too few instants", where=source, why=why, fix="complete the folder")
    notes.understood.append(
        f"assembled: {settings['assemble.taps']} taps, {period} instants in a cycle, material "
        f"{settings['assemble.material']}, from instant {first} on"
    )
    return [
        replace(slot, instant=first + start + slot.instant)
        for start in range(0, instants, period)
        for slot in cycle
        if start + slot.instant < instants
    ]


def _modulation(
    source: Path, cycle: list[Slot], first: Slot, settings: Settings, notes: Notes
) -> Modulation:
    """Frequencies and shifts of a cycle, and the DC offset that its first images have."""
    constant = _constant(source, first, settings["assemble.material"])
    notes.understood += [
        "shifts: 0, -90, -180, -270 degrees of images 0, 1, 2, 3",
        f"DC offset {constant:g}: the median over the pixels of the first instant",
    ]
    calibration = Calibration(
        f_mod_hz=cycle[0].f_mod_hz, dc_offset=constant, cycle_length=len(cycle)
    )
    return Modulation(
        frequencies_hz=np.array([slot.f_mod_hz for slot in cycle]),
        shifts=np.radians([-90.0 * slot.image for slot in cycle]),
        calibration=calibration,
    )


def _cycle(settings: Settings) -> list[Slot]:
    """The raw frames of a cycle: all images at one frequency, then at the next."""
    order = IMAGES[settings["assemble.taps"]]
    return [
        Slot(instant=n * len(order) + i, image=k, f_mod_hz=f_mod_hz)
        for n, f_mod_hz in enumerate(settings["sensor.f_mod_hz"])
        for i, images in enumerate(order)
        for k in images
    ]


def _file(source: Path, instant: int, what: str) -> Path:
    return source / f"{instant:03d}_render_{what}.hdr"


def _image_file(source: Path, slot: Slot, image: int) -> Path:
    return _file(source, slot.instant, f"{slot.f_mod_hz / 1e6:g}MHz_phase{image}")


def _instants(source: Path) -> int:
    """Number of instants of a folder; its true distances number them."""
    if not source.is_dir():
        why, fix = f"expected a folder with {_file(source, 0, 'depth').name}", "name its folder"
        raise InputError("not a folder", where=source, why=f"{why}, found a file", fix=fix)
    check_links(source)
    count = 0
    while _file(source, count, "depth").is_file():
        count += 1
    if not count:
        why = f"expected {_file(source, 0, 'depth').name} and so on, found none"
        raise InputError("no Cornell-Box sequence", where=source, why=why, fix="check the path")
    return count


def _images(
    source: Path, taken: list[Slot], material: int
) -> tuple[Float[np.ndarray, "F H W"], Truth]:
    """Raw frames and true distances.

    Raises:
        InputError: If files are missing, damaged, or of different sizes.
    """
    problems = Problems()
    first = read_radiance(_image_file(source, taken[0], taken[0].image))
    size = {"H": first.shape[0], "W": first.shape[1]}
    quads = empty_quads(source, len(taken), size)
    distance = empty_quads(source, len(taken), size)
    last: tuple[int, np.ndarray | None] = (-1, None)
    for n, slot in enumerate(taken):
        path = _image_file(source, slot, slot.image)
        image = problems.attempt(read_radiance, path, first.shape[:2])
        if slot.instant != last[0]:
            path = _file(source, slot.instant, "depth")
            last = slot.instant, problems.attempt(read_radiance, path, first.shape[:2])
        if image is not None and last[1] is not None:
            quads[n], distance[n] = image[..., material], last[1][..., material]
    problems.raise_if_any(source)
    distance[~((distance > 0) & (distance < FAR_M))] = np.nan
    return quads, Truth(distance=distance, known=np.ones(len(taken), dtype=bool))


def _constant(source: Path, slot: Slot, material: int) -> float:
    """Constant part of the images as a multiple of their amplitude: median at one instant."""
    images = np.stack(
        [read_radiance(_image_file(source, slot, k))[..., material] for k in range(4)]
    )
    amplitude = np.hypot(images[0] - images[2], images[3] - images[1]) / 2
    lit = amplitude > 0
    return float(np.median(images.mean(axis=0)[lit] / amplitude[lit])) if lit.any() else 0.0


def _lens(notes: Notes, height: int, width: int) -> Intrinsics:
    focal = width / 2 / math.tan(math.radians(VIEW_DEG / 2))
    notes.understood.append(f"camera: fx, fy {focal:g} px, of a view of {VIEW_DEG:g} degrees")
    notes.uncertain.append(
        f"camera: a view of {VIEW_DEG:g} degrees is taken from edge to edge of the image; from "
        "centre to centre of its outer pixels the focal length would be 1 / width shorter"
    )
    return Intrinsics(fx=focal, fy=focal, cx=width / 2, cy=height / 2)
