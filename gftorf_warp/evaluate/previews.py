"""The EXR and PNG files of ``gftorf render``; previews of one kind share one scale.

EXR headers state time_s [s], raw_frame if the time is that of one, units by channel, and the camera
as JSON: size, fx, fy, cx, cy [px], distortion and camera_from_world [m].
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..constants import SOURCES
from ..data.exr import Attribute, write_exr
from ..data.files import write_one_of_many
from ..data.images import indexed_png_bytes, png_bytes
from . import pictures
from .captioned import Panel, captioned

Channels = dict[str, Float[np.ndarray, "H W"]]
DISTANCES = "distance", "distance_median"
TITLES = {
    "distance": "distance along the ray",
    "distance_median": "median distance along the ray",
    "quads": "quads",
    "phasor": "phasor",
    "colour": "colour",
}
UNITS = {  # of channels; those of quads and phasors have the unit of the sequence's files
    **dict.fromkeys((*DISTANCES, "Z"), "m"),
    "opacity": "1",
    "source": f"index: {', '.join(f'{k} {name}' for k, name in enumerate(SOURCES))}",
    **dict.fromkeys("RGB", "linear, of the sequence's colour images"),
}


class Label(NamedTuple):
    """What is written beside the pixels of all kinds of images at one time."""

    attributes: Mapping[str, Attribute]
    """Of EXR headers, without the units."""
    title: str | None
    """Over PNG pictures, behind the name of their kind; None: pictures without anything beside."""


NO_LABEL = Label({}, None)


def preview_scale(name: str, samples: Iterable[Channels]) -> pictures.Scale:
    """Scale of all previews of one kind, from a few samples; for a phasor, of its amplitude."""
    samples = list(samples)
    if name in DISTANCES:
        return pictures.distance_scale([sample[name] for sample in samples])
    if name == "quads":
        return pictures.signed_scale([image for sample in samples for image in sample.values()])
    if name == "phasor":
        return pictures.amplitude_scale([sample["amplitude"] for sample in samples])
    return pictures.Scale(low=0.0, high=1.0, colours="gray", unit="1")


def preview(name: str, images: Channels, scale: pictures.Scale, title: str | None = None) -> bytes:
    """A PNG file: distance; quads in a row; phase and amplitude in a row; or sRGB.

    With a title, it has a colour bar and a size that a person can see.
    """
    if title is not None:
        return png_bytes(picture({name: images}, {name: scale}, title), flat=True)
    if name in DISTANCES:
        return indexed_png_bytes(pictures.ticks(images[name], scale), pictures.palette(scale))
    if name == "quads":
        ticks = [pictures.ticks(image, scale) for image in images.values()]
        row = pictures.ticks_side_by_side(ticks)
        return indexed_png_bytes(row, pictures.palette(scale))
    return png_bytes(pictures.side_by_side([panel.image for panel in panels(name, images, scale)]))


def picture(
    images: Mapping[str, Channels], scales: Mapping[str, pictures.Scale], title: str
) -> UInt8[np.ndarray, "h w 3"]:
    """All kinds of images at one time in a row, with titles and colour bars."""
    panels_by_name = {
        name: panels(name, channels, scales[name]) for name, channels in images.items()
    }
    if len(panels_by_name) == 1:
        name, row = panels_by_name.popitem()
        return captioned(row, f"{TITLES[name]}, {title}")
    row = [
        panel._replace(title=", ".join(filter(None, [TITLES[name], panel.title])))
        for name, several in panels_by_name.items()
        for panel in several
    ]
    return captioned(row, title)


def panels(name: str, images: Channels, scale: pictures.Scale) -> list[Panel]:
    """The pictures of a kind of image, each with its title, unit and scale."""
    if name in DISTANCES:
        return [Panel(f"[{scale.unit}]", pictures.colour_mapped(images[name], scale), scale)]
    if name == "quads":
        return [
            Panel(
                f"{int(channel[-3:])}\N{DEGREE SIGN} [{scale.unit}]",
                pictures.colour_mapped(image, scale),
                scale,
            )
            for channel, image in images.items()
        ]
    if name == "phasor":
        phase = np.arctan2(images["im"], images["re"]) % (2.0 * np.pi)
        turn = pictures.phase_scale()
        amplitude = pictures.colour_mapped(images["amplitude"], scale)
        return [
            Panel(f"phase [{turn.unit}]", pictures.colour_mapped(phase, turn), turn),
            Panel(f"amplitude [{scale.unit}]", amplitude, scale),
        ]
    return [Panel("", srgb(np.stack(list(images.values()), axis=-1)), None)]


def with_units(
    attributes: Mapping[str, Attribute], channels: Iterable[str]
) -> dict[str, Attribute]:
    """Attributes of an EXR header, and the unit of each channel."""
    units = [f"{channel}: {UNITS.get(channel, 'of the sequence')}" for channel in channels]
    return {**attributes, "units": "; ".join(units)}


def paths(out: Path, name: str, index: int) -> tuple[Path, Path]:
    """Paths of the EXR and the PNG of one kind at the index-th time."""
    return out / name / f"{index:06d}.exr", out / name / f"{index:06d}.png"


def write_images(
    out: Path,
    scales: Mapping[str, pictures.Scale],
    index: int,
    images: Mapping[str, Channels],
    labels: Sequence[Label] = (),
) -> None:
    """Write an EXR and a PNG of each kind at the index-th time, inside :func:`many_files`."""
    attributes, title = labels[index] if labels else NO_LABEL
    for name, channels in images.items():
        exr, png = paths(out, name, index)
        write_exr(exr, channels, attributes=with_units(attributes, channels), one_of=True)
        write_one_of_many(png, preview(name, channels, scales[name], title))


def srgb(linear: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit sRGB of linear RGB (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)
