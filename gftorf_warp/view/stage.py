"""The scene of a viewer, in viser's terms: splats, clouds, cameras, titles and marks."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..scene.camera import Camera
from . import scene
from .controls import MARK
from .subject import Subject

SETBACK = 1.4  # from the camera to where the viewer starts, over the width of the scene
ALOFT = 0.35  # how far above it, likewise
POINT_PX = 0.6  # [px] radius of a point at the largest distance
MARK_PX = 1.5  # [px] radius of the ball at the chosen pixel, likewise
NOW, PATH = (214, 94, 0), (120, 120, 120)  # RGB of the camera of the raw frame, and of others


class Stage:
    """What is drawn in three dimensions.

    Args:
        server: A viser server.
        subject: What is shown.
    """

    def __init__(self, server: Any, subject: Subject):
        self.server, self.subject = server, subject
        self._drawn: list[Any] = []
        camera, width = subject.recording.camera(0), subject.recording.width
        _, down, forward = camera.camera_from_world[:3, :3]
        server.scene.set_up_direction(tuple(-down))
        start, far = server.initial_camera, subject.recording.distance_scale.high
        start.position = tuple(camera.centre - width * (SETBACK * forward + ALOFT * down))
        start.look_at = tuple(camera.centre + 0.7 * far * forward)
        start.up = tuple(-down)
        self._pixel_m = far / camera.fx  # [m] at the largest distance

    def draw(self, choice: scene.Choice) -> None:
        """Draw what is chosen instead of what was drawn before."""
        before, self._drawn = self._drawn, []
        with self.server.atomic():
            self._draw_splats(scene.splats(self.subject, choice))
            self._draw_clouds(scene.clouds(self.subject, choice))
            self._draw_cameras(choice)
            for title, position in scene.marks(self.subject, choice).items():
                given = {"radius": MARK_PX * self._pixel_m, "color": MARK, "position": position}
                name = f"/marks/{_path(title)}"
                self._keep(self.server.scene.add_icosphere(name, **given))
            for title, position in scene.titles(self.subject, choice).items():
                name = f"/titles/{_path(title)}"
                self._keep(self.server.scene.add_label(name, title, position=position))
            names = {handle.name for handle in self._drawn}
            for handle in before:
                if handle.name not in names:  # those of the same name are replaced already
                    handle.remove()

    def look_through(self, camera: Camera) -> None:
        """Move every viewer to a camera."""
        for client in self.server.get_clients().values():
            client.camera.wxyz, client.camera.position = _pose(camera)
            client.camera.fov = _fov(camera)

    def _keep(self, handle: Any) -> None:
        self._drawn.append(handle)

    def _draw_splats(self, splats: scene.Splats | None) -> None:
        if splats is None:
            return
        from viser.transforms import SO3

        turn = SO3(splats.quaternion).as_matrix()
        axes = turn * splats.scale[:, None, :]
        handle = self.server.scene.add_gaussian_splats(
            "/splats",
            centers=splats.centre,
            covariances=(axes @ axes.transpose(0, 2, 1)).astype(np.float32),
            rgbs=splats.rgb.astype(np.float32),
            opacities=splats.opacity[:, None],
        )
        self._keep(handle)

    def _draw_clouds(self, clouds: list[scene.Cloud]) -> None:
        for cloud in clouds:
            handle = self.server.scene.add_point_cloud(
                f"/clouds/{_path(cloud.title)}",
                points=cloud.points,
                colors=cloud.rgb,
                point_size=POINT_PX * self._pixel_m,
                point_shape="square",
                point_shading="flat",
            )
            self._keep(handle)

    def _draw_cameras(self, choice: scene.Choice) -> None:
        if not choice.cameras:
            return
        for n in {*scene.path_of(self.subject), choice.frame}:
            now, camera = n == choice.frame, self.subject.recording.camera(n)
            wxyz, position = _pose(camera)
            handle = self.server.scene.add_camera_frustum(
                "/camera" if now else f"/path/{n}",
                fov=_fov(camera),
                aspect=camera.width / camera.height,
                scale=0.3 if now else 0.1,
                color=NOW if now else PATH,
                wxyz=wxyz,
                position=position,
            )
            self._keep(handle)


def _path(title: str) -> str:
    """A title as the name of a node."""
    return title.replace(" ", "_").replace(",", "")


def _pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Orientation wxyz of a camera's axes in the world, and its centre [m]."""
    from viser.transforms import SO3

    world_from_camera = camera.camera_from_world[:3, :3].T
    return SO3.from_matrix(world_from_camera).wxyz, camera.centre


def _fov(camera: Camera) -> float:
    """Vertical field of view [rad]."""
    return float(2 * np.arctan2(camera.height / 2, camera.fy))
