"""``scene.html``: one offline page in which the splats move, with a time slider.

The page holds a JSON object with times, cameras, and the arrays of scene_arrays.py in base64;
scene.js draws them by WebGL 2.
"""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..data.files import atomic_write
from ..evaluate import page, pictures
from .moments import Moments, Progress
from .scene_arrays import packed

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
CAMERA = ("width", "height", "fx", "fy", "cx", "cy")  # of the sequence, which the page states
HERE = Path(__file__).parent


def write(moments: Moments, path: Path, progress: Progress, *, colour: str) -> None:
    """Write the page.

    Raises:
        UsageError: If the page would be too large, or show nothing.
    """
    scene, cameras = packed(moments, progress, colour), moments.cameras
    about = {
        **scene.sizes,
        "times": moments.times,
        "frames": moments.frames,
        "views": [np.round(one.camera_from_world, 7).ravel().tolist() for one in cameras],
        "camera": {name: getattr(cameras[0], name) for name in CAMERA},
        "low_pass": moments.run.render_settings.low_pass,
        "shown": colour,
        "pivot": pivot(scene.centre, cameras[0].camera_from_world),
        "viridis": pictures.bar("viridis")[0].tolist(),
        "arrays": base64.b64encode(scene.arrays).decode("ascii"),
    }
    atomic_write(path, document(moments.run.path.name, about))


def pivot(centre: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"]) -> list[float]:
    """What the view turns about [m]: the middle of the picture, at the median z-depth."""
    z = centre @ pose[2, :3] + pose[2, 3]
    ahead = z[z > 0]
    depth = float(np.median(ahead)) if len(ahead) else 1.0
    return (pose[:3, :3].T @ (np.array([0.0, 0.0, depth]) - pose[:3, 3])).tolist()


def document(title: str, about: dict[str, object]) -> bytes:
    """The whole page around what it shows."""
    parts = {
        "POLICY": POLICY,
        "TITLE": page.escape(title),
        "STYLE": (HERE / "scene.css").read_text(encoding="utf-8"),
        "DATA": json.dumps(about).replace("<", "\\u003c"),
        "SCRIPT": (HERE / "scene.js").read_text(encoding="utf-8"),
    }
    text = (HERE / "scene.html").read_text(encoding="utf-8")
    return re.sub("%([A-Z]+)%", lambda match: parts[match[1]], text).encode()
