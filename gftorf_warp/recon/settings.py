"""Everything that decides how a sequence is reconstructed, as frozen values; presets.py names
combinations.

All intervals count optimised images: one raw frame compared once is one image, whatever the batch.
Shares of the run and every decay follow ``Schedule.images``.
"""

from __future__ import annotations

import dataclasses
import enum
from dataclasses import dataclass, field, fields
from typing import Any

from ..constants import FRAMES_PER_QUARTET
from ..data.flow import Method as Matcher
from ..render.buffers import RenderSettings
from ..scene.changes import require
from ..scene.initialise import InitSettings
from ..scene.models import KINDS
from ..scene.motion import MotionSettings
from .volume.settings import VolumeSettings

# of a step of Adam, which moves a value by about its rate: scenes are tens of metres wide, and
# logits and logarithms of all that matters lie within tens
RATE_MAX = 10.0
WEIGHT_MAX = 1e6  # of a term of the loss: sums of squares stay within float32


class Method(enum.StrEnum):
    """What kind of reconstruction a run is."""

    GAUSSIANS = "gaussians"
    """Moving Gaussians, fitted by gradient descent."""
    CTOF = "ctof"
    """The closed form on every quartet: nothing is fitted (method, section 7)."""
    TEMPORAL = "temporal"
    """The closed form of the temporal mean where a quartet agrees with its pixel's median, and of
    the quartet elsewhere."""
    FLOW2D = "flow2d"
    """The closed form of quartets whose raw frames optical flow brought to one time."""
    TORF = "torf"
    """A neural volume fitted to phasors and colour."""
    FTORF = "ftorf"
    """A neural volume fitted to raw quads at their own times."""
    VOLUME = "volume"
    """The same with hash grids instead of a large network, of our own."""

    @property
    def is_volume(self) -> bool:
        """Whether a neural volume is fitted."""
        return self in (Method.TORF, Method.FTORF, Method.VOLUME)

    @property
    def fits(self) -> bool:
        """Whether parameters are optimised."""
        return self == Method.GAUSSIANS or self.is_volume


class Input(enum.StrEnum):
    """What is compared with the sensor."""

    AUTO = "auto"
    """Phasors if the camera delivered phasors, else quads."""
    QUADS = "quads"
    """Every raw frame at its own time, in the one slot that it measured."""
    PHASOR = "phasor"
    """The phasor of every quartet, as if its four raw frames had been taken at once, in the
    middle."""


class Norm(enum.StrEnum):
    """Norm of the differences of colours."""

    L1 = "l1"
    """Their absolute value."""
    L2 = "l2"
    """Their square."""


class FlowSource(enum.StrEnum):
    """Where optical flow between quartets comes from."""

    AUTO = "auto"
    """The sequence's own if it has any, otherwise computed by dense inverse search."""
    FILE = "file"
    """The sequence's own, or none."""
    DIS = "dis"
    """Computed from same-shift quads by dense inverse search."""
    DEEPFLOW = "deepflow"
    """Computed from same-shift quads by DeepFlow."""
    NONE = "none"
    """No flow: no flow loss, and motion starts at rest."""

    @property
    def matcher(self) -> Matcher:
        """What computes it where none is read."""
        return "deepflow" if self == FlowSource.DEEPFLOW else "dis"


class Batch(enum.StrEnum):
    """What one step of the optimiser compares."""

    FRAME = "frame"
    """One raw frame (method, section 5)."""
    QUARTET = "quartet"
    """The measured raw frames of one quartet."""


class BatchRule(enum.StrEnum):
    """Learning-rate scaling: Adam's rates and decays in steps of several images."""

    NONE = "none"
    """As for single images."""
    ROOT = "root"
    """For b images: rates times the root of b, both decays to the power of b."""
    LINEAR = "linear"
    """As ``root`` with rates times b, which short runs need."""


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Learning rates of Adam (method, section 6.5)."""

    mean: float = 1.6e-3
    """Centres [m]."""
    log_scale: float = 1e-3
    """Scales [log m]."""
    quaternion: float = 1e-3
    """Orientations [1]."""
    opacity_logit: float = 0.05
    """Opacities before the sigmoid [1]."""
    reflectivity_sh: float = 1.6e-4
    """All 16 harmonics of the reflectivity [m^2 in quad units]; low: heuristic H1."""
    colour_constant: float = 2.5e-3
    """The constant harmonic of the colour [1]."""
    colour_rest: float = 1.25e-4
    """The 15 other harmonics of the colour [1]."""
    motion: float = 8e-4
    """Key offsets of the nodes [m], or weights of the network [1]."""

    def __post_init__(self):
        require(self, *(field.name for field in fields(self)), at_least=0, at_most=RATE_MAX)

    def times(self, factor: float) -> Rates:
        """All rates multiplied."""
        return Rates(**{name: factor * rate for name, rate in dataclasses.asdict(self).items()})


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of the terms of the loss; a term of weight 0 is not computed (method, section 5)."""

    quads: float = 1.0
    """Quads, or the phasor: (1 - ssim) L2 + ssim (1 - SSIM) [1]."""
    ssim: float = 0.2
    """Share of the structural similarity in the terms of images [1]."""
    colour: float = 0.0
    """Colour: (1 - ssim) L1 or L2 + ssim (1 - SSIM) [1]; needs a calibrated colour camera."""
    colour_norm: Norm = Norm.L2
    """Norm of that difference."""
    depth: float = 0.0
    """Rendered against closed-form distance: (1 - ssim) L1 + ssim (1 - SSIM) [1/m]."""
    distortion: float = 0.0
    """Mean depth distortion [1/m^2]."""
    flow: float = 0.0
    """Squared difference to the optical flow, at quartet starts only [1/px^2]."""
    motion_size: float = 0.0
    """Mean length of the displacements [1/m]."""

    def __post_init__(self):
        terms = [field.name for field in fields(self) if field.name not in ("ssim", "colour_norm")]
        require(self, *terms, at_least=0, at_most=WEIGHT_MAX)
        require(self, "ssim", at_least=0, at_most=1)


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Lengths and intervals, in images or as fractions of the run."""

    images: int = 60_000
    """Length of the run [images]."""
    batch: Batch = Batch.QUARTET
    """What one step compares; a phasor is one image."""
    batch_rule: BatchRule = BatchRule.NONE
    """Learning-rate scaling for larger batches."""
    warm_up: int = 0
    """Warm-up, in which nothing moves and the motion is not optimised [images]."""
    motion_decay_from: int = 0
    """The learning rate of the motion decays from here to the end [images]."""
    motion_ramp: int = 0
    """Linear warm-up of the learning rate of the motion [images]."""
    pause_after_reset: int = 0
    """The motion is not optimised for so long after an opacity reset [images]."""
    freeze_from: float | None = None
    """From this fraction of the run on only the motion is optimised [1]; None: never."""
    colour_from: int = 0
    """The colour loss begins here [images]."""
    flow_from: int = 0
    """The flow loss begins here [images]."""
    flow_every: int = 1
    """It is computed in one of so many steps, with so many times the weight."""
    distortion_from: float = 0.0
    """The depth distortion begins at this fraction of the run [1]."""
    sh_degree_every: int | None = None
    """Images between two increments of the degree of harmonics, from 0 up to that of ``render``;
    None: the highest from the start."""
    log_every: int = 100
    """Between two rows of metrics.jsonl [images]."""
    checkpoint_every_s: float = 60.0
    """Between two checkpoints [s]; changes no result."""

    def __post_init__(self):
        require(self, "images", "log_every", "flow_every", "sh_degree_every", at_least=1)
        require(self, "warm_up", "motion_decay_from", "motion_ramp", at_least=0)
        require(self, "pause_after_reset", "colour_from", "flow_from", at_least=0)
        require(self, "checkpoint_every_s", at_least=0)
        require(self, "freeze_from", "distortion_from", at_least=0, at_most=1)


@dataclass(frozen=True, kw_only=True)
class DensifySettings:
    """Densification, pruning and opacity resets (method, section 6.6)."""

    every: int | None = None
    """Interval of densification: cloning, splitting, pruning [images]; None: never."""
    start: int = 250
    """No densification up to here [images]."""
    stop_share: float = 0.6
    """No densification and no opacity reset after this fraction of the run [1]."""
    gradient_min: float | None = 2e-4
    """Mean screen gradient, in half image sizes, from which Gaussians are cloned or split; None:
    none are."""
    clone_scale_max: float = 0.08
    """Up to this largest scale a Gaussian is cloned, above it is split [m]."""
    opacity_min: float = 0.01
    """Gaussians of lower opacity are pruned [1]."""
    scale_range: tuple[float, float] = (0.0, float("inf"))
    """Gaussians whose largest scale is outside are pruned [m]."""
    scale_from: int = 3000
    """Pruning by scale begins after this [images]."""
    unseen_from: int | None = None
    """Visibility pruning begins here: of Gaussians hidden in every image [images]; None: never."""
    unseen_weight: float = 0.0
    """Visibility pruning removes Gaussians whose blending weight, summed over the pixels of an
    image and averaged over at least all raw frames, is at most this [px]."""
    reset_every: int | None = None
    """Interval of opacity resets to ``opacity_min`` [images]; None: never."""
    reset_faster: tuple[int, int] | None = None
    """From the first number of images on, the second is the interval; None: it does not change."""
    loses_step: bool = False
    """Whether the update of Gaussians is skipped in steps with densification, as published."""
    gaussians_min: int = 16
    """Nothing is pruned if fewer would remain [Gaussians]."""
    gaussians_max: int = 200_000
    """Upper limit; the largest gradients are densified first [Gaussians]."""

    def __post_init__(self):
        require(self, "every", "reset_every", "reset_faster", "gaussians_max", at_least=1)
        require(self, "start", "scale_from", "unseen_from", "gaussians_min", at_least=0)
        require(self, "gradient_min", "clone_scale_max", "unseen_weight", at_least=0)
        require(self, "stop_share", at_least=0, at_most=1)
        if not 0 <= self.scale_range[0] <= self.scale_range[1]:
            raise ValueError(f"scale_range must be two sizes in order, got {self.scale_range}")
        if not 0 < self.opacity_min < 1:
            raise ValueError(f"opacity_min must be in (0, 1), got {self.opacity_min}")


@dataclass(frozen=True, kw_only=True)
class ReconSettings:
    """How a sequence is reconstructed."""

    preset: str
    """Name of the preset these settings came from."""
    ablation: str | None = None
    """Row of the ablation table that was applied; None: none."""
    method: Method = Method.GAUSSIANS
    """What kind of reconstruction this is."""
    input: Input = Input.AUTO
    """What is compared with the sensor."""
    cycle: int = FRAMES_PER_QUARTET
    """Raw frames per quartet of the sequence; counts in learning-rate scaling."""
    quad_scale: float | None = None
    """Factor of quads and phasors [1]; None: that of the sequence, or for a largest phasor of 1."""
    width_max: int | None = None
    """Wider images are reduced to this for the optimisation [px]; None keeps all pixels."""
    flow: FlowSource = FlowSource.AUTO
    """Where optical flow comes from."""
    init: InitSettings = field(default_factory=InitSettings)
    """The first Gaussians."""
    motion: MotionSettings = field(default_factory=MotionSettings)
    """The motion model."""
    volume: VolumeSettings | None = None
    """The neural volume of methods ``torf``, ``ftorf`` and ``volume``, which have neither Gaussians
    nor their ``init``, ``motion``, ``rates``, ``densify`` and ``render``; None: of no other."""
    render: RenderSettings = field(default_factory=RenderSettings)
    """The renderer, also of the finished run."""
    rates: Rates = field(default_factory=Rates)
    """Learning rates at the start."""
    rates_last: Rates = field(default_factory=lambda: Rates().times(0.01))
    """Learning rates at the end; in between, the logarithm is linear."""
    weights: Weights = field(default_factory=Weights)
    """Weights of the loss."""
    schedule: Schedule = field(default_factory=Schedule)
    """Lengths and intervals."""
    densify: DensifySettings = field(default_factory=DensifySettings)
    """The number of Gaussians."""
    scale_max: float | None = None
    """Largest scale of a Gaussian along any of its axes, kept after every step [m]; None: any."""
    background: float = 1.0
    """Amplitude B of the random background, uniform in [-B, B]; 0 is black."""
    motion_gradient_max: float | None = 1.0
    """Largest gradient norm of the motion, clipped [1/m for nodes, 1 for a network]; None: any."""
    graph: bool = True
    """Whether steps are captured as CUDA graphs; on a CPU there are none. Changes no operation."""
    failures_max: int = 5
    """Non-finite steps in a row before a return to the last checkpoint with halved rates."""
    rollbacks_max: int = 3
    """Returns to a checkpoint before the run ends as diverged."""
    fallback: bool = False
    """Whether measured distances replace those of the finished run where they are more accurate,
    see recon/fallback.py; the optimisation is the same."""
    outlines: bool = False
    """Whether mixed pixels of the finished run have the distance of the surface at their centre,
    see recon/outlines.py; the optimisation is the same."""
    attempts_max: int = 1
    """Fits of a run, 1 or 2: one that its residuals call failed is followed by another one from
    another start, and the better one stays, see recon/attempts.py."""
    restarts_max: int = 3
    """Restarts of collapsed random starts and of empty volumes, and reinitialisations of a dead
    network, at most."""

    def __post_init__(self):
        require(self, "scale_max", "quad_scale", "motion_gradient_max", above=0)
        require(self, "width_max", "failures_max", at_least=1)
        require(self, "attempts_max", at_least=1, at_most=2)
        require(self, "background", "rollbacks_max", "restarts_max", at_least=0)
        if self.motion.kind not in KINDS:
            raise ValueError(
                f"motion.kind must be one of {', '.join(KINDS)}, got {self.motion.kind!r}"
            )


UNREAD = ("attempts_max", "failures_max", "rollbacks_max")
GAUSSIANS_ONLY = ("fallback", "outlines", *UNREAD)
"""Settings that no other method can change; there are runs that state those of ``UNREAD``, which no
other method ever read."""
FITTED_ONLY = ("restarts_max",)
"""Settings that methods without a fit cannot change."""


def plain(settings: ReconSettings) -> dict[str, object]:
    """Settings as nested dictionaries of numbers, texts and None, as config.json holds them."""
    converted: dict[str, object] = _converted(dataclasses.asdict(settings))
    return converted


def _converted(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _converted(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_converted(item) for item in value]
    if isinstance(value, float) and value in (float("inf"), float("-inf")):
        return str(value)
    return str(value) if isinstance(value, enum.Enum) else value
