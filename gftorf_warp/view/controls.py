"""The panel of a viewer, in viser's terms: what can be chosen, and texts and pictures beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import UInt8

from ..evaluate import page, pictures
from . import pixel, scene
from .subject import Subject

RATES = (2.0, 30.0, 10.0)  # [raw frames per second] slowest, fastest and first of the play button
MARK = (230, 30, 30)  # RGB of what marks the chosen pixel
STYLE = """<style>
.gftorf figure { margin: 0 0 8px; } .gftorf figcaption { font-size: 12px; font-weight: 600; }
.gftorf figcaption span { font-weight: 400; }
.gftorf img.picture { width: 100%; height: auto; image-rendering: pixelated; display: block; }
.gftorf .bar { display: flex; align-items: center; gap: 5px; font-size: 11px; }
.gftorf .bar img { flex: 1; height: 8px; min-width: 20px; width: 20px; }
.gftorf img.plot { width: 100%; background: white; border-radius: 4px; }
</style>"""


class Controls:
    """Everything in the panel.

    Args:
        gui: That of a viser server.
        subject: What is shown.
        changed: Called, by a thread of viser, when something else was chosen.
        look_through: Called when the viewer shall move to the camera.
    """

    def __init__(
        self,
        gui: Any,
        subject: Subject,
        *,
        changed: Callable[[], None],
        look_through: Callable[[], None],
    ):
        self.subject = subject
        gui.set_panel_label(f"gftorf view {subject.path.name}")
        self.about = gui.add_markdown("")
        self.frame = gui.add_slider("raw frame", 0, max(1, subject.frames - 1), 1, 0)
        self.play = gui.add_checkbox("play", False)
        slowest, fastest, first = RATES
        self.rate = gui.add_slider("frames per s", slowest, fastest, 1.0, first)
        shapes = [scene.SPLATS, scene.POINTS] if subject.has_gaussians else [scene.POINTS]
        self.shape = gui.add_dropdown("shape of ours", shapes)
        self.colour = gui.add_dropdown("show", scene.colours_of(subject))
        self.beside = gui.add_checkbox("closed form, truth beside", True)
        self.cameras = gui.add_checkbox("camera", True)
        gui.add_button("look through the camera").on_click(lambda _: look_through())
        with gui.add_folder("Pixel: click it in the scene"):
            height, width = subject.sequence.height, subject.sequence.width
            self.row = gui.add_slider("row", 0, max(1, height - 1), 1, height // 2)
            self.column = gui.add_slider("column", 0, max(1, width - 1), 1, width // 2)
            self.plot = gui.add_html("")
        with gui.add_folder("Pictures"):
            self.shown = gui.add_html("")
        chosen = self.frame, self.play, self.shape, self.colour, self.beside, self.cameras
        for control in (*chosen, self.row, self.column):
            control.on_update(lambda _: changed())

    @property
    def choice(self) -> scene.Choice:
        """What is chosen now."""
        height, width = self.subject.sequence.height, self.subject.sequence.width
        return scene.Choice(
            frame=min(int(self.frame.value), self.subject.frames - 1),
            shape=self.shape.value,
            colour=self.colour.value,
            beside=self.beside.value,
            cameras=self.cameras.value,
            pixel=(min(int(self.row.value), height - 1), min(int(self.column.value), width - 1)),
        )

    def show(self, choice: scene.Choice) -> None:
        """Texts, pictures and the plot of what is chosen."""
        self.about.content = about(self.subject, choice.frame)
        self.shown.content = _pictures(self.subject, choice)
        self.plot.content = _plot(self.subject, choice)


def about(subject: Subject, n: int) -> str:
    """What is seen, as Markdown."""
    sequence, run = subject.sequence, subject.run
    lines = [f"raw frame {n} of {subject.frames}, {1e3 * sequence.times[n]:.1f} ms"]
    if run is not None:
        reached, planned = run.config.get("images_optimised"), run.config.get("images")
        if run.gaussians or reached:
            what = f"{run.gaussians:,} Gaussians" if run.gaussians else "a neural volume"
            lines.append(f"{what}, image {reached:,} of {planned:,}")
        else:
            lines.append("closed form: nothing was optimised")
    return "  \n".join(lines)


def _pictures(subject: Subject, choice: scene.Choice) -> str:
    shown = scene.pictures_of(subject, choice.frame, choice.colour)
    html = "".join(
        page.plain_picture(_marked(image, scale, choice.pixel), title, below=page.colour_bar(scale))
        for title, (image, scale) in shown.items()
    )
    text = html or "<p>Not known at this raw frame: its quartet is not complete.</p>"
    return f'{STYLE}<div class="gftorf">{text}</div>'


def _marked(
    image: np.ndarray, scale: pictures.Scale, pixel: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture with four strokes around the chosen pixel (y, x)."""
    rgb = pictures.colour_mapped(image.astype(np.float32), scale)
    y, x = pixel
    near, far = 2, 2 + max(2, rgb.shape[1] // 40)
    for part in (slice(max(0, y - far), max(0, y - near)), slice(y + near + 1, y + far + 1)):
        rgb[part, x] = MARK
    for part in (slice(max(0, x - far), max(0, x - near)), slice(x + near + 1, x + far + 1)):
        rgb[y, part] = MARK
    return pictures.thinned(rgb, page.PICTURE_SIZE_MAX)


def _plot(subject: Subject, choice: scene.Choice) -> str:
    series = pixel.series_of(subject, choice.pixel, choice.frame)
    svg = pixel.drawing(subject, series, choice.frame)
    source = pictures.data_uri(svg, "image/svg+xml")
    return f'<div class="gftorf"><img class="plot" src="{source}" alt="quads of a pixel"></div>'
