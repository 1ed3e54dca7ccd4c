"""Point clouds as PLY files, one per time: a point for each pixel that is mostly opaque.

x y z            in the world [m], at the distance over opacity
red green blue   sRGB of the colour, or the grey of the reflectivity
distance         along the ray [m], over opacity
reflectivity     amplitude over the fall-off, in the units of the sequence's quads [m^2]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..data.files import write_through
from ..evaluate.metrics import normalised
from ..evaluate.previews import srgb
from ..scene.camera import Camera
from .moments import Moments, Progress
from .ply import ply_bytes, table

OPAQUE = 0.5  # [1] least opacity: with less, most light comes from somewhere else
WHITE = 99.0  # percentile of the first image's reflectivity that is shown white
RENDERED = ("distance", "opacity", "phasor", "colour")


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels:
    """The pixels of one time."""

    rgb: UInt8[np.ndarray, "H W 3"]
    """sRGB."""
    seen: Bool[np.ndarray, "H W"]
    """Those that are mostly opaque."""
    distance: Float[np.ndarray, "H W"]
    """Along the ray over opacity [m]."""
    reflectivity: Float[np.ndarray, "H W"]
    """Amplitude over the fall-off [quad units m^2]."""


def write(moments: Moments, folder: Path, progress: Progress, *, colour: str) -> None:
    """Fill a folder with one PLY file per time."""
    for index, rendered in enumerate(pixels(moments, colour)):
        points = world_points(rendered.distance, moments.cameras[index], rendered.seen)
        columns = dict(zip("xyz", points, strict=True))
        columns |= dict(zip(("red", "green", "blue"), rendered.rgb[rendered.seen].T, strict=True))
        columns |= {n: getattr(rendered, n)[rendered.seen] for n in ("distance", "reflectivity")}
        data = ply_bytes(table(columns), [*moments.about(index), f"red, green, blue: {colour}"])
        write_through(moments.path(folder, index, "ply"), data)
        progress(index + 1, len(moments))


def pixels(moments: Moments, colour: str) -> Iterator[Pixels]:
    """What the camera of each time sees, in colour or as the grey of the reflectivity."""
    white = None
    for images in moments.images(RENDERED):
        seen = images["opacity"] >= OPAQUE
        distance = normalised(images["distance"], images["opacity"])
        amplitude = 0.5 * normalised(images["phasor"][2], images["opacity"])
        reflectivity = amplitude * distance**2
        if white is None:
            white = float(np.percentile(reflectivity[seen], WHITE)) if seen.any() else 1.0
        shown = grey(reflectivity, white)
        if colour == "colour":
            shown = srgb(images["colour"].transpose(1, 2, 0))
        yield Pixels(rgb=shown, seen=seen, distance=distance, reflectivity=reflectivity)


def world_points(
    distance: Float[np.ndarray, "H W"], camera: Camera, seen: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "3 P"]:
    """Points in the world [m] at distances [m] along the rays of the chosen pixels."""
    rays = camera.rays().numpy()[seen]
    return (camera.centre + distance[seen][:, None] * rays).T


def grey(image: Float[np.ndarray, "H W"], white: float) -> UInt8[np.ndarray, "H W 3"]:
    """SRGB of an image whose value ``white`` is white."""
    return srgb(np.repeat((image / white if white > 0 else image)[..., None], 3, axis=-1))
