"""The EXR and PNG files of ``gftorf render``; previews of one kind share one scale."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from ..data.exr import write_exr
from ..data.files import write_one_of_many
from ..data.images import indexed_png_bytes, png_bytes
from . import pictures

Channels = dict[str, Float[np.ndarray, "H W"]]
DISTANCES = "distance", "distance_median"


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


def preview(name: str, images: Channels, scale: pictures.Scale) -> bytes:
    """A PNG file: distance; quads in a row; phase and amplitude in a row; or sRGB."""
    if name in DISTANCES:
        return indexed_png_bytes(pictures.ticks(images[name], scale), pictures.palette(scale))
    if name == "quads":
        ticks = [pictures.ticks(image, scale) for image in images.values()]
        row = pictures.ticks_side_by_side(ticks)
        return indexed_png_bytes(row, pictures.palette(scale))
    if name == "phasor":
        phase = np.arctan2(images["im"], images["re"]) % (2.0 * np.pi)
        turns = pictures.colour_mapped(phase, pictures.phase_scale())
        amplitude = pictures.colour_mapped(images["amplitude"], scale)
        return png_bytes(pictures.side_by_side([turns, amplitude]))
    return png_bytes(srgb(np.stack(list(images.values()), axis=-1)))


def paths(out: Path, name: str, index: int) -> tuple[Path, Path]:
    """Paths of the EXR and the PNG of one kind at the index-th time."""
    return out / name / f"{index:06d}.exr", out / name / f"{index:06d}.png"


def write_images(
    out: Path, scales: Mapping[str, pictures.Scale], index: int, images: Mapping[str, Channels]
) -> None:
    """Write an EXR and a PNG of each kind at the index-th time, inside :func:`many_files`."""
    for name, channels in images.items():
        exr, png = paths(out, name, index)
        write_exr(exr, channels, one_of=True)
        write_one_of_many(png, preview(name, channels, scales[name]))


def srgb(linear: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit sRGB of linear RGB (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)
