"""Distance, z-depth, opacity and colour of each time, as OpenEXR or as NumPy archives.

distance      along the ray [m], as rendered: not divided by the opacity
opacity       [1]
source        where the distance is from, if the run has the setting ``fallback``
Z, z_depth    third camera coordinate of the point at that distance [m]
R G B, colour linear, if the run has colour
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.exr import write_exr
from ..data.files import many_files, write_through
from ..evaluate.previews import with_units
from ..evaluate.views import labels_of
from ..scene.camera import Camera
from .moments import Moments, Progress

RENDERED = ("distance", "opacity", "source", "colour")


def write_exrs(moments: Moments, folder: Path, progress: Progress) -> None:
    """Fill a folder with one EXR file per time, float32, whose header has its time and camera."""
    taken = zip(moments.times, moments.cameras, strict=True)
    labels = labels_of(taken, moments.run.sequence(), plain=True)
    with many_files(folder):
        for index, images in enumerate(at_moments(moments)):
            channels = {"Z" if name == "z_depth" else name: image for name, image in images.items()}
            if "colour" in channels:
                channels |= dict(zip("RGB", channels.pop("colour"), strict=True))
            attributes = with_units(labels[index].attributes, channels)
            path = moments.path(folder, index, "exr")
            write_exr(path, channels, attributes=attributes, one_of=True)
            progress(index + 1, len(moments))


def write_npzs(moments: Moments, folder: Path, progress: Progress) -> None:
    """Fill a folder with one NPZ file per time: the images, and what is known about them.

    Also in it: time_s [s], raw_frame if the time is that of one, camera_from_world [4, 4] [m],
    intrinsics [3, 3] [px], and distortion [5] in the order of OpenCV.
    """
    for index, images in enumerate(at_moments(moments)):
        frame, camera = moments.frames[index], moments.cameras[index]
        known: dict[str, np.ndarray] = {"time_s": np.array(moments.times[index])}
        known |= {} if frame is None else {"raw_frame": np.array(frame)}
        known["camera_from_world"] = camera.camera_from_world
        known["intrinsics"] = intrinsics(camera)
        known["distortion"] = np.array(astuple(camera.distortion))
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **images, **known)
        write_through(moments.path(folder, index, "npz"), buffer.getbuffer())
        progress(index + 1, len(moments))


def at_moments(moments: Moments) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
    """Images by name in the order of the times, float32: [H, W], colour [3, H, W]."""
    pairs = zip(moments.images(RENDERED), moments.cameras, strict=True)
    for images, camera in pairs:
        yield images | {"z_depth": z_depth(images["distance"], camera)}


def z_depth(distance: Float[np.ndarray, "H W"], camera: Camera) -> Float[np.ndarray, "H W"]:
    """Third camera coordinate [m] at a distance along the ray through each pixel centre [m]."""
    return (distance * camera.directions()[..., 2].numpy()).astype(np.float32)


def intrinsics(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Matrix of focal lengths and principal point [px]; pixel [0, 0] is centred at (0.5, 0.5)."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=float)
