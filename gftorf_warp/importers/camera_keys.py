"""Keys of the ToF camera's lens, and the intrinsics they give."""

from __future__ import annotations

from pathlib import Path

from ..data.calibration import FOCAL_MIN
from ..data.sequence import Intrinsics
from .imported import Notes
from .keys import Key, Settings
from .lens_files import Lens, read_lens

PINHOLE = {
    "fx": ("focal length, x [px]", 280.0),
    "fy": ("focal length, y [px]", 280.0),
    "cx": ("principal point, x [px]", 159.5),
    "cy": ("principal point, y [px]", 119.5),
}


def camera_keys(table: str, who: str, *, needed: bool) -> tuple[Key, ...]:
    """Keys of the lens of a camera in a table; ``needed``: whether they are required."""
    single = tuple(
        Key(
            name=f"{table}.{name}",
            kind=float,
            about=f"{about}, {who}",
            example=example,
            needed=needed,
            unless=(f"{table}.file",),
        )
        for name, (about, example) in PINHOLE.items()
    )
    centre = "where the centre of the first pixel is: integer, at 0 (OpenCV), or half, at 0.5"
    return (
        *single,
        Key(
            name=f"{table}.file",
            kind=str,
            about="lens in a file: of OpenCV (.yaml, .xml, .json), cameras.txt of COLMAP, "
            "transforms.json of nerfstudio",
            example="calibration.yaml",
        ),
        Key(
            name=f"{table}.number",
            kind=int,
            about="camera of a cameras.txt with several",
            example=1,
        ),
        Key(
            name=f"{table}.pixel_centre",
            kind=str,
            about=centre,
            example="integer",
            default="integer",
            choices=("integer", "half"),
        ),
        Key(
            name=f"{table}.distortion",
            kind=float,
            about="k1, k2, p1, p2, k3 of the lens in OpenCV's model",
            example=(0.1, -0.02, 0.0, 0.0, 0.0),
            shape=(5,),
        ),
    )


KEYS = camera_keys("camera", "ToF camera", needed=True)


def intrinsics_of(
    settings: Settings,
    notes: Notes,
    width: int,
    table: str = "camera",
    *,
    root: Path | None = None,
    height: int | None = None,
) -> Intrinsics:
    """Intrinsics of a camera whose images have ``width`` columns, pixel centres at i + 0.5.

    Args:
        settings: Values of :func:`camera_keys`.
        notes: What was understood is added.
        width: Columns of the images.
        table: Table of the keys.
        root: The recording, where a file of the lens may be; None: beside the TOML file only.
        height: Rows of the images, compared with those in a file of the lens; None: not compared.

    Raises:
        UsageError, InputError: If keys are missing or contradict a file, the file is unusable, or
            the focal length is not in pixels.
    """
    lens = _lens_of_file(settings, notes, table, root, (width, height))
    values = (
        {name: settings[f"{table}.{name}"] for name in PINHOLE} if lens is None else lens.values
    )
    fx, fy, cx, cy = (values[name] for name in PINHOLE)
    if min(fx, fy) < FOCAL_MIN * width:
        why = f"expected pixels, at least {FOCAL_MIN} of the width {width}, found {fx:g}, {fy:g}"
        raise settings.wrong(f"{table}.fx", why, "give pixels, not millimetres or widths")
    centre, source = settings[f"{table}.pixel_centre"], settings.source(f"{table}.pixel_centre")
    if lens is not None and not settings.given(f"{table}.pixel_centre"):
        centre, source = lens.pixel_centre, lens.form
    integer = centre == "integer"
    moved = "+ 0.5, since its pixel centres are integer" if integer else "as given, pixels from 0.5"
    notes.understood.append(
        f"{table}: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} px; cx, cy {moved} ({source})"
    )
    half = 0.5 if integer else 0.0
    distortion = settings[f"{table}.distortion"] if lens is None else lens.distortion
    return Intrinsics(fx=fx, fy=fy, cx=cx + half, cy=cy + half, distortion=distortion)


def _lens_of_file(
    settings: Settings,
    notes: Notes,
    table: str,
    root: Path | None,
    size: tuple[int, int | None],
) -> Lens | None:
    """The lens in the file that the keys name, of images of a size (columns, rows); None without.

    Raises:
        InputError: If keys state the lens as well, or it belongs to images of another size.
    """
    name = f"{table}.file"
    path = settings.file(name, root)
    if path is None:
        return None
    both = [key for key in (*PINHOLE, "distortion") if settings.given(f"{table}.{key}")]
    if both:
        why = f"{path.name} and {', '.join(both)} both state the lens"
        raise settings.wrong(name, why, "keep one of them")
    lens = read_lens(path, settings[f"{table}.number"])
    if lens.size is not None and lens.size != (size[0], size[1] or lens.size[1]):
        why = (
            f"{path.name} belongs to images of {lens.size[0]}x{lens.size[1]}, these have {size[0]}"
        )
        fix = "calibrate at that size, or give fx, fy, cx, cy"
        raise settings.wrong(name, f"{why} columns, {size[1]} rows", fix)
    if lens.note:
        notes.uncertain.append(f"{path.name}: {lens.note}")
    notes.understood.append(
        f"{table}: lens of {path.name}, {lens.form}, {lens.distortion or 'pinhole'}"
    )
    return lens
