"""A finished run whose errors are known beforehand: a box slides past a wall,
and both are rendered a little wrong.
"""

import json
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from sequences import changed, sequence_of

from gftorf_warp import Sequence, Truth
from gftorf_warp.constants import CANONICAL_SHIFTS, FRAME_RATE_HZ
from gftorf_warp.data.write import write
from gftorf_warp.recon.residuals import residuals
from gftorf_warp.render.api import Rendering
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor

HEIGHT, WIDTH, FRAMES = 12, 20, 14  # three complete quartets, and a truncated one
WALL, BOX = 4.0, 2.5  # [m]
COLOUR_ERROR = 0.05  # of every channel, in units of the colour images
# [m] of the mean distance, and of what the quads encode
WALL_ERROR, BOX_ERROR, QUAD_ERROR = 0.02, -0.1, 0.03
MEDIAN_ERROR = 0.04  # [m] of the median distance
OPACITY = 0.98
GROUPS = ("", "moving.", "static.")
PHASE_SLOPE = float(Sensor().phase_slope)


def box_at(n):
    """[H, W] whether a pixel sees the box: rows 3..8, four columns that move on by one each raw
    frame.
    """
    seen = np.zeros((HEIGHT, WIDTH), dtype=bool)
    seen[3:9, 2 + n : 6 + n] = True
    return seen


def true_distance(n):
    """[H, W] distance at raw frame n [m]."""
    return np.where(box_at(n), BOX, WALL)


def quad(distance, shift, amplitude_distance=None):
    """Quad of surfaces at a distance [m], with the falloff of another one if given."""
    falloff = distance if amplitude_distance is None else amplitude_distance
    return np.cos(PHASE_SLOPE * distance - shift) / falloff**2


def in_colour(distance):
    """[3, H, W] linear RGB of surfaces at a distance: a reddish wall, a bluish box."""
    return np.where(
        distance == BOX,
        np.array([0.1, 0.2, 0.9])[:, None, None],
        np.array([0.8, 0.5, 0.1])[:, None, None],
    )


def with_colour(measured):
    """A sequence with a colour image of every quartet's start, taken a decimetre aside,
    and three novel poses.
    """
    beside = np.tile(np.eye(4), (measured.frames, 1, 1))
    beside[:, 0, 3] = -0.1
    novel = np.tile(np.eye(4), (3, 1, 1))
    novel[:, 1, 3] = (0.5, 0.0, -0.5)
    images = {
        n: in_colour(true_distance(n)).transpose(1, 2, 0) for n in range(0, measured.frames, 4)
    }
    return changed(
        measured,
        colour={n: (2.0 * image).astype(np.float32) for n, image in images.items()},
        colour_intrinsics=(20.0, 20.0, WIDTH / 2, HEIGHT / 2),
        colour_from_world=beside,
        novel_from_world=novel,
    )


def as_phasors(measured):
    """The complete quartets as a camera gives them that delivers phasors,
    at the instants of their starts.
    """
    starts = [4 * i for i in measured.complete_quartets]
    phasors = [
        quad(true_distance(n), 0.0) * 2 + 2j * quad(true_distance(n), np.pi / 2) for n in starts
    ]
    quads = np.stack([part / 2 for p in phasors for part in (p.real, -p.real, p.imag, -p.imag)])
    return replace(
        measured,
        quads=quads.astype(np.float32),
        measured=np.ones(len(quads), dtype=bool),
        shifts=measured.shifts[: len(quads)],
        times=np.repeat(measured.times[starts], 4),
        camera_from_world=np.repeat(measured.camera_from_world[starts], 4, axis=0),
        from_phasors=True,
    )


def sequence(frames=FRAMES):
    """The measured quads, exact and asynchronous, in memory."""
    shifts = np.array([CANONICAL_SHIFTS[n % 4] for n in range(frames)])
    return sequence_of(
        quads=np.stack([quad(true_distance(n), shifts[n]) for n in range(frames)]).astype(
            np.float32
        ),
        measured=np.ones(frames, dtype=bool),
        shifts=shifts,
        times=np.arange(frames) / FRAME_RATE_HZ,
        f_mod_hz=Sensor().f_mod_hz,
        fx=20.0,
        fy=20.0,
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
        camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
    )


def truth(frames=FRAMES):
    """The true distance of every raw frame."""
    distance = np.stack([true_distance(n) for n in range(frames)]).astype(np.float32)
    return Truth(distance=distance, known=np.ones(frames, dtype=bool))


class AnalyticRun:
    """Looks like a finished run; what it renders is the truth plus the errors above."""

    def __init__(self, folder, *, with_truth=True, colour=False):
        self.path = Path(folder) / "run"
        self.path.mkdir(parents=True)
        where = Path(folder) / "sliding-box"
        write("ftorf", where, sequence(), truth() if with_truth else None)
        self.camera = Camera(
            width=WIDTH, height=HEIGHT, fx=20.0, fy=20.0, cx=WIDTH / 2, cy=HEIGHT / 2
        )
        self.sensor = Sensor()
        self.quad_scale = 1.0
        self.gaussians = 1234
        self.has_colour = colour
        self.cameras = []  # every camera that was rendered from
        self.config = {
            "version": "0.0.9",
            "preset": "demo",
            "seed": 7,
            "images": 3000,
            "images_optimised": 2988,
            "device": "cpu",
            "threads": 2,
            "sequence": str(where),
            "flow_source": "computed",
            "init": "phase",
            "motion": "nodes",
            "seconds_reconstruct": 41.25,
        }
        steps = [
            {"images": 100 * i, "seconds": 1.0 * i, "loss": 1.0 / i, "quads": 0.8 / i}
            for i in range(1, 6)
        ]
        lines = [
            json.dumps(step | {"gaussians": 1200 + i, "quad_psnr_db": 20.0 + i})
            for i, step in enumerate(steps)
        ]
        (self.path / "metrics.jsonl").write_text("\n".join(lines) + "\n")

    def watched(self, *rows):
        """Write rows of diagnostics, each (images, error of d, |d - d_ToF| on static pixels)."""
        lines = [
            json.dumps(
                {
                    "images": images,
                    "gaussians": 1000 + images,
                    "transmittance": 0.5 / images,
                    "distortion": 0.02,
                }
                | {f"{group}{name}_mse_x100": error for group in GROUPS for name in ("d", "d_tof")}
                | {"offset_static_m": 0.01, "d_minus_dtof_static_m": apart}
            )
            for images, error, apart in rows
        ]
        (self.path / "diagnostics.jsonl").write_text("\n".join(lines) + "\n")

    @property
    def explained(self):
        """Its residuals."""
        return residuals(self, self.sequence())

    def sequence(self):
        """The sequence this run pretends to be made from."""
        return Sequence.open(self.config["sequence"])

    def renderer(self, images=(), *, f_mod_hz=None, corrected=True):  # noqa: ARG002
        """What ``gftorf render`` asks for every image."""
        return self.render

    def corrected(self, rendering, time, camera):  # noqa: ARG002
        """What it renders is final."""
        return rendering

    def render(self, time, camera=None, *, extra=None):
        """Truth and its quads at the nearest raw frame, plus the known errors."""
        assert extra is None
        self.cameras.append(camera)
        n = round(time * FRAME_RATE_HZ)
        right = true_distance(n)
        distance = OPACITY * (right + np.where(box_at(n), BOX_ERROR, WALL_ERROR))
        quads = np.stack([quad(right + QUAD_ERROR, shift, right) for shift in self.sensor.shifts])
        phasor = np.stack([quads[0] - quads[1], quads[2] - quads[3], 2.0 / right**2])

        def tensor(image):
            return torch.tensor(image, dtype=torch.float32)

        return Rendering(
            quads=tensor(quads),
            phasor=tensor(phasor),
            colour=tensor(2.0 * in_colour(right) + COLOUR_ERROR) if self.has_colour else None,
            distance=tensor(distance),
            opacity=tensor(np.full_like(distance, OPACITY)),
            distortion=tensor(np.zeros_like(distance)),
            distance_median=tensor(right + MEDIAN_ERROR),
            extra=None,
            screen=None,
        )


def interrupt(run, number):
    """Let the rendering of this number be Ctrl-C."""
    right, numbers = run.render, count(1)

    def render(time, camera):
        if next(numbers) == number:
            raise KeyboardInterrupt
        return right(time, camera)

    run.renderer = lambda _: render
