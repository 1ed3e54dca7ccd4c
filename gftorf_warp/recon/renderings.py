"""The renderings that the terms of an image read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..render import fused
from ..render.api import Background, Rendering, rasterize
from ..render.bridge import pairs_of
from ..render.buffers import RenderSettings, Workspace
from ..render.displacement import displaced
from ..scene.gaussians import GaussianField
from ..scene.motion import KeyMotion
from .control import ImageControl
from .keys import ImageKey
from .observations import Observations
from .settings import ReconSettings
from .terms import LIGHT, Term, View

CHANNELS = {"quads": 1, "phasor": 3, "colour": 3}
COLOUR_STREAM = 1  # of random numbers; that of quads and phasors is 0


class Renderer:
    """Renders the views of the images of a batch, each in a workspace of its own."""

    def __init__(self, observations: Observations, settings: ReconSettings, terms: Sequence[Term]):
        """Allocate nothing yet.

        Args:
            observations: Sizes of the images; poses and calibration come from the control block.
            settings: Of the run.
            terms: All terms of the loss.
        """
        self.settings, self.terms = settings, terms
        self.light = "phasor" if observations.phasors else "quads"
        self.sensor = observations.sensor_at(observations.batches[0][0])  # of one shift
        cameras = [*observations.colour_cameras.values(), observations.cameras[0]]
        self.cameras = dict.fromkeys(View, observations.cameras[0]) | {View.COLOUR: cameras[0]}
        """Camera of every view, of which only the size and the kind of lens count."""
        self._workspaces: defaultdict[tuple[int, View], Workspace] = defaultdict(Workspace)

    @property
    def sorts_pairs(self) -> bool:
        """Whether the last step sorted its (tile, splat) pairs."""
        return any(not workspace.last.marks for workspace in self._workspaces.values())

    def pairs(self, n: int, image: ImageKey) -> list[Tensor]:
        """(tile, splat) pairs [1] of every rendering of image ``n``."""
        return [pairs_of(self._workspaces[n, view]) for view in image.views]

    def render(
        self,
        n: int,
        image: ImageKey,
        field: GaussianField,
        motion: KeyMotion | None,
        control: ImageControl,
        settings: RenderSettings,
    ) -> tuple[dict[View, Rendering], Float[Tensor, "N 3"] | None]:
        """Render image ``n`` of a batch.

        Args:
            n: Its number, which selects the workspaces.
            image: What is rendered.
            field: Undisplaced Gaussians.
            motion: Their motion at the keys of the batch; None: nothing moves.
            control: Device memory of the image.
            settings: Of the renderer.

        Returns:
            Renderings by view, and the centres [m] at the time of the ToF image; None if nothing
            moves or if no term reads it.
        """
        renderings: dict[View, Rendering] = {}
        moved_mean = None
        no_view = any(term.view is None and term.name in image.terms for term in self.terms)
        for view in [v for v in View if v in image.views or (no_view and v == View.TOF)]:
            joint = view == View.TOF and image.flow_terms and View.FLOW not in image.views
            moved, channels = field, None
            if motion is not None:
                mean, quaternion, channels = displaced(
                    field.mean,
                    field.quaternion,
                    motion,
                    control.blend[view],
                    channels=joint or view == View.FLOW,
                )
                moved = replace(field, mean=mean, quaternion=quaternion)
                moved_mean = mean if view == View.TOF else moved_mean
            if view in image.views:
                renderings[view] = self._render(view, n, image, moved, channels, control, settings)
            if joint:
                renderings[View.FLOW] = renderings[view]
        return renderings, moved_mean

    def _render(
        self,
        view: View,
        n: int,
        image: ImageKey,
        field: GaussianField,
        channels: Float[Tensor, "N D"] | None,
        control: ImageControl,
        settings: RenderSettings,
    ) -> Rendering:
        """One rendering: the outputs that terms read, in front of random light."""
        views = {view} if channels is None else {view, View.FLOW}
        outputs = {"opacity"}
        for term in self.terms:
            if term.name in image.terms and term.view in views:
                outputs |= term.outputs
        streams = {"colour": COLOUR_STREAM} if view == View.COLOUR else {}
        if LIGHT in outputs:
            outputs = outputs - {LIGHT} | {self.light}
            streams = {self.light: 0}
        if view != View.COLOUR:
            field = replace(field, colour_sh=None)
        if view == View.FLOW:
            field = field.map(torch.Tensor.detach)
        camera, amplitude = self.cameras[view], self.settings.background
        noise = {
            name: fused.uniform(
                (CHANNELS[name], camera.height, camera.width),
                control.noise_origin,
                amplitude,
                stream=stream,
            )
            for name, stream in streams.items()
            if amplitude > 0
        }
        return rasterize(
            field,
            camera,
            self.sensor,
            settings,
            control=control.camera[view],
            background=Background(**noise),
            screen_gradient=self.settings.densify.every is not None and view == primary(image),
            images=outputs,
            extra=channels,
            extra_detached=channels is not None,
            workspace=self._workspaces[n, view],
        )


def primary(image: ImageKey) -> View:
    """The view that densification is based on."""
    return View.TOF if View.TOF in image.views else View.COLOUR
