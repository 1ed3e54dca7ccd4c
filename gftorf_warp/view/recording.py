"""What was recorded, raw frame by raw frame: closed form, amplitude, truth, cameras, scales."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from ..data.decode import closed_form_distance, quartet_phasor
from ..data.read import read_truth
from ..data.sequence import Sequence
from ..data.truth import known_distance
from ..evaluate import pictures
from ..scene.camera import Camera
from ..scene.measured import camera_of

SAMPLED = 8  # raw frames from which scales are taken
HELD = 64  # quartets whose closed form is kept


class Recording:
    """A sequence as a viewer needs it.

    Args:
        sequence: What was measured.
    """

    def __init__(self, sequence: Sequence):
        self.sequence = sequence
        truth = read_truth(sequence)
        self.truth = None if truth is None else known_distance(truth)
        self._cameras = [camera_of(sequence, n) for n in range(sequence.frames)]
        self._decoded = Held(HELD)

    def camera(self, n: int) -> Camera:
        """The camera of a raw frame."""
        return self._cameras[n]

    def closed_form(self, n: int) -> Float[np.ndarray, "H W"] | None:
        """Distance decoded from the quartet of a raw frame [m]; None: it is not complete."""
        i = n // self.sequence.cycle
        if i not in self.sequence.complete_quartets:
            return None
        decode = functools.partial(closed_form_distance, self.sequence, i)
        return self._decoded.of(i, lambda: decode().astype(np.float32))

    def amplitude(self, n: int) -> Float[np.ndarray, "H W"] | None:
        """Length of the measured phasor of its quartet [quad units]; None: not complete."""
        i = n // self.sequence.cycle
        if i not in self.sequence.complete_quartets:
            return None
        return np.hypot(*quartet_phasor(self.sequence, i))

    def true_distance(self, n: int) -> Float[np.ndarray, "H W"] | None:
        """True distance [m], NaN where unknown; None without ground truth."""
        if self.truth is None or not np.isfinite(self.truth[n]).any():
            return None
        return self.truth[n]

    @functools.cached_property
    def distance_scale(self) -> pictures.Scale:
        """One scale for all distances: that of the truth, else of closed forms."""
        distances = self._some(self.true_distance) or self._some(self.closed_form)
        return pictures.distance_scale(distances)

    @functools.cached_property
    def error_scale(self) -> pictures.Scale:
        """One scale for all errors: that of closed forms."""

        def error(n: int) -> Float[np.ndarray, "H W"] | None:
            decoded, truth = self.closed_form(n), self.true_distance(n)
            return None if decoded is None or truth is None else np.abs(decoded - truth)

        return pictures.error_scale(self._some(error))

    @functools.cached_property
    def quad_scale(self) -> pictures.Scale:
        """One scale for all quads."""
        return pictures.signed_scale(self._some(lambda n: self.sequence.quads[n]))

    @functools.cached_property
    def width(self) -> float:
        """Width of the view [m] at the largest distance of the scale."""
        return self.distance_scale.high * self.sequence.width / self.camera(0).fx

    def _some(
        self, image: Callable[[int], Float[np.ndarray, "H W"] | None]
    ) -> list[Float[np.ndarray, "H W"]]:
        """Known values of a function of the raw frame, at a few of them."""
        chosen = np.linspace(0, self.sequence.frames - 1, SAMPLED).astype(int)
        images = [image(n) for n in sorted({*chosen.tolist()})]
        return [one for one in images if one is not None]


class Held(OrderedDict):
    """The values that were used last, at most ``size``."""

    def __init__(self, size: int):
        super().__init__()
        self.size = size

    def of(self, key: Any, make: Callable[[], Any]) -> Any:
        """The value of a key, made if it is not there."""
        if key not in self:
            self[key] = make()
            if len(self) > self.size:
                self.popitem(last=False)
        self.move_to_end(key)
        return self[key]
