"""``scene.html``: one offline page in which the splats move, with a time slider.

The page holds a JSON object (times, cameras, bounds, sizes) and one block of little-endian arrays
in base64, in this order:

    index  uint32 [P]     number of each Gaussian that moves or is not always there, by moment
    scale  uint16 [N, 3]  logarithms of the standard deviations
    still  uint16 [R, 3]  places of the first R Gaussians, which rest
    place  uint16 [P, 3]  places of the others, by moment
    colour uint8 [N, 4]   red, green, blue as shown, and opacity
    turn   int8 [R, 4], then [P, 4]  quaternions wxyz times 127

Places and scales are low + step * integer. scene.js draws them by WebGL 2.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..constants import ALPHA_MIN
from ..data.files import atomic_write
from ..errors import UsageError
from ..evaluate import page, pictures
from ..evaluate.previews import srgb
from ..render.reference import shade, spherical_harmonics
from ..scene.gaussians import GaussianField
from .moments import Moments, Progress
from .splats import at_moment, colour_harmonics

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
BYTES_MAX = 64 << 20  # of the arrays: browsers parse a page of that size in a second or two
MOVED_BYTES, STILL_BYTES = 4 + 6 + 4, 6 + 4 + 6 + 4  # of a Gaussian
LEVELS = 65535  # steps of a place or scale
DEGREE = 3
HERE = Path(__file__).parent


@dataclass(frozen=True, kw_only=True, eq=False)
class Still:
    """What does not change."""

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


def write(moments: Moments, path: Path, progress: Progress, *, colour: str) -> None:
    """Write the page.

    Raises:
        UsageError: If the page would be too large, or show nothing.
    """
    harmonics = colour_harmonics(moments, colour)
    still = still_part(moments)
    order = torch.cat([index.nonzero()[:, 0] for index in (still.rests, still.seen & ~still.rests)])
    number = torch.full((len(still.seen),), -1)
    number[order] = torch.arange(len(order))
    rows = int(still.rests.sum())
    places = Quantiser.over(still.low, still.high)
    scales = still.field.log_scale[order].numpy()
    sizes = Quantiser.over(scales.min(axis=0), scales.max(axis=0))
    moving = list(moving_parts(moments, still, number, places, progress))
    resting = still.field.map(lambda tensor: tensor[order[:rows]])
    indices, moved, turns = zip(*moving, strict=True)
    arrays = [
        *indices,
        sizes(scales),
        places(resting.mean.numpy()),
        *moved,
        shown_colour(still.field, harmonics, moments, linear=colour != "colour")[order.numpy()],
        turned(resting),
        *turns,
    ]
    about = {
        "times": moments.times,
        "frames": moments.frames,
        "views": [np.round(c.camera_from_world, 7).ravel().tolist() for c in moments.cameras],
        "camera": {name: getattr(moments.cameras[0], name) for name in CAMERA},
        "low_pass": moments.run.render_settings.low_pass,
        "count": len(order),
        "resting": rows,
        "moving": [len(index) for index in indices],
        "place": places.stated(),
        "scale": sizes.stated(),
        "shown": colour,
        "pivot": pivot(resting if rows else still.field, moments),
        "viridis": pictures.bar("viridis")[0].tolist(),
    }
    atomic_write(
        path, document(moments.run.path.name, about, b"".join(a.tobytes() for a in arrays))
    )


CAMERA = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Quantiser:
    """Numbers as uint16: low + step * integer, for each of C columns."""

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


def still_part(moments: Moments) -> Still:
    """Which Gaussians rest, and bounds of all places.

    Raises:
        UsageError: If the others would make the page too large.
    """
    first, seen = at_moment(moments, 0)
    seen = seen & (first.opacity >= ALPHA_MIN)
    rests, pairs = seen.clone(), 0
    low, high = (torch.full((3,), sign * torch.inf) for sign in (1.0, -1.0))
    for index in range(len(moments)):
        field, there = at_moment(moments, index)
        there = there & (field.opacity >= ALPHA_MIN)
        new = there & ~seen
        same = (field.mean == first.mean).all(dim=1) & (field.quaternion == first.quaternion).all(1)
        rests &= there & same
        first = first_seen(first, field, new)
        seen = seen | there
        low = torch.minimum(low, field.mean[there].amin(dim=0)) if there.any() else low
        high = torch.maximum(high, field.mean[there].amax(dim=0)) if there.any() else high
        pairs += int(there.sum())
    moved = pairs - len(moments) * int(rests.sum())
    size = MOVED_BYTES * moved + STILL_BYTES * int(seen.sum())
    if size > BYTES_MAX:
        times = -(-size // BYTES_MAX)
        why = f"{len(moments)} moments take {size >> 20} MB, the most is {BYTES_MAX >> 20}"
        fix = f"use --every {2 * times}, or fewer --times"
        raise UsageError("the page would be too large", where="scene.html", why=why, fix=fix)
    if not seen.any():
        why, fix = "no Gaussian is there at any of these times", "choose other --times"
        raise UsageError("nothing to show", where="scene.html", why=why, fix=fix)
    return Still(rests=rests, seen=seen, field=first, low=low.numpy(), high=high.numpy())


def first_seen(first: GaussianField, field: GaussianField, new: Bool[Tensor, "N"]) -> GaussianField:
    """The field ``first`` with the Gaussians that are ``new`` from another one."""
    for name, tensor in first.tensors().items():
        tensor[new] = field.tensors()[name][new]
    return first


def moving_parts(
    moments: Moments,
    still: Still,
    number: Int[Tensor, "N"],
    places: Quantiser,
    progress: Progress,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Index, place and turn of what does not rest, for each moment."""
    for index in range(len(moments)):
        field, there = at_moment(moments, index)
        chosen = there & still.seen & ~still.rests
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
    rgb = shade(basis, harmonics.cpu().flatten(1), channels=3).numpy()
    eight = np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8) if linear else srgb(rgb)
    opacity = (255.0 * field.opacity).round().to(torch.uint8).numpy()
    return np.concatenate([eight, opacity[:, None]], axis=1)


def pivot(field: GaussianField, moments: Moments) -> list[float]:
    """What the view turns about [m]: the middle of the picture, at the median z-depth."""
    pose = moments.cameras[0].camera_from_world
    z = field.mean.numpy() @ pose[2, :3] + pose[2, 3]
    ahead = z[z > 0]
    depth = float(np.median(ahead)) if len(ahead) else 1.0
    return (pose[:3, :3].T @ (np.array([0.0, 0.0, depth]) - pose[:3, 3])).tolist()


def document(title: str, about: dict[str, object], arrays: bytes) -> bytes:
    """The whole page; ``arrays`` as the module's text lists them."""
    data = json.dumps(about | {"arrays": base64.b64encode(arrays).decode("ascii")})
    parts = {
        "POLICY": POLICY,
        "TITLE": page.escape(title),
        "STYLE": (HERE / "scene.css").read_text(encoding="utf-8"),
        "DATA": data.replace("<", "\\u003c"),
        "SCRIPT": (HERE / "scene.js").read_text(encoding="utf-8"),
    }
    text = (HERE / "scene.html").read_text(encoding="utf-8")
    return re.sub("%([A-Z]+)%", lambda match: parts[match[1]], text).encode()
