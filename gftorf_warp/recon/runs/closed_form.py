"""Runs that render their measurements: nothing was fitted."""

from __future__ import annotations

import functools

from jaxtyping import Float
from torch import Tensor

from ...data.sequence import Sequence
from ...data.synchronised import synchronised
from ...data.temporal import averaged
from ...render.api import Rendering
from ...scene.camera import Camera
from .. import closed_form
from ..settings import FlowSource
from .empty import WithoutGaussians


class ClosedForm(WithoutGaussians):
    """A run without Gaussians, which renders its own measurements."""

    def render(
        self,
        time: float,
        camera: Camera | None = None,
        *,
        extra: Float[Tensor, "0 D"] | None = None,
        f_mod_hz: float | None = None,
    ) -> Rendering:
        """The measured quartet nearest to a time, as if it had been taken at that instant.

        Quads are the measured ones in canonical order, computed from the phasor where the sensor
        has another shift; the distance is what all frequencies together decode to, and nothing is
        transparent. There is no colour and no distortion, and extra channels are zero.

        Args:
            time: Seconds since raw frame 0, any number; during a quartet its own, else the nearest
                complete one.
            camera: None, or the sequence's own at the time.
            extra: Channels per Gaussian, of which there are none.
            f_mod_hz: Modulation frequency of quads and phasor [Hz], one of those that were
                measured; None: the first of the sensor.

        Raises:
            InputError: If the sequence cannot be read again, or none of its quartets is complete.
            UsageError: If it is asked for from another camera.
            ValueError: If nothing was measured at ``f_mod_hz``.
        """
        if camera is not None:
            closed_form.check_camera(self._measured, time, camera, self.camera, self.path)
        return closed_form.rendering_of(
            self._shown(time),
            time,
            self.sensor.shifts,
            f_mod_hz=f_mod_hz,
            extra_channels=None if extra is None else extra.shape[1],
            device=self.field.device,
        )

    def _shown(self, time: float) -> Sequence:  # noqa: ARG002
        """The sequence with the quartet that is decoded at a time [s]."""
        return self._measured

    @functools.cached_property
    def _measured(self) -> Sequence:
        return closed_form.checked(self.sequence())


class Temporal(ClosedForm):
    """A run without Gaussians, which renders the temporal mean of its measurements where a quartet
    agrees with its pixel's median, and the quartet elsewhere.
    """

    @functools.cached_property
    def _measured(self) -> Sequence:
        return averaged(closed_form.checked(self.sequence()))


class Flow2D(ClosedForm):
    """A run without Gaussians, which renders the closed form of raw frames that optical flow
    brought to the time of the rendering.
    """

    def _shown(self, time: float) -> Sequence:
        matcher = FlowSource(self.config["settings"]["flow"]).matcher
        return synchronised(self._measured, time, matcher).sequence
