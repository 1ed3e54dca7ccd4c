"""Lenses in files of other programs: OpenCV and ROS calibrations, COLMAP, nerfstudio.

OpenCV counts pixels from their centres, so the centre of the first one is at 0; COLMAP and
nerfstudio from their corners, so it is at 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..data.pictures import without_log_of_opencv
from ..data.texts import read_json
from ..data.untrusted import read_text, unreadable
from .text_files import numbers, read_rows

BYTES_MAX = 1 << 20  # a calibration has some thousand, with its pictures' corners
MATRICES = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M", "M1")
LENSES = (
    *("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients"),
    *("D", "D1"),
)
# parameters of COLMAP's models in their order; those without a counterpart here must be 0
COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
NERFSTUDIO = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A lens as a file states it."""

    values: Mapping[str, float]
    """fx, fy, cx, cy [px] and k1, k2, p1, p2, k3; absent ones of these are 0."""
    size: tuple[int, int] | None
    """Columns and rows of the images it belongs to; None: not stated."""
    pixel_centre: str
    """``integer`` or ``half``: where the centre of the first pixel is."""
    form: str
    """Whose file it is."""
    note: str = ""
    """What the file does not say and was assumed; empty: nothing."""

    @property
    def distortion(self) -> tuple[float, float, float, float, float] | None:
        """k1, k2, p1, p2, k3; None for a pinhole."""
        k1, k2, p1, p2, k3 = (self.values.get(name, 0.0) for name in DISTORTION)
        return (k1, k2, p1, p2, k3) if any((k1, k2, p1, p2, k3)) else None


def read_lens(path: Path, number: int | None = None) -> Lens:
    """The lens in a file: cameras.txt of COLMAP, transforms.json of nerfstudio, else of OpenCV.

    Args:
        path: The file.
        number: Camera of a cameras.txt; None: the only one.

    Raises:
        InputError: If it is none of these, or a lens that OpenCV's five coefficients cannot
            describe.
    """
    if path.suffix.lower() == ".txt":
        return _colmap(path, number)
    if path.suffix.lower() == ".json" and "fl_x" in (content := read_object(path)):
        return _nerfstudio(path, content)
    return _opencv(path, read_text(path, BYTES_MAX))


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        InputError: If it is none.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise unreadable(path, f"expected a JSON object, found {type(content).__name__}")
    return content


def _colmap(path: Path, number: int | None) -> Lens:
    rows = read_rows(path)
    by_number = {words[0]: (line, words) for line, words in rows}
    wanted = next(iter(by_number)) if number is None else str(number)
    if wanted not in by_number or (number is None and len(by_number) > 1):
        why = f"expected {'one camera' if number is None else f'camera {number}'}, found "
        raise unreadable(path, f"{why}{', '.join(by_number)[:200]}; camera.number names one")
    line, words = by_number[wanted]
    names = COLMAP.get(words[1] if len(words) > 1 else "", "").split()
    if not names or len(words) != 4 + len(names):
        why = f"expected ID MODEL WIDTH HEIGHT PARAMETERS with a model of {', '.join(COLMAP)} in "
        raise unreadable(path, f"{why}line {line}, found {' '.join(words)[:100]!r}")
    width, height, *parameters = numbers(path, line, words[2:])
    values = dict(zip(names, parameters, strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    _refuse_others(path, values)
    size = int(width), int(height)
    return Lens(values=values, size=size, pixel_centre="half", form=f"COLMAP {words[1]}")


def _nerfstudio(path: Path, content: dict[str, Any]) -> Lens:
    model = content.get("camera_model", "OPENCV")
    keys = [*NERFSTUDIO, *DISTORTION, "k4", "k5", "k6", "w", "h"]
    stated = {key: content[key] for key in keys if key in content}
    plain = all(type(value) in (int, float) for value in stated.values())
    missing = [key for key in NERFSTUDIO if key not in stated]
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE") or not plain or missing:
        why = "expected camera_model OPENCV or PINHOLE with numbers fl_x, fl_y, cx, cy for all "
        raise unreadable(path, f"{why}images, found model {model}, without {missing}")
    values = {NERFSTUDIO.get(key, key): float(value) for key, value in stated.items()}
    w, h = values.pop("w", None), values.pop("h", None)
    size = None if w is None or h is None else (int(w), int(h))
    _refuse_others(path, values)
    return Lens(values=values, size=size, pixel_centre="half", form="nerfstudio")


def _opencv(path: Path, content: str) -> Lens:
    import cv2

    if not content.lstrip().startswith(("%YAML", "<?xml", "{")):
        content = f"%YAML:1.0\n---\n{content}"  # as ROS writes it
    try:
        with without_log_of_opencv():
            storage = cv2.FileStorage(content, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        matrix = _matrix(storage, MATRICES)
        lens = _matrix(storage, LENSES)
        sides = [storage.getNode(name).real() for name in ("image_width", "image_height")]
        storage.release()
    except (cv2.error, SystemError) as error:
        why = "expected a calibration as cv2.FileStorage writes it, found "
        raise unreadable(path, why + str(error).splitlines()[0][-200:]) from error
    if matrix is None or matrix.size != 9 or (lens is not None and lens.size > 14):
        why = f"expected a 3x3 matrix named {', '.join(MATRICES)} and up to 14 coefficients named "
        raise unreadable(path, f"{why}{', '.join(LENSES)}, found {matrix} and {lens}")
    (fx, skew, cx), (_, fy, cy), _ = matrix.reshape(3, 3).tolist()
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
    coefficients = [] if lens is None else lens.reshape(-1).tolist()
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": skew}
    values |= dict(zip(names, coefficients, strict=False))
    _refuse_others(path, values)
    note = "four distortion coefficients are taken as k1, k2, p1, p2, not as a fisheye's"
    size = (int(sides[0]), int(sides[1])) if min(sides) > 0 else None
    note = note if len(coefficients) == 4 and any(coefficients) else ""
    return Lens(values=values, size=size, pixel_centre="integer", form="OpenCV", note=note)


def _matrix(storage: Any, names: tuple[str, ...]) -> np.ndarray | None:
    """Numbers of the first matrix of these names: as many as there are, whatever its size says."""
    for name in names:
        node = storage.getNode(name)
        node = node.getNode("data") if node.isMap() else node
        if node.isSeq():
            return np.array([node.at(i).real() for i in range(node.size())])
    return None


def _refuse_others(path: Path, values: Mapping[str, float]) -> None:
    """Refuse what a pinhole with k1, k2, p1, p2, k3 cannot express, and what is no number."""
    known = {*NERFSTUDIO.values(), *DISTORTION}
    others = {name: value for name, value in values.items() if name not in known and value != 0}
    if others or not np.isfinite(list(values.values())).all():
        why = "expected a pinhole with k1, k2, p1, p2, k3, found "
        raise unreadable(path, f"{why}{others or dict(values)}; calibrate with these alone")
