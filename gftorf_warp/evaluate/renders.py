"""What ``gftorf render`` may be asked for, which images that takes, and the folder it goes to."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ..data.files import write_json
from ..errors import UsageError
from ..recon.folder import set_aside
from ..render.api import Rendering
from ..scene.sensor import Sensor
from .previews import Channels

LIST = "renders.json"
LISTED = ("run", "times_s", "camera_from_world", "channels", "arrays")  # its keys that say which images these are
NEEDS = {  # what may be asked for: the images of a rendering that it consists of
    "distance": ("distance", "opacity"),
    "quads": ("quads",),
    "phasor": ("phasor",),
    "colour": ("colour",),
}
WHAT = tuple(NEEDS)


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
    """The images of one thing by channel name, see :func:`named`, of a rendering wherever it is.

    Raises:
        UsageError: If colour is asked for and the field has none.
    """
    given = [getattr(rendering, image) for image in NEEDS[name]]
    if given[0] is None:
        return named(name, {}, sensor)
    images = torch.stack(given) if len(given) > 1 else given[0]
    host = images.detach().cpu().numpy().astype(np.float32)  # one transfer, and memory of its own
    return named(name, dict(zip(NEEDS[name], host if len(given) > 1 else [host], strict=True)), sensor)


def named(name: str, images: Mapping[str, Float[np.ndarray, "..."]], sensor: Sensor) -> Channels:
    """The images of one thing by channel name: what its EXR holds.

    distance: ``distance`` [m], not divided by ``opacity`` [1]. quads: ``quad_<shift in degrees>`` [file units]. phasor:
    ``re``, ``im``, ``amplitude`` [file units]. colour: ``R``, ``G``, ``B``, linear [1].

    Args:
        name: Of the thing.
        images: What it consists of, by name, and perhaps more.
        sensor: Whose shifts the quads have.

    Raises:
        UsageError: If colour is asked for and there is none.
    """
    if name == "colour" and "colour" not in images:
        raise UsageError(
            "no colour to render",
            where="--what colour",
            why="this run was reconstructed from quads alone",
            fix="leave colour out of --what",
        )
    if name == "distance":
        return {image: images[image] for image in NEEDS[name]}
    quads = [f"quad_{math.degrees(shift):03.0f}" for shift in sensor.shifts]
    names = {"quads": quads, "phasor": ["re", "im", "amplitude"], "colour": [*"RGB"]}[name]
    return dict(zip(names, images[name], strict=True))


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
