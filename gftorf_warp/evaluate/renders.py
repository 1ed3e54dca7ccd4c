"""The options of ``gftorf render``: names of images, their channels, and the output folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..data.files import write_json
from ..data.texts import read_json
from ..errors import InputError, UsageError
from ..recon.folder import set_aside
from ..scene.sensor import Sensor
from .previews import Channels

LIST = "renders.json"
# its keys that identify the images
LISTED = ("run", "times_s", "camera_from_world", "channels", "arrays")
NEEDS = {  # images of a rendering, by option
    "distance": ("distance", "opacity", "source"),
    "distance_median": ("distance_median",),
    "quads": ("quads",),
    "phasor": ("phasor",),
    "colour": ("colour",),
}
WHAT = tuple(NEEDS)


def checked(what: str | Iterable[str]) -> tuple[str, ...]:
    """Valid names without repetition.

    Args:
        what: Names out of distance, distance_median, quads, phasor, colour; or one text, separated
            by commas.

    Raises:
        UsageError: If a name is unknown, or there is none.
    """
    names = what.split(",") if isinstance(what, str) else what
    names = tuple(dict.fromkeys(name.strip() for name in names if name.strip()))
    unknown = [name for name in names if name not in WHAT]
    if unknown or not names:
        what = f"cannot render {', '.join(map(repr, unknown)) or 'nothing'}"
        why = f"expected names out of {', '.join(WHAT)}, separated by commas"
        fix = "use, for example, --what distance,quads"
        raise UsageError(what, where="--what", why=why, fix=fix)
    return names


def named(name: str, images: Mapping[str, Float[np.ndarray, "..."]], sensor: Sensor) -> Channels:
    """Images by channel name, as in an EXR file.

    distance: ``distance`` [m], not divided by ``opacity`` [1]; ``source``, if the run has one: an
    index into ``constants.SOURCES``. distance_median: the same name [m], of the fit, 0 where
    more than half of the light passes. quads: ``quad_<shift in degrees>``
    [file units]. phasor: ``re``, ``im``, ``amplitude`` [file units]. colour: ``R``, ``G``, ``B``,
    linear [1].

    Raises:
        UsageError: If colour is asked for and there is none.
    """
    if name == "colour" and "colour" not in images:
        why, fix = "this run was reconstructed from quads alone", "leave colour out of --what"
        raise UsageError("no colour to render", where="--what colour", why=why, fix=fix)
    if name in ("distance", "distance_median"):
        return {image: images[image] for image in NEEDS[name] if image in images}
    quads = [f"quad_{math.degrees(shift):03.0f}" for shift in sensor.shifts]
    names = {"quads": quads, "phasor": ["re", "im", "amplitude"], "colour": [*"RGB"]}[name]
    return dict(zip(names, images[name], strict=True))


def prepare_folder(out: Path, listed: Mapping[str, Any], *, fresh: bool) -> None:
    """Prepare an output folder and write its ``renders.json``.

    Args:
        out: New, empty, or with images of the same run, times, poses and channels, which will be
            overwritten.
        listed: Content of ``renders.json``.
        fresh: Whether to move other images to ``out/old-<k>``.

    Raises:
        UsageError: If it holds other images and ``fresh`` is not set, or other files.
    """
    fix = "choose another --out"
    if out.exists() and not out.is_dir():
        raise UsageError("not a folder", where=out, why="--out names a file", fix=fix)
    entries = out.iterdir() if out.exists() else ()
    held = [path for path in entries if not path.name.startswith("old-")]
    later = stated_images(out / LIST) > (listed.get("images_optimised") or 0)
    if held and (later or not _same(out / LIST, listed)):
        ours = (out / LIST).is_file()
        if not (fresh and ours):
            why = f"it has no {LIST}: these are no images"
            if ours:
                why = "it holds images of another run, or other times or poses"
                if later:
                    why = "it holds images of the run after more optimised images"
                fix += ", or --fresh, which moves its content aside"
            raise UsageError("the folder is not empty", where=out, why=why, fix=fix)
        set_aside(out, held)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / LIST, listed)


def stated_images(path: Path) -> int:
    """Optimised images of the run that a metrics.json or renders.json is of; 0 if unknown."""
    stated = _listed(path).get("images_optimised")
    return stated if isinstance(stated, int) else 0


def _same(path: Path, listed: Mapping[str, object]) -> bool:
    """Whether an earlier list names the same run, times, poses and channels."""
    stored = _listed(path)
    return bool(stored) and all(stored.get(key) == listed.get(key) for key in LISTED)


def _listed(path: Path) -> dict[str, Any]:
    """Content of a list; empty if there is none that can be read."""
    try:
        content = read_json(path)
    except InputError:
        return {}
    return content if isinstance(content, dict) else {}
