"""A viewer in a browser, by viser.

Callbacks of viser run in threads of their own. They only note that something changed; one loop
draws, so that a run is rendered by one thread.
"""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import InputError, UsageError
from . import scene
from .controls import Controls
from .stage import Stage
from .subject import Subject

HOST = "127.0.0.1"  # not reachable from other machines
CHECK_EVERY_S = 1.0  # [s] between two checks for a newer checkpoint


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
            given = {"host": HOST, "port": self.port, "verbose": False}
            self.server = viser.ViserServer(label="gftorf", **given)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self._changed = threading.Event()
        self._ray: tuple[np.ndarray, np.ndarray] | None = None
        self._last_check, self._next_frame = time.monotonic(), 0.0
        self.stage = Stage(self.server, subject)
        self.controls = Controls(
            self.server.gui,
            subject,
            changed=self._changed.set,
            look_through=self._look_through,
        )
        self.server.scene.on_click()(lambda event: self.pick(event.ray_origin, event.ray_direction))
        self._changed.set()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{HOST}:{self.port}"

    def close(self) -> None:
        """Stop listening."""
        with _silent():
            self.server.stop()

    def run(self) -> None:
        """Draw whatever is chosen until KeyboardInterrupt."""
        while True:
            self.step(CHECK_EVERY_S)

    def step(self, wait_s: float) -> bool:
        """Draw if something changed within ``wait_s`` [s]; whether something was drawn."""
        playing = self.controls.play.value
        if playing:
            wait_s = min(wait_s, max(0.0, self._next_frame - time.monotonic()))
        changed = self._changed.wait(wait_s)
        self._changed.clear()
        now = time.monotonic()
        if playing and now >= self._next_frame:
            self._next_frame = now + 1.0 / self.controls.rate.value
            frame = self.controls.frame
            frame.value = (int(frame.value) + 1) % self.subject.frames
            changed = True
        if now > self._last_check + CHECK_EVERY_S:
            self._last_check = now
            changed |= self.subject.reload()
        if self._ray is not None:
            self._take_ray(*self._ray)
        if changed:
            self.draw()
        return changed

    def draw(self) -> None:
        """Draw what is chosen now."""
        choice = self.controls.choice
        self.stage.draw(choice)
        self.controls.show(choice)
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
        points = replace(self.controls.choice, shape=scene.POINTS)
        pixel = scene.pixel_on_ray(scene.clouds(self.subject, points), origin, direction)
        if pixel is not None:
            self.controls.row.value, self.controls.column.value = pixel

    def _look_through(self) -> None:
        """Move all viewers to the camera, where every click meets a pixel."""
        self.stage.look_through(self.subject.recording.camera(self.controls.choice.frame))


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
