"""The settings of a simulation: with the scene, they decide every byte of the sequence."""

from __future__ import annotations

from dataclasses import dataclass

from ..constants import FRAMES_PER_QUARTET
from ..errors import UsageError

ENGINES = ("gaussian", "mesh")
"""How images are made: Gaussians that cover the scene rendered, or rays traced to surfaces."""
FORMATS = ("ftorf", "torf", "capture")
TRUTHS = ("usual", "all")


@dataclass(frozen=True, kw_only=True)
class SimSettings:
    """How a scene is recorded. None: as the level says if there is one, else the scene, else the
    default of :class:`ResolvedSettings`.

    Raises:
        UsageError: If a value is out of range, or two values contradict each other.

    >>> from gftorf_warp import SimSettings, simulate
    >>> settings = SimSettings(frames=8, size=(24, 18), overrides=("sensor.f_mod_hz=30e6",))
    >>> simulate("demo", "at-30-MHz", settings).name
    'at-30-MHz'
    """

    frames: int | None = None
    """Number of raw frames; None: the scene's own. The last quartet may be incomplete."""
    size: tuple[int, int] | None = None
    """(width, height) of the image [px]; None: the scene's own."""
    seed: int = 0
    """Seed of noise and random paths. Frame n does not depend on the number of frames."""
    sync: bool = False
    """Control mode: all raw frames of a quartet are taken at the time of its first."""
    noise: bool | None = None
    """Shot noise, read noise, full well and ADC, if the scene's sensor has them."""
    flow: bool = False
    """Whether exact optical flow at quartet starts is stored [px], that of the camera included."""
    taps: bool = False
    """Whether the sum of both taps is stored beside their difference; in a capture only, of a
    sensor with two taps."""
    exposure_samples: int | None = None
    """Instants that a raw frame averages over the exposure, centred on its time; 1: no blur."""
    engine: str | None = None
    """One of ``ENGINES``. 'mesh' shares nothing with the renderer of `reconstruct`, and is the only
    one with light beside the camera, a beam, bounces, gloss or a rolling shutter."""
    bounces: int | None = None
    """Surfaces that light may meet after the first; above 0 only with engine 'mesh'."""
    paths: int | None = None
    """Random paths per pixel and raw frame for the light that bounces; needs ``bounces``, or a
    level, which says how many."""
    format: str = "ftorf"
    """Layout on disk: 'ftorf', raw quads; 'torf', one phasor per quartet with the time, pose and
    truth of its first raw frame; 'capture', our own, which also holds any shifts, exposures,
    amplitude and objects."""
    level: str | None = None
    """Level of the ladder from ideal to realistic, see sim/ladder.py: it decides about engine,
    bounces, blur and noise where they are None, and what of the sensor is ideal. None: none."""
    truth: str = "usual"
    """What a capture of engine mesh stores besides distance, amplitude and objects: 'usual' or
    'all', see sim/truth_layers.py. 'all' needs that engine and that format."""
    overrides: tuple[str, ...] = ()
    """Changes of single fields of the scene, its sensor and its bodies, such as
    ``sensor.f_mod_hz=30e6`` or ``bodies.1.path.velocity=3,0,0``."""

    def __post_init__(self):
        least = FRAMES_PER_QUARTET if self.format == "torf" else 1  # a phasor needs a whole quartet
        size = (1, 1) if self.size is None else self.size
        enough = self.frames is None or self.frames >= least
        sized = len(size) == 2 and min(size) >= 1
        pixels = "WIDTHxHEIGHT, both at least 1, for example 160x120"
        require(enough, "--frames", f"{self.frames}", f"at least {least}")
        require(sized, "--size", "x".join(map(str, size)), pixels)
        require(self.seed >= 0, "--seed", f"{self.seed}", "0 or more")
        for name, few in (("exposure_samples", 1), ("bounces", 0), ("paths", 1)):
            value = getattr(self, name)
            good = value is None or value >= few
            require(good, f"--{name.replace('_', '-')}", f"{value}", f"at least {few}")
        for name, known in (("engine", ENGINES), ("format", FORMATS), ("truth", TRUTHS)):
            value = getattr(self, name)
            good = value is None or value in known
            require(good, f"--{name}", repr(value), f"one of {', '.join(known)}")
        layers = self.level is not None or (self.engine, self.format) == ("mesh", "capture")
        why = "only engine mesh computes layers, and only a capture stores them"
        fix = "add --engine mesh --format capture"
        refuse(self.truth == "all" and not layers, ("cannot store all truth", "--truth"), why, fix)
        why, fix = "only a capture stores it", "add --format capture"
        other = self.taps and self.format != "capture"
        refuse(other, ("cannot store the sum of taps", "--taps"), why, fix)
        why, fix = "flow belongs to raw quads", "leave --flow out, or --format ftorf"
        phasors = self.flow and self.format == "torf"
        refuse(phasors, ("a ToeRF folder cannot store optical flow", "--flow"), why, fix)


@dataclass(frozen=True, kw_only=True)
class ResolvedSettings(SimSettings):
    """How a scene is recorded, with nothing left to a level, the scene or a default."""

    frames: int
    """Number of raw frames."""
    size: tuple[int, int]
    """(width, height) of the image [px]."""
    noise: bool = True
    """Whether the sensor's noise is simulated."""
    exposure_samples: int = 1
    """Instants of an exposure."""
    engine: str = "gaussian"
    """One of ``ENGINES``."""
    bounces: int = 0
    """Surfaces that light may meet after the first."""
    paths: int = 64
    """Random paths per pixel and raw frame."""


def refuse(wrong: bool, what: tuple[str, str], why: str, fix: str) -> None:
    """Raise a UsageError if ``wrong``; ``what`` are its message and the option."""
    if wrong:
        raise UsageError(what[0], where=what[1], why=why, fix=fix)


def require(good: bool, where: str, got: str, wanted: str) -> None:
    """Raise a UsageError about the value ``got`` of an option unless it is ``good``."""
    refuse(not good, (f"cannot simulate with {got}", where), f"expected {wanted}", "change it")
