"""The window in a browser, by viser: what can be chosen, and what is drawn of it.

Callbacks of viser run in threads of their own. They only note that something changed; one loop
draws, so that a run is rendered by one thread.
"""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..errors import InputError, UsageError
from ..evaluate import page, pictures
from ..scene.camera import Camera
from . import pixel, scene
from .subject import Subject

HOST = "127.0.0.1"  # nobody else on the network can connect
ASK_EVERY_S = 1.0  # [s] between two looks for a newer checkpoint
RATES = (2.0, 30.0, 10.0)  # [raw frames per second] slowest, fastest and first of the play button
SETBACK = 1.4  # from the camera to where the viewer starts, over the width of the scene
ALOFT = 0.35  # how far above it, likewise
MARK = (230, 30, 30)  # RGB of what marks the chosen pixel
NEAR_PX = 4  # [px] farthest point of a thinned cloud that stands for the chosen pixel
MARK_PX = 1.5  # [px] radius of the ball at the chosen pixel
STYLE = """<style>
.gftorf figure { margin: 0 0 8px; } .gftorf figcaption { font-size: 12px; font-weight: 600; }
.gftorf figcaption span { font-weight: 400; }
.gftorf img.picture { width: 100%; height: auto; image-rendering: pixelated; display: block; }
.gftorf .bar { display: flex; align-items: center; gap: 5px; font-size: 11px; }
.gftorf .bar img { flex: 1; height: 8px; min-width: 20px; width: 20px; }
.gftorf img.plot { width: 100%; background: white; border-radius: 4px; }
</style>"""


class Window:
    """A viewer of one subject; close it with :meth:`close`.

    Args:
        subject: What is shown.
        port: Where it listens at 127.0.0.1; 0: any free port.

    Raises:
        UsageError: If the port is in use.
        InputError: If viser is not installed.
    """

    def __init__(self, subject: Subject, port: int = 0):
        viser = _viser()
        self.subject, self.port = subject, _free(port)
        with _silent():
            self.server = viser.ViserServer(
                host=HOST, port=self.port, label="gftorf", verbose=False
            )
        self._changed = threading.Event()
        self._drawn: dict[str, Any] = {}
        self._pixel = subject.sequence.height // 2, subject.sequence.width // 2
        self._ray: tuple[np.ndarray, np.ndarray] | None = None
        self._last_asked, self._next_frame = time.monotonic(), 0.0
        self._set_up()
        self._controls()
        self._changed.set()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{HOST}:{self.port}"

    @property
    def choice(self) -> scene.Choice:
        """What is chosen now."""
        return scene.Choice(
            frame=int(self.frame.value),
            shape=self.shape.value,
            colour=self.colour.value,
            beside=self.beside.value,
            cameras=self.cameras.value,
            pixel=self._pixel,
        )

    def close(self) -> None:
        """Stop listening."""
        with _silent():
            self.server.stop()

    def run(self) -> None:
        """Draw whatever is chosen until KeyboardInterrupt."""
        while True:
            self.step(ASK_EVERY_S)

    def step(self, wait_s: float) -> bool:
        """Draw if something changed within ``wait_s`` [s]; whether something was drawn."""
        if self.play.value:
            wait_s = min(wait_s, max(0.0, self._next_frame - time.monotonic()))
        changed = self._changed.wait(wait_s)
        self._changed.clear()
        if self.play.value and time.monotonic() >= self._next_frame:
            self._next_frame = time.monotonic() + 1.0 / self.rate.value
            self.frame.value = (int(self.frame.value) + 1) % self.subject.frames
            changed = True
        if time.monotonic() > self._last_asked + ASK_EVERY_S:
            self._last_asked = time.monotonic()
            changed |= self.subject.reload()
        if self._ray is not None:
            self._take_ray(*self._ray)
        if changed:
            self.draw()
        return changed

    def draw(self) -> None:
        """Draw what is chosen now."""
        choice, subject = self.choice, self.subject
        with self.server.atomic():
            self._draw_splats(scene.splats(subject, choice))
            self._draw_titles(choice)
            self._draw_clouds(found := scene.clouds(subject, choice))
            self._draw_marks(found, choice)
            self._draw_cameras(choice)
            self.shown.content = self._pictures(choice)
            self.plot.content = self._plot(choice)
            self.about.content = about(subject, choice.frame)
        self.server.flush()

    def pick(self, origin: tuple[float, ...], direction: tuple[float, ...]) -> None:
        """Choose the pixel whose point a ray in the world meets, if there is one, in the next
        step.
        """
        self._ray = np.array(origin), np.array(direction)
        self._changed.set()

    def _take_ray(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Choose the pixel on a ray."""
        self._ray = None
        points = replace(self.choice, shape=scene.POINTS)
        found = scene.pixel_on_ray(scene.clouds(self.subject, points), origin, direction)
        if found is not None:
            self.row.value, self.column.value = self._pixel = found

    def _set_up(self) -> None:
        """Axes, and where the viewer starts: behind the camera of the first raw frame."""
        camera, server = self.subject.camera(0), self.server
        _, down, forward = camera.camera_from_world[:3, :3]
        width = scene.width_of(self.subject, camera)
        server.scene.set_up_direction(tuple(-down))
        start = server.initial_camera
        start.position = tuple(camera.centre - width * (SETBACK * forward + ALOFT * down))
        start.look_at = tuple(camera.centre + 0.7 * self.subject.distance_scale.high * forward)
        start.up = tuple(-down)
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.scene.on_click()(lambda event: self.pick(event.ray_origin, event.ray_direction))

    def _controls(self) -> None:
        """The panel."""
        gui, subject = self.server.gui, self.subject
        gui.set_panel_label(f"gftorf view {subject.path.name}")
        self.about = gui.add_markdown("")
        self.frame = gui.add_slider("raw frame", 0, max(1, subject.frames - 1), 1, 0)
        self.play = gui.add_checkbox("play", False)
        slowest, fastest, first = RATES
        self.rate = gui.add_slider("frames per s", slowest, fastest, 1.0, first)
        shapes = [scene.SPLATS] if subject.run is not None and len(subject.run.field) else []
        self.shape = gui.add_dropdown("shape of ours", [*shapes, scene.POINTS])
        self.colour = gui.add_dropdown("show", scene.colours_of(subject))
        self.beside = gui.add_checkbox("closed form, truth beside", True)
        self.cameras = gui.add_checkbox("camera", True)
        gui.add_button("look through the camera").on_click(lambda _: self._look_through())
        with gui.add_folder("Pixel: click it in the scene"):
            height, width = subject.sequence.height, subject.sequence.width
            self.row = gui.add_slider("row", 0, max(1, height - 1), 1, self._pixel[0])
            self.column = gui.add_slider("column", 0, max(1, width - 1), 1, self._pixel[1])
            self.plot = gui.add_html("")
        with gui.add_folder("Pictures"):
            self.shown = gui.add_html("")
        for control in (self.frame, self.play, self.shape, self.colour, self.beside, self.cameras):
            control.on_update(self._note(lambda: None))
        for control in (self.row, self.column):
            control.on_update(self._note(self._take_pixel))

    def _look_through(self) -> None:
        """Move every viewer to the camera of the raw frame, so that a click meets a pixel."""
        camera = self.subject.camera(int(self.frame.value))
        for client in self.server.get_clients().values():
            client.camera.wxyz, client.camera.position = _pose(camera)
            client.camera.fov = _fov(camera)

    def _note(self, before: Callable[[], None]) -> Callable[[Any], None]:
        """A callback that lets the loop draw."""

        def changed(_event: Any) -> None:
            before()
            self._changed.set()

        return changed

    def _take_pixel(self) -> None:
        self._pixel = int(self.row.value), int(self.column.value)

    def _draw_splats(self, found: scene.Splats | None) -> None:
        if found is None:
            self._remove("splats")
            return
        turn = _viser().transforms.SO3(found.quaternion).as_matrix()
        axes = turn * found.scale[:, None, :]
        self._drawn["splats"] = self.server.scene.add_gaussian_splats(
            "/splats",
            centers=found.centre,
            covariances=(axes @ axes.transpose(0, 2, 1)).astype(np.float32),
            rgbs=found.rgb.astype(np.float32),
            opacities=found.opacity[:, None],
        )

    def _draw_clouds(self, found: list[scene.Cloud]) -> None:
        camera = self.subject.camera(0)
        size = 0.6 * self.subject.distance_scale.high / camera.fx
        for title in (scene.OURS, scene.CLOSED_FORM, scene.TRUTH):
            self._remove(title)
        for cloud in found:
            self._drawn[cloud.title] = self.server.scene.add_point_cloud(
                f"/{_path(cloud.title)}",
                points=cloud.points,
                colors=cloud.rgb,
                point_size=size,
                point_shape="square",
                point_shading="flat",
            )

    def _draw_titles(self, choice: scene.Choice) -> None:
        """What each of the shapes beside each other is, above it."""
        for title in (scene.OURS, scene.CLOSED_FORM, scene.TRUTH):
            self._remove(f"title of {title}")
        for title, place in scene.titles(self.subject, choice).items():
            handle = self.server.scene.add_label(f"/titles/{_path(title)}", title, position=place)
            self._drawn[f"title of {title}"] = handle

    def _draw_marks(self, found: list[scene.Cloud], choice: scene.Choice) -> None:
        """A ball at the chosen pixel of every cloud."""
        for name in [name for name in self._drawn if name.startswith("mark")]:
            self._remove(name)
        radius = MARK_PX * self.subject.distance_scale.high / self.subject.camera(0).fx
        for k, cloud in enumerate(found):
            apart = np.abs(cloud.pixels - choice.pixel).sum(axis=1)
            if len(apart) and apart.min() <= NEAR_PX:
                given = {"radius": radius, "color": MARK, "position": cloud.points[apart.argmin()]}
                self._drawn[f"mark{k}"] = self.server.scene.add_icosphere(f"/marks/{k}", **given)

    def _draw_cameras(self, choice: scene.Choice) -> None:
        for name in [name for name in self._drawn if name.startswith("camera")]:
            self._remove(name)
        if not choice.cameras:
            return
        for n in {*scene.path_of(self.subject), choice.frame}:
            now, camera = n == choice.frame, self.subject.camera(n)
            wxyz, position = _pose(camera)
            self._drawn[f"camera{n}"] = self.server.scene.add_camera_frustum(
                f"/cameras/{n}",
                fov=_fov(camera),
                aspect=camera.width / camera.height,
                scale=0.3 if now else 0.1,
                color=(214, 94, 0) if now else (120, 120, 120),
                wxyz=wxyz,
                position=position,
            )

    def _remove(self, name: str) -> None:
        handle = self._drawn.pop(name, None)
        if handle is not None:
            handle.remove()

    def _pictures(self, choice: scene.Choice) -> str:
        shown = scene.pictures_of(self.subject, choice.frame, choice.colour)
        html = "".join(
            page.plain_picture(_marked(image, scale, choice), title, below=page.colour_bar(scale))
            for title, (image, scale) in shown.items()
        )
        text = html or "<p>Not known at this raw frame: its quartet is not complete.</p>"
        return f'{STYLE}<div class="gftorf">{text}</div>'

    def _plot(self, choice: scene.Choice) -> str:
        assert choice.pixel is not None, "a window has a pixel"
        series = pixel.series_of(self.subject, choice.pixel, choice.frame)
        svg = pixel.drawing(self.subject, series, choice.frame)
        source = pictures.data_uri(svg, "image/svg+xml")
        return f'<div class="gftorf"><img class="plot" src="{source}" alt="quads of a pixel"></div>'


def _path(title: str) -> str:
    """A title as the name of a node."""
    return title.replace(" ", "_").replace(",", "")


def _pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Orientation wxyz of a camera's axes in the world, and its centre [m]."""
    world_from_camera = camera.camera_from_world[:3, :3].T
    return _viser().transforms.SO3.from_matrix(world_from_camera).wxyz, camera.centre


def _fov(camera: Camera) -> float:
    """Vertical field of view [rad]."""
    return float(2 * np.arctan2(camera.height / 2, camera.fy))


def _marked(
    image: np.ndarray, scale: pictures.Scale, choice: scene.Choice
) -> UInt8[np.ndarray, "H W 3"]:
    """A picture with four strokes around the chosen pixel."""
    rgb = pictures.colour_mapped(image.astype(np.float32), scale)
    assert choice.pixel is not None, "a window has a pixel"
    y, x = choice.pixel
    near, far = 2, 2 + max(2, rgb.shape[1] // 40)
    for part in (slice(max(0, y - far), max(0, y - near)), slice(y + near + 1, y + far + 1)):
        rgb[part, x] = MARK
    for part in (slice(max(0, x - far), max(0, x - near)), slice(x + near + 1, x + far + 1)):
        rgb[y, part] = MARK
    return pictures.thinned(rgb, page.PICTURE_SIZE_MAX)


def about(subject: Subject, n: int) -> str:
    """What is seen, as Markdown."""
    sequence, run = subject.sequence, subject.run
    lines = [f"raw frame {n} of {subject.frames}, {1e3 * sequence.times[n]:.1f} ms"]
    if run is not None:
        reached, planned = run.config.get("images_optimised"), run.config.get("images")
        if run.gaussians:
            lines.append(f"{run.gaussians:,} Gaussians, image {reached:,} of {planned:,}")
        else:
            lines.append("closed form: nothing was optimised")
    return "  \n".join(lines)


def _silent() -> contextlib.redirect_stdout:
    """A block in which viser's banner is not printed: results alone go to stdout."""
    return contextlib.redirect_stdout(io.StringIO())


def _viser() -> Any:
    """The package viser.

    Raises:
        InputError: If it is not installed.
    """
    try:
        import viser
        import viser.transforms
    except ImportError as error:
        why, fix = f"the viewer needs it: {error}", "pip install 'gftorf-warp[view]'"
        raise InputError("viser is not installed", where="gftorf view", why=why, fix=fix) from error
    return viser


def _free(port: int) -> int:
    """The port, or any free one for 0.

    Raises:
        UsageError: If it is in use or may not be opened.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            fix = "leave --port out for any free one"
            raise UsageError(
                f"port {port} cannot be opened", where="--port", why=str(error), fix=fix
            ) from error
        return probe.getsockname()[1]
