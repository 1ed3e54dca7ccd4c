"""The moving Gaussians of a run in few bytes, for ``scene.html``: little-endian arrays in a row.

    index  uint32 [P]     number of each Gaussian that moves or is not always there, by moment
    scale  uint16 [N, 3]  logarithms of the standard deviations
    still  uint16 [R, 3]  places of the first R Gaussians, which rest
    place  uint16 [P, 3]  places of the others, by moment
    colour uint8 [N, 4]   red, green, blue as shown, and opacity
    turn   int8 [R, 4], then [P, 4]  quaternions wxyz times 127

Places and scales are low + step * integer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..constants import ALPHA_MIN
from ..errors import UsageError
from ..evaluate.previews import srgb
from ..render.reference import shade, spherical_harmonics
from ..scene.gaussians import GaussianField
from .moments import Moments, Progress
from .splats import at_moment, colour_harmonics

BYTES_MAX = 64 << 20  # of the arrays: browsers parse a page of that size in a few seconds
MOVED_BYTES, STILL_BYTES = 4 + 6 + 4, 6 + 4 + 6 + 4  # of a Gaussian
LEVELS = 65535  # steps of a place or scale
DEGREE = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Packed:
    """What the page draws."""

    arrays: bytes
    """As the module's text lists them."""
    sizes: dict[str, object]
    """Lengths, and bounds of places and scales, for the page."""
    centre: Float[np.ndarray, "n 3"]
    """Centres of the Gaussians that rest, or of all if none does [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """What is the same at all moments."""

    rests: Bool[Tensor, "N"]
    """Gaussians that are there at all moments, in one place and orientation."""
    seen: Bool[Tensor, "N"]
    """Gaussians that are there at some moment."""
    field: GaussianField
    """Each Gaussian where it is first."""
    low: Float[np.ndarray, "3"]
    """The least coordinates at any moment [m]."""
    high: Float[np.ndarray, "3"]
    """The largest coordinates at any moment [m]."""


@dataclass(frozen=True)
class Quantiser:
    """Numbers as uint16, for each of C columns."""

    low: Float[np.ndarray, "C"]
    """Value of 0."""
    step: Float[np.ndarray, "C"]
    """Between neighbours."""

    @classmethod
    def over(cls, low: Float[np.ndarray, "C"], high: Float[np.ndarray, "C"]) -> Quantiser:
        """From the least and the largest values."""
        low, high = (np.asarray(ends, np.float64) for ends in (low, high))
        return cls(low, np.maximum(high - low, 1e-6) / LEVELS)

    def __call__(self, values: Float[np.ndarray, "n C"]) -> Int[np.ndarray, "n C"]:
        """The integers nearest to some rows."""
        return np.clip(np.round((values - self.low) / self.step), 0, LEVELS).astype("<u2")

    def stated(self) -> dict[str, list[float]]:
        """For the page."""
        return {"low": self.low.tolist(), "step": self.step.tolist()}


def packed(moments: Moments, progress: Progress, colour: str) -> Packed:
    """All Gaussians at all moments, those that rest first.

    Raises:
        UsageError: If that is too much, or nothing.
    """
    surveyed = survey(moments)
    order = torch.cat(
        [rows.nonzero()[:, 0] for rows in (surveyed.rests, surveyed.seen & ~surveyed.rests)]
    )
    resting, field = int(surveyed.rests.sum()), surveyed.field.map(lambda tensor: tensor[order])
    number = torch.full((len(surveyed.seen),), -1)
    number[order] = torch.arange(len(order))
    places, log_scale = Quantiser.over(surveyed.low, surveyed.high), field.log_scale.numpy()
    scales = Quantiser.over(log_scale.min(axis=0), log_scale.max(axis=0))
    indices, moved, turns = zip(*moving(moments, surveyed, number, places, progress), strict=True)
    still = field.map(lambda tensor: tensor[:resting])
    harmonics = colour_harmonics(moments, colour).cpu()[order]
    shown = shown_colour(field, harmonics, moments, linear=colour != "colour")
    arrays = [*indices, scales(log_scale), places(still.mean.numpy()), *moved]
    arrays += [shown, turned(still), *turns]
    sizes = {
        "count": len(order),
        "resting": resting,
        "moving": [len(index) for index in indices],
        "place": places.stated(),
        "scale": scales.stated(),
    }
    content = b"".join(array.tobytes() for array in arrays)
    return Packed(arrays=content, sizes=sizes, centre=(still if resting else field).mean.numpy())


def survey(moments: Moments) -> Survey:
    """Which Gaussians rest, and bounds of all places.

    Raises:
        UsageError: If the others are too many, or there is none.
    """
    first, there = at_moment(moments, 0)
    rests = seen = there & (first.opacity >= ALPHA_MIN)
    low, high, pairs = (
        first.mean.new_full((3,), torch.inf),
        first.mean.new_full((3,), -torch.inf),
        0,
    )
    for index in range(len(moments)):
        field, there = at_moment(moments, index)
        there = there & (field.opacity >= ALPHA_MIN)
        first = replaced(first, field, there & ~seen)
        alike = torch.cat([field.mean == first.mean, field.quaternion == first.quaternion], dim=1)
        rests, seen = rests & there & alike.all(dim=1), seen | there
        if there.any():
            low = torch.minimum(low, field.mean[there].amin(dim=0))
            high = torch.maximum(high, field.mean[there].amax(dim=0))
        pairs += int(there.sum())
    check_size(pairs - len(moments) * int(rests.sum()), int(seen.sum()), len(moments))
    return Survey(rests=rests, seen=seen, field=first, low=low.numpy(), high=high.numpy())


def check_size(moved: int, seen: int, moments: int) -> None:
    """Whether Gaussians that move, summed over moments, and all that are seen fit the page.

    Raises:
        UsageError: If they are too many, or none.
    """
    size = MOVED_BYTES * moved + STILL_BYTES * seen
    if size > BYTES_MAX:
        why = f"{moments} moments take {size >> 20} MB, the most is {BYTES_MAX >> 20}"
        fix = f"take one in {-(-size // BYTES_MAX)} of these moments, see --every"
        raise UsageError("the page would be too large", where="scene.html", why=why, fix=fix)
    if not seen:
        why, fix = "no Gaussian is there at any of these times", "choose other --times"
        raise UsageError("nothing to show", where="scene.html", why=why, fix=fix)


def replaced(first: GaussianField, field: GaussianField, new: Bool[Tensor, "N"]) -> GaussianField:
    """The field ``first`` with places and shapes of another for Gaussians that are ``new``."""
    names = ("mean", "log_scale", "quaternion")
    pairs = {name: (getattr(field, name), getattr(first, name)) for name in names}
    return replace(first, **{n: torch.where(new[:, None], *pair) for n, pair in pairs.items()})


def moving(
    moments: Moments,
    surveyed: Survey,
    number: Int[Tensor, "N"],
    places: Quantiser,
    progress: Progress,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Index, place and turn of what does not rest, for each moment."""
    for index in range(len(moments)):
        field, there = at_moment(moments, index)
        chosen = there & surveyed.seen & ~surveyed.rests
        moved = field.map(lambda tensor, chosen=chosen: tensor[chosen])
        yield number[chosen].numpy().astype("<u4"), places(moved.mean.numpy()), turned(moved)
        progress(index + 1, len(moments))


def turned(field: GaussianField) -> Int[np.ndarray, "N 4"]:
    """Quaternions as int8."""
    unit = torch.nn.functional.normalize(field.quaternion, dim=1)
    return (127.0 * unit).round().to(torch.int8).numpy()


def shown_colour(
    field: GaussianField, harmonics: Float[Tensor, "N 16 3"], moments: Moments, *, linear: bool
) -> UInt8[np.ndarray, "N 4"]:
    """Colour as the first moment's camera sees it, sRGB or ``linear``, and opacity."""
    away = field.mean - torch.from_numpy(moments.cameras[0].centre).to(field.mean)
    basis = spherical_harmonics(torch.nn.functional.normalize(away, dim=1), DEGREE)
    rgb = shade(basis, harmonics.flatten(1), channels=3).numpy()
    eight = np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8) if linear else srgb(rgb)
    opacity = (255.0 * field.opacity).round().to(torch.uint8).numpy()
    return np.concatenate([eight, opacity[:, None]], axis=1)
