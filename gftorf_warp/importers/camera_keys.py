"""Keys of the ToF camera's lens, and the intrinsics they give."""

from __future__ import annotations

from ..data.calibration import FOCAL_MIN
from ..data.sequence import Intrinsics
from .imported import Notes
from .keys import Key, Settings

PINHOLE = {
    "fx": ("focal length, x [px]", 280.0),
    "fy": ("focal length, y [px]", 280.0),
    "cx": ("principal point, x [px]", 159.5),
    "cy": ("principal point, y [px]", 119.5),
}


def camera_keys(table: str, who: str, *, needed: bool) -> tuple[Key, ...]:
    """Keys of the lens of a camera in a table; ``needed``: whether somebody has to give them."""
    single = tuple(
        Key(
            name=f"{table}.{name}",
            kind=float,
            about=f"{about}, {who}",
            example=example,
            needed=needed,
        )
        for name, (about, example) in PINHOLE.items()
    )
    centre = "where the centre of the first pixel is: integer, at 0 (OpenCV), or half, at 0.5"
    return (
        *single,
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
    settings: Settings, notes: Notes, width: int, table: str = "camera"
) -> Intrinsics:
    """Intrinsics of a camera whose images have ``width`` columns, pixel centres at i + 0.5.

    Raises:
        UsageError, InputError: If keys are missing, or the focal length is not in pixels.
    """
    fx, fy, cx, cy = (settings[f"{table}.{name}"] for name in PINHOLE)
    if min(fx, fy) < FOCAL_MIN * width:
        why = f"expected pixels, at least {FOCAL_MIN} of the width {width}, found {fx:g}, {fy:g}"
        raise settings.wrong(f"{table}.fx", why, "give pixels, not millimetres or widths")
    integer = settings[f"{table}.pixel_centre"] == "integer"
    moved = "+ 0.5, since its pixel centres are integer" if integer else "as given, pixels from 0.5"
    notes.understood.append(
        f"{table}: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} px; cx, cy {moved} "
        f"({settings.source(f'{table}.pixel_centre')})"
    )
    half = 0.5 if integer else 0.0
    lens = settings[f"{table}.distortion"]
    return Intrinsics(fx=fx, fy=fy, cx=cx + half, cy=cy + half, distortion=lens)
