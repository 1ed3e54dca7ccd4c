"""Which motion keys a batch depends on, and with which interpolation weights."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ..scene.motion import Motion
from .observations import Observations
from .terms import View


class Blending:
    """Keys and interpolation weights of the images of one run."""

    def __init__(self, observations: Observations, motion: Motion):
        """Count the keys of every batch.

        Args:
            observations: What is compared.
            motion: The motion model.
        """
        self.observations, self.motion = observations, motion
        self.counts = {
            flow: max(len(self.keys_of(batch, flow=flow)) for batch in observations.batches)
            for flow in (False, True)
        }
        """Largest number of keys of a batch, without and with flow."""

    def quartet_of(self, frame: int) -> int:
        """The quartet of a raw frame."""
        return frame // self.observations.sequence.cycle

    def time_of(self, view: View, frame: int) -> float:
        """When a view is rendered [s]."""
        if view == View.COLOUR:
            return float(self.observations.sequence.times[frame])
        if view == View.FLOW:
            return self.motion.times[self.quartet_of(frame)]
        return self.observations.time_at(frame)

    def keys_of(self, frames: list[int], *, flow: bool) -> list[int]:
        """All keys that a batch depends on, in order."""
        colour = [frame for frame in frames if frame in self.observations.colour]
        times = [self.time_of(View.TOF, frame) for frame in frames]
        times += [self.time_of(View.COLOUR, frame) for frame in colour]
        if flow:
            quartets = {self.quartet_of(frame) + step for frame in frames for step in (0, 1, -1)}
            times += [self.motion.times[i] for i in quartets if 0 <= i < len(self.motion.times)]
        return sorted({key for time in times for key in self.motion.keys_at(time).index})

    def weights(
        self, view: View, frame: int, keys: list[int], *, flow: bool
    ) -> Float[np.ndarray, "D K"]:
        """Interpolation weights of a view: at its time, then, with flow, of both flows.

        Those of a flow are weights at its end minus those at its start; zero beyond the recording.
        """
        rows = [self._at(self.time_of(view, frame), keys)]
        if flow and view != View.COLOUR:
            times, quartet = self.motion.times, self.quartet_of(frame)
            start = self._at(times[quartet], keys)
            for end in (quartet + 1, quartet - 1):
                known = 0 <= end < len(times)
                rows.append(self._at(times[end], keys) - start if known else 0.0 * start)
        return np.stack(rows)

    def _at(self, time: float, keys: list[int]) -> np.ndarray:
        """Weight of every key at a time."""
        result, needed = np.zeros(len(keys)), self.motion.keys_at(time)
        for key, weight in zip(needed.index, needed.weight, strict=True):
            result[keys.index(key)] += weight  # the first of repeated ones
        return result
