"""What ``gftorf render`` writes: per time one EXR with the values and one PNG to look at, for each thing asked for."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ..data.files import write_json
from ..errors import UsageError
from ..recon.folder import set_aside
from ..render.api import Rendering
from ..scene.sensor import Sensor
from . import pictures

LIST = "renders.json"
LISTED = ("run", "times_s", "camera_from_world", "channels")  # its keys that say which images these are
NEEDS = {  # what may be asked for: the images of a rendering that it consists of
    "distance": ("distance", "opacity"),
    "quads": ("quads",),
    "phasor": ("phasor",),
    "colour": ("colour",),
}
WHAT = tuple(NEEDS)
Channels = dict[str, Float[np.ndarray, "H W"]]


def checked(what: str | Iterable[str]) -> tuple[str, ...]:
    """The names of what is to be rendered, each once.

    Args:
        what: Names out of distance, quads, phasor, colour; or one text with commas between them.

    Raises:
        UsageError: If a name is unknown, or there is none.
    """
    names = what.split(",") if isinstance(what, str) else what
    names = tuple(dict.fromkeys(name.strip() for name in names if name.strip()))
    unknown = [name for name in names if name not in WHAT]
    if unknown or not names:
        raise UsageError(
            f"cannot render {', '.join(map(repr, unknown)) or 'nothing'}",
            where="--what",
            why=f"expected names out of {', '.join(WHAT)}, separated by commas",
            fix="use, for example, --what distance,quads",
        )
    return names


def channels(name: str, rendering: Rendering, sensor: Sensor) -> Channels:
    """The images of one thing by channel name: what its EXR holds.

    distance: ``distance`` [m], not divided by ``opacity`` [1]. quads: ``quad_<shift in degrees>`` [file units]. phasor:
    ``re``, ``im``, ``amplitude`` [file units]. colour: ``R``, ``G``, ``B``, linear [1].

    Raises:
        UsageError: If colour is asked for and the field has none.
    """
    if name == "distance":
        names, images = ["distance", "opacity"], torch.stack([rendering.distance, rendering.opacity])
    elif name == "quads":
        names, images = [f"quad_{math.degrees(shift):03.0f}" for shift in sensor.shifts], rendering.quads
    elif name == "phasor":
        names, images = ["re", "im", "amplitude"], rendering.phasor
    elif rendering.colour is None:
        raise UsageError(
            "no colour to render",
            where="--what colour",
            why="this run was reconstructed from quads alone",
            fix="leave colour out of --what",
        )
    else:
        names, images = [*"RGB"], rendering.colour
    host = images.detach().cpu().numpy().astype(np.float32)  # one transfer, and memory of its own
    return dict(zip(names, host, strict=True))


def preview_scale(name: str, samples: Iterable[Channels]) -> pictures.Scale:
    """One scale for the previews of all times, from a few of them; for a phasor it is that of the amplitude."""
    samples = list(samples)
    if name == "distance":
        return pictures.distance_scale([sample["distance"] for sample in samples])
    if name == "quads":
        return pictures.signed_scale([image for sample in samples for image in sample.values()])
    if name == "phasor":
        return pictures.amplitude_scale([sample["amplitude"] for sample in samples])
    return pictures.Scale(low=0.0, high=1.0, colours="gray", unit="1")


def preview(name: str, images: Channels, scale: pictures.Scale) -> UInt8[np.ndarray, "H w 3"]:
    """A picture of one thing: distance; the quads in a row; phase and amplitude in a row; or sRGB."""
    if name == "distance":
        return pictures.colour_mapped(images["distance"], scale)
    if name == "quads":
        return pictures.side_by_side([pictures.colour_mapped(image, scale) for image in images.values()])
    if name == "phasor":
        phase = np.arctan2(images["im"], images["re"]) % (2.0 * np.pi)
        return pictures.side_by_side(
            [
                pictures.colour_mapped(phase, pictures.phase_scale()),
                pictures.colour_mapped(images["amplitude"], scale),
            ]
        )
    return srgb(np.stack(list(images.values()), axis=-1))


def paths(out: Path, name: str, index: int) -> tuple[Path, Path]:
    """Where the EXR and the PNG of one thing at the index-th time belong."""
    return out / name / f"{index:06d}.exr", out / name / f"{index:06d}.png"


def make_room(out: Path, listed: Mapping[str, object], *, fresh: bool) -> None:
    """Make a folder ready for images and list them in its ``renders.json``.

    Args:
        out: New, empty, or one that holds images of the same run, times, poses and channels, which are written again.
        listed: What will be in the folder.
        fresh: Whether to move other images aside, to ``out/old-<k>``.

    Raises:
        UsageError: If it holds other images, and ``fresh`` is not set, or anything else.
    """
    if out.exists() and not out.is_dir():
        raise UsageError("not a folder", where=out, why="--out names a file", fix="choose another --out")
    held = [path for path in out.iterdir() if not path.name.startswith("old-")] if out.exists() else []
    if held and not _same(out / LIST, listed):
        ours = (out / LIST).is_file()
        if not (fresh and ours):
            raise UsageError(
                "the folder is not empty",
                where=out,
                why="it holds images of another run, or other times or poses"
                if ours
                else f"it has no {LIST}: these are no images",
                fix="choose another --out" + (", or --fresh, which moves what is there aside" if ours else ""),
            )
        set_aside(out, held)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / LIST, listed)


def _same(path: Path, listed: Mapping[str, object]) -> bool:
    """Whether an earlier list names the same run, times, poses and channels."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and all(found.get(key) == listed.get(key) for key in LISTED)


def srgb(linear: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit sRGB of linear RGB (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)
