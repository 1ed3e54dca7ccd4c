"""All named scenes, and those of our own: a textured room, something that moves in it, and a sensor that looks on.

All distances in our own stay inside the unambiguous range of 7.5 m.
"""

from __future__ import annotations

from ..constants import FRAME_RATE_HZ
from .calibration import CALIBRATION
from .lookalikes import SYNTHETIC
from .lookalikes_real import RECORDED
from .lookalikes_torf import CARRIED
from .paths import Arc, Line, Sweep, Viewpoint
from .scene import ColourCamera, Scene, room, still
from .world import Body, Box, Plane, Sphere, Texture


def demo() -> Scene:
    """The scene of ``gftorf demo``: small, quick, and wrong in closed form wherever the box passes."""
    frames = 44
    middle = (frames - 1) / 2 / FRAME_RATE_HZ
    box = Body(
        shape=Box(size=(0.6, 0.6, 0.6)),
        texture=Texture(low=0.3, high=0.9, cell=0.15),
        path=Line(position=(-0.16, -0.2, 2.65), velocity=(4.9, 2.9, -2.7), passing_s=middle),
    )
    return Scene(
        name="demo",
        closed_form=13.02,
        description="a textured box crosses a textured room, coming nearer",
        motion="sideways and in depth",
        bodies=(room(), box),
        frames=frames,
        width=96,
        height=72,
    )


def sliding() -> Scene:
    """Purely sideways: no pixel inside the box changes its distance, only its outline goes wrong."""
    frames = 48
    middle = (frames - 1) / 2 / FRAME_RATE_HZ
    box = Body(
        shape=Box(size=(0.6, 0.6, 0.6)),
        texture=Texture(low=0.3, high=0.9, cell=0.15),
        path=Line(position=(0.0, -0.1, 2.8), velocity=(3.0, 0.0, 0.0), passing_s=middle),
    )
    ball = still(Sphere(radius=0.35), (1.25, 0.8, 3.7), 0.5, 0.9, 0.2)
    return Scene(
        name="sliding",
        closed_form=3.738,
        description="a box slides from left to right in front of the back wall, past a ball",
        motion="sliding",
        bodies=(room(), ball, box),
        frames=frames,
        width=160,
        height=120,
    )


def axial() -> Scene:
    """Along the line of sight: the outline hardly moves, but the phase does, and the closed form lags and ripples."""
    frames = 48
    middle = (frames - 1) / 2 / FRAME_RATE_HZ
    approach = Body(
        shape=Sphere(radius=0.4),
        texture=Texture(low=0.3, high=0.9, cell=0.12),
        path=Line(position=(-0.55, 0.0, 2.9), velocity=(0.0, 0.0, -4.0), passing_s=middle),
    )
    retreat = Body(
        shape=Box(size=(0.6, 0.6, 0.6)),
        texture=Texture(low=0.3, high=0.9, cell=0.15),
        path=Line(position=(0.7, 0.2, 2.7), velocity=(0.0, 0.0, 3.0), passing_s=middle),
    )
    return Scene(
        name="axial",
        closed_form=2.637,
        description="a ball flies towards the camera while a box moves away from it",
        motion="axial",
        bodies=(room(), approach, retreat),
        frames=frames,
        width=160,
        height=120,
    )


def arc() -> Scene:
    """On a circle, turning: sideways and in depth in changing proportion."""
    box = Body(
        shape=Box(size=(0.5, 0.7, 0.5)),
        texture=Texture(low=0.3, high=0.9, cell=0.14),
        path=Arc(centre=(0.0, 0.05, 3.2), radius=0.75, start_deg=-170.0, rate_deg_per_s=400.0),
    )
    picture = still(Plane(size=(0.9, 0.6)), (-1.1, -0.7, 4.1), 0.05, 0.95, 0.15)
    return Scene(
        name="arc",
        closed_form=6.471,
        description="a box swings on a horizontal circle, towards the camera and away",
        motion="arc",
        bodies=(room(), picture, box),
        frames=48,
        width=160,
        height=120,
    )


def tour() -> Scene:
    """A camera that is carried past a desk, as in recordings of the TöRF family: phasors, colour, a pose per frame."""
    target = (0.0, 0.1, 2.7)
    desk = still(Box(size=(2.2, 0.08, 1.0)), (0.1, 0.62, 2.75), 0.45, 0.7, 0.25, 0.08)
    chest = still(Box(size=(0.5, 0.9, 0.5)), (-1.35, 0.7, 3.6), 0.3, 0.9, 0.15, 0.35)
    crate = still(Box(size=(0.45, 0.36, 0.35)), (0.65, 0.4, 2.75), 0.4, 0.9, 0.12, 0.17)
    globe = still(Sphere(radius=0.2), (-0.6, 0.38, 2.65), 0.5, 0.95, 0.1, 0.75)
    picture = still(Plane(size=(1.3, 0.8)), (0.55, -0.75, 4.15), 0.1, 0.95, 0.16)
    ball = Body(
        shape=Sphere(radius=0.3),
        texture=Texture(low=0.35, high=0.95, cell=0.13, hue=0.98),
        path=Arc(centre=(0.0, -0.2, 2.75), radius=0.55, start_deg=-180.0, rate_deg_per_s=180.0),
    )
    return Scene(
        name="tour",
        closed_form=2.488,
        description="a camera is carried past a desk over which a ball swings by; with a colour camera",
        motion="camera and ball on arcs",
        bodies=(room(hue=0.55), desk, chest, crate, globe, picture, ball),
        frames=120,
        width=160,
        height=120,
        camera_path=Sweep(middle=(0.0, 0.0, 0.0), target=target, sweep_deg=9.0, period_s=2.0, rise=0.05),
        colour=ColourCamera(width=320, height=240, position=(0.04, 0.0, 0.0), noise=0.004),
        novel_views=tuple(
            Viewpoint(position=position, target=target)
            for position in (
                (-0.45, -0.1, 0.0),
                (-0.2, -0.35, 0.1),
                (0.0, 0.2, 0.0),
                (0.0, 0.0, 0.4),
                (0.2, -0.35, 0.1),
                (0.45, -0.1, 0.0),
            )
        ),
    )


OURS = (demo, sliding, axial, arc, tour)
LOOK_ALIKES = (*SYNTHETIC, *RECORDED, *CARRIED)
SCENES: dict[str, Scene] = {scene.name: scene for scene in (make() for make in (*OURS, *LOOK_ALIKES, *CALIBRATION))}
"""All named scenes, the one of ``gftorf demo`` first, then the others of our own, ``OURS``."""
