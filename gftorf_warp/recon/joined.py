"""One rendering out of the runs of several windows of a recording.

A time is rendered by the window whose middle is nearest. Where two neighbours overlap,
images change linearly from one to the other, with weights that sum to one, between the first raw
frame of the later window and the end of the earlier one. Distances do so only where both windows
agree within a step: between a surface and the one behind it there is none.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from ..data.steps import STEP_M
from ..errors import UsageError
from ..render.api import Rendering

FOLDER = "windows"
HELD = 2  # windows that are open at a time: the two on either side of a seam
Opened = TypeVar("Opened")


@dataclass(frozen=True, kw_only=True)
class Window:
    """Whole quartets of a recording that are reconstructed as a run of their own."""

    frames: range
    """Its raw frames."""
    start: float
    """Time of the first of them in the recording [s]."""
    end: float
    """Time at which the raw frame after its last one is or would be taken [s]."""

    @property
    def middle(self) -> float:
        """Time in the middle [s]."""
        return 0.5 * (self.start + self.end)

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Window:
        """A window of config.json."""
        frames = range(int(stored["first"]), int(stored["last"]) + 1)
        return cls(frames=frames, start=float(stored["start_s"]), end=float(stored["end_s"]))

    @property
    def stored(self) -> dict[str, int | float]:
        """What config.json says of it."""
        first, last = self.frames[0], self.frames[-1]
        return {"first": first, "last": last, "start_s": self.start, "end_s": self.end}


def folder_of(run: Path, number: int) -> Path:
    """The folder of a window's own run."""
    return run / FOLDER / f"{number:03d}"


def refused(run: Path) -> UsageError:
    """Why nothing that needs the Gaussians of a run is done to one in windows."""
    why = "each of its windows has Gaussians and a motion of its own"
    fix = f"name the run of one window, for example {folder_of(run, 0)}"
    return UsageError("a run in windows", where=run, why=why, fix=fix)


class Joined(Generic[Opened]):
    """Windows in order of time, of which few are open at once."""

    def __init__(self, windows: list[Window], opened: Callable[[int], Opened]):
        """Nothing is opened yet.

        Args:
            windows: At least one.
            opened: Opens a window by its number, from 0.
        """
        self.windows = windows
        self._opened = functools.lru_cache(maxsize=HELD)(opened)

    def mapped(self, made: Callable[[Opened], Any]) -> Joined[Any]:
        """The same windows with something made from each, as it is needed."""
        return Joined(self.windows, lambda number: made(self._opened(number)))

    def share(self, time: float) -> tuple[int, float]:
        """The window before the seam that is nearest to a time [s], and the share [1] of the
        window behind that seam.
        """
        last = len(self.windows) - 1
        number = max((k for k in range(last) if self.windows[k].middle <= time), default=0)
        if number == last:
            return number, 0.0
        earlier, later = self.windows[number], self.windows[number + 1]
        # of long overlaps the part between the middles: at a middle, one window is alone
        first, end = max(later.start, earlier.middle), min(earlier.end, later.middle)
        if end <= first:
            return number, float(time >= first)
        return number, min(max((time - first) / (end - first), 0.0), 1.0)

    def rendered(self, time: float, image: Callable[[Opened, float], Rendering]) -> Rendering:
        """An image at a time [s] of the recording, from one window or from two.

        Args:
            time: Seconds since raw frame 0 of the recording.
            image: Of an open window, at a time since its own first raw frame [s].
        """
        number, share = self.share(time)
        needed = [k for k, weight in ((number, 1.0 - share), (number + 1, share)) if weight > 0]
        first, *second = (image(self._opened(k), time - self.windows[k].start) for k in needed)
        return blended(first, second[0], share) if second else first


def blended(earlier: Rendering, later: Rendering, share: float) -> Rendering:
    """Two renderings of one view as one.

    Args:
        earlier: A rendering.
        later: Another one, with the same images.
        share: Weight of ``later`` [1], above 0 and below 1.
    """
    nearer, alone = (later, 1.0) if share > 0.5 else (earlier, 0.0)

    def mixed(name: str, weight: float | Tensor = share) -> Any:
        a, b = getattr(earlier, name), getattr(later, name)
        return getattr(nearer, name) if a is None or b is None else a + weight * (b - a)

    def weight_of(name: str) -> Tensor:
        """Weight of ``later`` in each pixel of a distance."""
        apart = getattr(later, name) - getattr(earlier, name)
        weight = torch.full_like(apart, share)
        return torch.where(apart.abs() <= STEP_M, weight, torch.full_like(apart, alone))

    weight = weight_of("distance")
    return replace(
        nearer,
        **{name: mixed(name) for name in ("quads", "phasor", "colour", "distortion", "extra")},
        distance=mixed("distance", weight),
        # distance / opacity has to stay a distance
        opacity=mixed("opacity", weight if weight.shape == earlier.opacity.shape else share),
        distance_median=mixed("distance_median", weight_of("distance_median")),
    )
