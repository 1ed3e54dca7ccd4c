"""Cameras of each time as COLMAP, nerfstudio and the TUM benchmark write them.

COLMAP and nerfstudio also get a picture per time, sRGB of the colour or grey of the reflectivity,
so that their folders can be opened and trained on; COLMAP also points of the first time. Pixels
count from their corners in both, as here.
"""

from __future__ import annotations

import json
from dataclasses import astuple
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.files import atomic_write, write_through
from ..data.images import png_bytes
from ..scene.camera import Camera
from .moments import Moments, Progress
from .points import Pixels, pixels, world_points

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes: x right, y up, z backward
POINTS_MAX = 20_000  # of points3D.txt: programs start from a few thousand
CAMERA_ID = 1


def write_colmap(moments: Moments, folder: Path, progress: Progress, *, colour: str) -> None:
    """Fill a folder with images/, sparse/0/cameras.txt, images.txt and points3D.txt, as text."""
    first = write_pictures(moments, folder, progress, colour)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points, here none"]
    for index, camera in enumerate(moments.cameras):
        numbers = [*quaternion(camera.camera_from_world), *camera.camera_from_world[:3, 3]]
        name = moments.path(folder, index, "png").name
        lines += [f"{index + 1} {_text(numbers)} {CAMERA_ID} {name}", ""]
    contents = {
        "cameras.txt": [f"# {', '.join(moments.about(0)[-2:])}", colmap_camera(moments.cameras[0])],
        "images.txt": lines,
        "points3D.txt": colmap_points(first, moments.cameras[0]),
    }
    for name, content in contents.items():
        write_through(sparse / name, ("\n".join(content) + "\n").encode())


def write_nerfstudio(moments: Moments, folder: Path, progress: Progress, *, colour: str) -> None:
    """Fill a folder with images/ and transforms.json, whose frames also have time_s [s]."""
    write_pictures(moments, folder, progress, colour)
    camera = moments.cameras[0]
    frames = [
        {
            "file_path": f"images/{moments.path(folder, index, 'png').name}",
            "transform_matrix": (np.linalg.inv(camera.camera_from_world) @ FLIP).tolist(),
            "time_s": time,
        }
        for index, (camera, time) in enumerate(zip(moments.cameras, moments.times, strict=True))
    ]
    k1, k2, p1, p2, k3 = astuple(camera.distortion)
    stated = {
        "camera_model": "OPENCV",
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
        **{"cx": camera.cx, "cy": camera.cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3},
        "frames": frames,
    }
    write_through(folder / "transforms.json", json.dumps(stated, indent=1).encode())


def write_tum(moments: Moments, path: Path, progress: Progress) -> None:
    """Write a trajectory, camera to world: a line ``time tx ty tz qx qy qz qw`` per time."""
    lines = ["# time_s tx ty tz qx qy qz qw, camera to world, metres"]
    for time, camera in zip(moments.times, moments.cameras, strict=True):
        w, *xyz = quaternion(np.linalg.inv(camera.camera_from_world))
        lines.append(f"{time:.9f} {_text([*camera.centre, *xyz, w])}")
    atomic_write(path, ("\n".join(lines) + "\n").encode())
    progress(len(moments), len(moments))


def write_pictures(moments: Moments, folder: Path, progress: Progress, colour: str) -> Pixels:
    """Fill ``folder``/images with a PNG per time; what the first time shows."""
    images = folder / "images"
    images.mkdir()
    first = None
    for index, rendered in enumerate(pixels(moments, colour)):
        first = first or rendered
        write_through(moments.path(images, index, "png"), png_bytes(rendered.rgb))
        progress(index + 1, len(moments))
    assert first is not None, "there is no export of no time"
    return first


def colmap_camera(camera: Camera) -> str:
    """A line of cameras.txt: the simplest of COLMAP's models that has the lens."""
    k1, k2, p1, p2, k3 = astuple(camera.distortion)
    pinhole = [camera.fx, camera.fy, camera.cx, camera.cy]
    model, numbers = "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    if not camera.distortion:
        model, numbers = "PINHOLE", pinhole
    elif not k3:
        model, numbers = "OPENCV", [*pinhole, k1, k2, p1, p2]
    return f"{CAMERA_ID} {model} {camera.width} {camera.height} {_text(numbers)}"


def colmap_points(rendered: Pixels, camera: Camera) -> list[str]:
    """Lines of points3D.txt, of evenly chosen pixels; no image is said to see a point."""
    points = world_points(rendered.distance, camera, rendered.seen).T
    every = -(-len(points) // POINTS_MAX) or 1
    rows = zip(points[::every], rendered.rgb[rendered.seen][::every], strict=True)
    lines = [f"{n} {_text(point)} {r} {g} {b} 0" for n, (point, (r, g, b)) in enumerate(rows, 1)]
    return ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", *lines]


def quaternion(pose: Float[np.ndarray, "4 4"]) -> list[float]:
    """The rotation of a pose as a unit quaternion wxyz."""
    import cv2

    turn = cv2.Rodrigues(np.ascontiguousarray(pose[:3, :3]))[0][:, 0]
    half = 0.5 * float(np.linalg.norm(turn))
    axis = 0.5 * np.sinc(half / np.pi) * turn  # sin(half) / half is 1 without a turn
    return [float(np.cos(half)), *axis.tolist()]


def _text(numbers: list[float] | Float[np.ndarray, "n"]) -> str:
    return " ".join(f"{float(number):.12g}" for number in numbers)
