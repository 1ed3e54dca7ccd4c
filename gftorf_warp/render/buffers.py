"""Settings of a rendering, and the arrays they size."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import warp as wp

from ..constants import LOW_PASS
from ..kernels.rasterise import tile_bitmask
from ..kernels.rasterise.composite import LIGHT_PLANES, make_pixels
from ..kernels.rasterise.planes_to_images import Tiling
from ..kernels.rasterise.simd import make_lanes
from ..kernels.rasterise.splat import Splat


class Support(StrEnum):
    """Which pixels a splat may touch."""

    ALPHA = "alpha"
    """The exact ellipse alpha >= 1/255."""
    SIGMA3_TILE16 = "sigma3_tile16"
    """That ellipse, cut by the 3-sigma square rounded out to 16-pixel tiles: parity with the
    released code."""


class Stop(StrEnum):
    """Treatment of the splat that takes a pixel's transmittance below 1e-4."""

    INCLUSIVE = "inclusive"
    """It is the last one added: almost nothing is left over."""
    EXCLUSIVE = "exclusive"
    """It is dropped, so up to 1 % of the distance is missing: parity with the released code."""


class ClampGradient(StrEnum):
    """The derivative of alpha = min(0.99, o G) where it is clamped."""

    EXACT = "exact"
    """Zero."""
    STRAIGHT = "straight"
    """As if unclamped: parity with the released code."""


class Distortion(StrEnum):
    """How depth distortion is summed (method, section 2.7)."""

    PAPER = "paper"
    """sum_k sum_l w_k w_l (d_k - d_l)^2 over all pairs [m^2]."""
    RELEASED = "released"
    """Half that sum, on zeta = far / (far - near) (1 - near / d) instead of metres [1]."""


class SplatDistance(StrEnum):
    """Which distance a splat has at a pixel of its footprint; phase and fall-off follow it."""

    CENTRE = "centre"
    """Its centre's, at all of them."""
    PLANE = "plane"
    """That of the Gaussian's peak along the ray, to first order around the centre, at most three
    of its largest standard deviations and half of its distance away from the centre's. Its
    derivative is exact, but zero by the slope where a pixel is clamped to this bound, and always
    zero by the bound."""


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """How Gaussians are rendered; alternatives to the exact defaults are for parity.

    >>> from gftorf_warp import RenderSettings
    >>> RenderSettings(splat_distance="plane", near=0.1).splat_distance
    'plane'
    """

    near: float = 0.05
    """Gaussians nearer than this z-depth are culled [m]."""
    far: float = 1000.0
    """Gaussians farther than this z-depth are culled [m]."""
    low_pass: float = LOW_PASS
    """Variance that is added to every splat, so that none falls between pixels [px^2]; the box of
    a pixel has 1/12."""
    sh_degree: int = 3
    """Harmonics above this degree are ignored, 0..3."""
    phasor_factor: float = 2.0
    """Length of a phasor over the amplitude a: 2 equals the differences of opposite quads, 1 is the
    released code's."""
    support: Support = Support.ALPHA
    """Which pixels a splat may touch."""
    stop: Stop = Stop.INCLUSIVE
    """How a pixel ends early."""
    clamp_gradient: ClampGradient = ClampGradient.EXACT
    """The derivative of a clamped alpha."""
    distortion: Distortion = Distortion.PAPER
    """Which distortion is returned."""
    splat_distance: SplatDistance = SplatDistance.CENTRE
    """Whether the distance varies inside a splat."""
    depth_bits: int = 24
    """Bits of the key that orders splats by z-depth, 24 or 16; on CUDA the sort takes a pass for
    every eight.

    A key counts the floats from ``near`` on and drops the bits that do not fit, see
    ``depth_shift``: it is linear in z between two powers of two, twice as wide beyond. Splats of
    one key keep their order in memory. From 0.135 to 7.425 m, the presets at 20 MHz, a key is 1 um
    wide at 3 m, at most 5e-7 of z; with 16 bits, an approximation, 0.24 mm and 1.2e-4.
    """
    pair_capacity: int | None = None
    """(tile, splat) pairs to reserve; None reads their number back, the one host synchronisation of
    a rendering.

    With a number nothing is read back on CUDA: pairs that do not fit are dropped, and
    ``Buffers.check_capacity`` raises. On the CPU it is called in every rendering.
    """
    deterministic: bool = False
    """Whether gradients are summed in one order on CUDA, as on the CPU, so that equal work gives
    equal bytes.

    Except those of the sensor's numbers. It takes 128 bytes for every (tile, splat) pair.
    """
    threads: int | None = None
    """CPU threads of the blend; None: as many as this process may use. Another number changes sums
    by rounding only."""

    def __post_init__(self):
        if not 0 < self.near < self.far:
            got = f"{self.near} and {self.far}"
            raise ValueError(f"near and far must satisfy 0 < near < far, got {got}")
        if not (self.low_pass > 0 and math.isfinite(self.low_pass)):
            raise ValueError(f"low_pass must be above 0 and finite, got {self.low_pass}")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        if self.depth_bits not in (16, 24):
            raise ValueError(f"depth_bits must be 16 or 24, got {self.depth_bits}")
        if not math.isfinite(self.phasor_factor):
            raise ValueError(f"phasor_factor must be finite, got {self.phasor_factor}")
        if self.pair_capacity is not None and self.pair_capacity < 0:
            raise ValueError(f"pair_capacity must be 0 or more, got {self.pair_capacity}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")

    @property
    def depth_shift(self) -> int:
        """Number of low bits of a z-depth that its key drops, so that ``far`` fits."""
        with np.errstate(over="ignore", under="ignore"):
            near, far = (int(np.float32(z).view(np.int32)) for z in (self.near, self.far))
        shift = 0
        while (far - near) >> shift >= self.depth_culled:
            shift += 1
        return shift

    @property
    def depth_culled(self) -> int:
        """Key of what is culled, behind all others."""
        return (1 << self.depth_bits) - 1


# pixels per thread, columns and rows of a tile: a CPU thread works on a block of 4 x 4 pixels at
# once, on CUDA a warp owns a tile and every thread a pixel (design/tiles.md)
TILE_SHAPES = {"cpu": (16, 8, 8), "cuda": (1, 8, 4)}

# segments of a list in the backward pass where warps own tiles (kernels/rasterise/list_segments.py,
# design/tiles.md)
SEGMENTS = {"cpu": 1, "cuda": 4}
LANES_PER_SPLAT = {"cpu": 1, "cuda": 32}  # threads that write the (tile, splat) pairs of a splat

# bit matrix at most: zeroed, counted and read, at 4 TB/s it takes 0.1 ms, as a sort of few pairs
MATRIX_MAX = 128 << 20  # [B]
READERS = 8192  # warps that read it: about as many as 132 multiprocessors hold at once

# splats that are ordered by depth bins: all in one bin, each compared with all, would take 0.1 ms
BINNED_MAX = {"cpu": 0, "cuda": 32_768}


def available_threads() -> int:
    """CPU threads this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Buffers:
    """The arrays of a rendering and its backward pass, by name; the next rendering reuses them."""

    def __init__(
        self, count: int, width: int, height: int, settings: RenderSettings, device: wp.Device
    ):
        """Reserve memory for ``count`` Gaussians and an image of ``width`` x ``height``."""
        self.count, self.width, self.height = count, width, height
        self.settings, self.device = settings, device
        kind = "cpu" if device.is_cpu else "cuda"
        self.K, self.tile_width, self.tile_height = TILE_SHAPES[kind]
        self.lanes_per_splat = LANES_PER_SPLAT[kind]
        self.tiles_x = math.ceil(width / self.tile_width)
        self.tiles = self.tiles_x * math.ceil(height / self.tile_height)
        pixels = make_pixels(self.K, self.tile_width, self.tile_height)
        self.lanes = pixels.lanes
        self.segments_wanted = SEGMENTS[kind] if self.cooperative else 1
        self.segments = 1  # in which the backward pass of the last rendering may take its lists
        self.threads = (settings.threads or available_threads()) if device.is_cpu else 1
        self.tiling = Tiling()
        self.tiling.width_log2 = self.tile_width.bit_length() - 1
        self.tiling.height_log2 = self.tile_height.bit_length() - 1
        self.tiling.side_log2, self.tiling.count_x = pixels.side.bit_length() - 1, self.tiles_x

        self._arrays: dict[str, wp.array] = {}
        self._planes: dict[str, Planes] = {}
        self.renderings = 0  # number so far
        self.splats = self.array("splats", count, Splat)
        self.box_px = self.array("boxes", count, wp.vec4i)
        self.depth_shift = settings.depth_shift
        # the radix sort needs twice the length
        self.depth_key = self.array("depth keys", 2 * count)
        self.order = self.array("order", 2 * count)
        # whether no sort is needed for the order
        self.binned = 0 < count <= BINNED_MAX[kind] and not self.ordered
        self.words = 2 * math.ceil(count / 64)  # of a tile in a matrix of a bit per tile and splat
        self.matrix = math.ceil(self.tiles / tile_bitmask.GROUP) * tile_bitmask.GROUP * self.words
        # whether lists of tiles are made of it
        self.marks = not self.ordered and 4 * self.matrix <= MATRIX_MAX
        # of a warp, two words a lane
        steps = math.ceil(self.words / 64) / math.ceil(READERS / self.tiles)
        self.part = 64 * max(1, math.ceil(steps))  # words of a tile that a warp reads
        self.parts = math.ceil(self.words / self.part)
        entries = self.tiles * self.parts if self.marks else count
        self.counts, self.ends = self.array("counts", entries), self.array("ends", entries)
        self.total, self.first = self.array("total", 1), self.array("first", self.tiles + 1)
        self.keys = self.ids = self.owners = self.array("no pairs", 0)
        self.sums = self.planes("light", LIGHT_PLANES)
        self.channels: list[Planes] = []
        # of each pass: ``splats``, and copies with other channels
        self.records: list[wp.array] = []

    @property
    def ordered(self) -> bool:
        """Whether every pair has its own gradient record: on CUDA, for deterministic gradients."""
        return self.settings.deterministic and self.K == 1

    @property
    def sloped(self) -> bool:
        """Whether the distance varies inside a splat."""
        return self.settings.splat_distance == SplatDistance.PLANE

    @property
    def cooperative(self) -> bool:
        """Whether the lanes of a warp, which owns a tile, fetch records for each other."""
        return self.K == 1

    @property
    def groups_with_light(self) -> int:
        """Number of channel groups blended together with the light."""
        return min(len(self.channels), 2 if self.cooperative and self.threads == 1 else 1)

    def array(self, name: str, shape: int | tuple[int, ...], dtype=wp.int32) -> wp.array:
        """Device memory by name, with the content of its last use."""
        wanted = (shape,) if isinstance(shape, int) else shape
        if name not in self._arrays or self._arrays[name].shape != wanted:
            self._arrays[name] = wp.empty(wanted, dtype=dtype, device=self.device)
        return self._arrays[name]

    def zeros(self, name: str, shape: int | tuple[int, ...], dtype=wp.int32) -> wp.array:
        """As :meth:`array`, zeroed."""
        array = self.array(name, shape, dtype)
        array.zero_()
        return array

    def reserve_pairs(self, capacity: int) -> None:
        """Allocate ``capacity`` (tile, splat) pairs, for a sort with keys and twice as many."""
        length = capacity if self.marks else 2 * capacity
        if len(self.ids) < length:
            self.ids = self.array("ids", length)
            self.keys = self.keys if self.marks else self.array("keys", length)

    def check_capacity(self) -> None:
        """Raise if the pair capacity was too small, so that far splats are missing; synchronises.

        Raises:
            ValueError: With the number of pairs that would have fitted.
        """
        capacity = self.settings.pair_capacity
        needed = int(self.total.numpy()[0]) if self.count else 0
        if capacity is not None and needed > capacity:
            got = f"this rendering has {needed} (tile, splat) pairs"
            raise ValueError(f"pair_capacity = {capacity} is too small: {got}")

    def planes(self, name: str, count: int) -> Planes:
        """``count`` image planes in tile order."""
        if name not in self._planes:
            flat = self.array(name, Planes.shape_of(self, count), wp.float32)
            self._planes[name] = Planes(flat, self)
        return self._planes[name]

    def gradient_planes(self, name: str, count: int, *, added: bool) -> Planes:
        """Zeroed planes, as pixels outside the image must not be NaN; once, unless ``added`` to."""
        anew = name not in self._planes
        planes = self.planes(name, count)
        if anew or added:
            planes.flat.zero_()
        return planes


class Planes:
    """Image planes in tile order: ``lanes`` for the compositor, ``flat`` for kernels per pixel."""

    def __init__(self, flat: wp.array, buffers: Buffers):
        self.flat = flat
        self.lanes = wp.array(
            ptr=flat.ptr,
            dtype=make_lanes(buffers.K).V,
            shape=(flat.shape[0], buffers.tiles + 1, buffers.lanes),
            device=buffers.device,
        )  # a view: ``flat`` owns the memory, and lives as long as this object

    @staticmethod
    def shape_of(buffers: Buffers, count: int) -> tuple[int, int]:
        """Planes and their floats; a tile of padding avoids cache conflicts between planes."""
        return count, (buffers.tiles + 1) * buffers.lanes * buffers.K


class Workspace:
    """Memory of consecutive renderings of one size, which allocate images and gradients only.

    Backward must come before the next rendering. Another size or setting releases the memory, which
    CUDA graphs must not outlive.
    """

    def __init__(self) -> None:
        self._key: tuple | None = None
        self._buffers: Buffers | None = None

    def buffers(
        self, count: int, width: int, height: int, settings: RenderSettings, device: wp.Device
    ) -> Buffers:
        """The buffers of the last rendering if it was of this kind, otherwise a new one."""
        key = count, width, height, settings, device
        if self._buffers is None or self._key != key:
            self._key, self._buffers = key, Buffers(count, width, height, settings, device)
        return self._buffers

    @property
    def last(self) -> Buffers:
        """The buffers of the last rendering.

        Raises:
            ValueError: If there was none.
        """
        if self._buffers is None:
            raise ValueError("nothing has been rendered in this workspace")
        return self._buffers

    def check_capacity(self) -> None:
        """As ``Buffers.check_capacity``, for the last rendering."""
        if self._buffers is not None:
            self._buffers.check_capacity()
