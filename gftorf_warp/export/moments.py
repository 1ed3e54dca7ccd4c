"""The times at which a run is exported, each with its camera and its number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import UsageError
from ..evaluate.views import views_to_take
from ..recon.run import Run
from ..scene.camera import Camera

Progress = Callable[[int, int], None]
"""Called with (moments done, moments in all)."""
DIGITS = 4  # of a file number; viewers that play a sequence sort names as text


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """A run at S increasing times."""

    run: Run
    """The finished reconstruction."""
    times: list[float]
    """Seconds since raw frame 0."""
    frames: list[int | None]
    """The first raw frame at each time; None: it is between raw frames."""
    cameras: list[Camera]
    """The sequence's camera, at the pose of the raw frame nearest to each time."""

    @classmethod
    def of(cls, run: Run, times: Iterable[float] | None = None, every: int = 1) -> Moments:
        """Every n-th instant of the sequence, or given times.

        Args:
            run: A finished reconstruction whose sequence can be read.
            times: Seconds since raw frame 0, any numbers; None: those of the sequence, once each.
            every: Which of the sequence's instants: each, every second, and so on.

        Raises:
            UsageError: If both are given, or there is no time.
            InputError: If the sequence cannot be read.
        """
        sequence = run.sequence()
        instants, first = np.unique(sequence.times, return_index=True)
        if times is not None and every != 1:
            fix = "leave one of the two out"
            why = "--every counts the sequence's own times"
            raise UsageError("times and their number", where="--every", why=why, fix=fix)
        wanted = instants[::every] if times is None else sorted({float(t) for t in times})
        seconds, cameras = views_to_take(run, sequence, wanted, None)
        frame_at = dict(zip(instants.tolist(), first.tolist(), strict=True))
        frames = [frame_at.get(time) for time in seconds]
        return cls(run=run, times=seconds, frames=frames, cameras=cameras)

    def __len__(self) -> int:
        return len(self.times)

    def images(self, names: Iterable[str]) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
        """Images by name as float32 arrays, in the order of the times, as ``Run.images`` has them.

        Colour is left out if the run has none.
        """
        wanted = set(names) - (set() if self.run.has_colour else {"colour"})
        return self.run.images(self.times, self.cameras, sorted(wanted))

    def path(self, folder: Path, index: int, suffix: str) -> Path:
        """File of the index-th time: a common prefix and a number, for viewers of sequences."""
        digits = max(DIGITS, len(str(len(self) - 1)))
        return folder / f"frame_{index:0{digits}d}.{suffix}"

    def about(self, index: int) -> list[str]:
        """Lines about the index-th time for the header of a file."""
        from .. import __version__

        frame = self.frames[index]
        return [
            f"gftorf_warp {__version__}",
            f"time_s {self.times[index]!r}",
            *([] if frame is None else [f"raw_frame {frame}"]),
            "world of the sequence's poses, right-handed, metres",
            "camera axes: x right, y down, z forward",
        ]
