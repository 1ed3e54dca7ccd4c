"""``gftorf export``: which formats there are, and where their files go."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from ..data import resources
from ..data.files import as_errors, atomic_folder
from ..data.resources import Exported
from ..errors import UsageError
from ..recon.joined import refused
from ..recon.run import Run
from ..scene.windows import Windows
from . import cameras, film, images, listed, mesh, points, scene_page, splats
from .moments import Moments, Progress

LOG = logging.getLogger("gftorf_warp")
COLOURS = ("colour", "reflectivity")


class Format(NamedTuple):
    """A kind of files."""

    target: str
    """Folder or file below the output folder."""
    write: Callable[..., Any]
    """Fills the new folder, or makes the file: called with moments, path and progress."""
    needs: Exported
    """Memory and disk, at least."""
    coloured: bool = False
    """Whether it also takes ``colour``."""
    of_gaussians: bool = False
    """Whether a run without Gaussians has nothing to write."""


SPLATS = Exported(of_gaussian=500.0, file=500.0, file_of_gaussian=68.0)  # 17 numbers
PAGE = Exported(of_gaussian=500.0)
POINTS = Exported(of_pixel=400.0, file=500.0, file_of_pixel=10.0)  # 23 B, of half the pixels
MESH = Exported(of_pixel=150.0, file=1e5)
EXRS = Exported(of_pixel=150.0, file=1e3, file_of_pixel=4.5)  # three channels, compressed
NPZS = Exported(of_pixel=250.0, file=1e3, file_of_pixel=12.0)
PICTURES = Exported(of_pixel=300.0, file=100.0, file_of_pixel=0.5)
FILM = Exported(of_pixel=500.0)
FORMATS = {
    "ply": Format("ply", splats.write, SPLATS, coloured=True, of_gaussians=True),
    "points": Format("points", points.write, POINTS, coloured=True),
    "mesh": Format("mesh", functools.partial(mesh.write, kind="ply"), MESH),
    "obj": Format("obj", functools.partial(mesh.write, kind="obj"), MESH),
    "exr": Format("exr", images.write_exrs, EXRS),
    "npz": Format("npz", images.write_npzs, NPZS),
    "colmap": Format("colmap", cameras.write_colmap, PICTURES, coloured=True),
    "nerfstudio": Format("nerfstudio", cameras.write_nerfstudio, PICTURES, coloured=True),
    "tum": Format("poses.txt", cameras.write_tum, Exported(file=10.0)),
    "html": Format("scene.html", scene_page.write, PAGE, coloured=True, of_gaussians=True),
    **{kind: Format(f"video.{kind}", film.write, FILM) for kind in ("webm", "mp4", "gif", "webp")},
}
"""Their needs are slopes of measured peaks, see design/resources.md."""


def export(
    run: Run,
    out: str | Path,
    formats: str | Iterable[str] = ("ply",),
    *,
    times: Iterable[float] | None = None,
    every: int = 1,
    colour: str | None = None,
    fresh: bool = False,
    progress: Callable[[str], Progress] | None = None,
) -> list[Path]:
    """Write a finished run in the formats of other programs, see docs/export.md.

    The same call writes what is missing: formats that it has finished are left as they are.

    Args:
        run: A finished reconstruction whose sequence can be read.
        out: Folder, made if absent. Each format has a folder or file of its own in it, which
            appears when it is complete, and ``export.json`` says what each was made of.
        formats: Names out of ``FORMATS``, or one text, separated by commas.
        times: Seconds since raw frame 0; None: all instants of the sequence.
        every: Every n-th instant of the sequence.
        colour: What splats and points are coloured by: ``colour`` or ``reflectivity``; None: the
            first of the two that the run has.
        fresh: Whether to move what an earlier export wrote to ``out/old-<k>``.
        progress: Makes a function of (done, in all) for a format.

    Returns:
        The folder or file of each format.

    Raises:
        UsageError: If a format or colour is unknown, the run lacks it, or files exist that were
            made of something else.
        InputError: If the sequence cannot be read.
        ResourceError: If memory or disk cannot hold the files.
    """
    names, out = checked(formats), Path(out)
    if colour is not None and colour not in COLOURS:
        why = f"expected {' or '.join(COLOURS)}"
        raise UsageError(f"unknown colour {colour!r}", where="--colour", why=why, fix=why)
    moments = Moments.of(run, times, every)
    shown = colour or COLOURS[0 if moments.run.has_colour else 1]
    check_content(moments, names, shown)
    targets = {out / FORMATS[name].target: name for name in names}
    descriptions = {
        target: listed.described(moments, shown if FORMATS[name].coloured else None)
        for target, name in targets.items()
    }
    missing = [name for target, name in targets.items() if fresh or not target.exists()]
    check_resources(moments, missing, out)
    remaining = listed.remaining(out, descriptions, fresh=fresh)
    for target in (target for target in targets if target not in remaining):
        LOG.info("%s is finished", target)
    for target in remaining:
        kind = FORMATS[targets[target]]
        write = functools.partial(kind.write, **{"colour": shown} if kind.coloured else {})
        step = progress(targets[target]) if progress else lambda *_: None
        if target.suffix:
            with as_errors(out):
                out.mkdir(parents=True, exist_ok=True)
            listed.record(target, descriptions[target])
            write(moments, target, step)
        else:
            with atomic_folder(target) as folder:
                write(moments, folder, step)
                listed.record(target, descriptions[target])
    return [*targets]


def checked(formats: str | Iterable[str]) -> list[str]:
    """Valid names without repetition.

    Raises:
        UsageError: If a name is unknown, or there is none.
    """
    words = formats.split(",") if isinstance(formats, str) else formats
    names = [*dict.fromkeys(word.strip() for word in words if word.strip())]
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        what = f"cannot export {', '.join(map(repr, unknown)) or 'nothing'}"
        why = f"expected formats out of {', '.join(FORMATS)}, separated by commas"
        raise UsageError(what, where="--format", why=why, fix="use, for example, --format ply")
    return names


def check_content(moments: Moments, names: Iterable[str], colour: str) -> None:
    """Whether the run has what formats and colour need.

    Raises:
        UsageError: If not.
    """
    run = moments.run
    lacking = [name for name in names if FORMATS[name].of_gaussians]
    if lacking and run.config.get("windows"):
        raise refused(run.path)
    if lacking and not len(run.field):
        why = f"its method {run.config['settings'].get('method')} fits none"
        fix = f"leave {', '.join(lacking)} out: points, mesh and images need none"
        raise UsageError("no Gaussians to export", where=run.path, why=why, fix=fix)
    if colour == "colour" and not moments.run.has_colour:
        why, fix = "this run was reconstructed from quads alone", "use --colour reflectivity"
        raise UsageError("no colour to export", where="--colour", why=why, fix=fix)


def check_resources(moments: Moments, names: Iterable[str], out: Path) -> None:
    """Whether memory and disk can hold the files of some formats.

    Raises:
        ResourceError: If not.
    """
    run, camera = moments.run, moments.cameras[0]
    layer = run.field.layer if isinstance(run.motion, Windows) else None
    always = len(run.field) if layer is None else int((layer == 0).sum())
    size = len(moments), camera.width * camera.height, always
    need = resources.to_export([FORMATS[name].needs for name in names], *size)
    resources.require(need, out, "write fewer moments, --every 4 or --times, or fewer formats")
