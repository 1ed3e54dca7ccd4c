"""What is viewed: a recording, with a run of it or without."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ..data.folder import format_or_none
from ..data.read import read
from ..data.sequence import Sequence
from ..errors import InputError
from ..recon.folder import CONFIG
from ..recon.residuals import Residuals, quad_of_shift
from ..recon.run import Run
from .recording import Held, Recording
from .state import State, newest

LOG = logging.getLogger("gftorf_warp")
RENDERED = ("quads", "phasor", "distance", "opacity")
HELD = 160  # raw frames whose renderings are kept: more than the plot of a pixel shows
HELD_BYTES = 2.5e8  # fewer of large images


class Subject:
    """A recording and, if there is one, the newest state of a run of it.

    Args:
        sequence: What was measured.
        run: The reconstruction; None: the sequence alone is viewed.
        path: The folder that was named.
        moved: Where the sequence of the run is now; None: where it was.
    """

    def __init__(
        self, sequence: Sequence, run: Run | None, path: Path, moved: str | Path | None = None
    ):
        self.sequence, self.path, self.recording = sequence, path, Recording(sequence)
        self._moved = moved
        self.state: State | None = None
        self._take(run)

    @classmethod
    def open(
        cls,
        path: str | Path,
        device: torch.device | str = "cpu",
        *,
        sequence: str | Path | None = None,
    ) -> Subject:
        """Read a run or a sequence.

        Args:
            path: Folder of one of the two.
            device: Where the run is rendered.
            sequence: Where the sequence of the run is now; None: where it was.

        Raises:
            InputError: If the folder is neither, or cannot be read.
        """
        path = Path(path)
        if (path / CONFIG).is_file():
            run = _opened(path, device, sequence)
            return cls(run.sequence(), run, path, sequence)
        if format_or_none(path) is None:
            why = f"there is no {CONFIG} of a run, and no capture.json, tofType0 or tof"
            fix = "name the --out folder of `gftorf reconstruct`, or the folder of a sequence"
            raise InputError("neither a run nor a sequence", where=path, why=why, fix=fix)
        return cls(read(path), None, path)

    def _take(self, run: Run | None) -> None:
        """Render this run from now on."""
        bytes_each = 4 * self.sequence.quads[0].size * (2 + self.sequence.cycle)
        self.run, self._rendered = run, Held(min(HELD, int(HELD_BYTES / bytes_each) + 1))
        self.state = None if run is None else newest(self.path)
        first, *further = self.sequence.frequencies
        self._renderers = {}
        if run is not None:
            self._renderers[first] = run.renderer(RENDERED, corrected=False)
            for f in further:
                self._renderers[f] = run.renderer(RENDERED, f_mod_hz=f, corrected=False)
        self.__dict__.pop("residuals", None)  # of the run before

    def reload(self) -> bool:
        """Read the newest checkpoint if there is a newer one than before; whether there was."""
        if self.run is None or (state := newest(self.path)) == self.state:
            return False
        try:
            run = _opened(self.path, self.run.field.device, self._moved)
        except InputError as error:  # it is written again in a moment, or started over
            LOG.warning("the newest checkpoint was not read: %s", error.what)
            self.state = state
            return False
        self._take(run)
        return True

    @property
    def frames(self) -> int:
        """Number F of raw frames."""
        return self.sequence.frames

    @property
    def finished(self) -> bool:
        """Whether the run has seen all of its images."""
        config = {} if self.run is None else self.run.config
        return config.get("images_optimised", 0) >= config.get("images", 0)

    @property
    def has_gaussians(self) -> bool:
        """Whether there is a run, and it has Gaussians."""
        return self.run is not None and len(self.run.field) > 0

    def rendered(self, n: int, f_mod_hz: float | None = None) -> Mapping[str, np.ndarray]:
        """Images of the run at a raw frame: ``distance`` [m], ``opacity`` [1] and ``slots``
        [K, H, W], the quads at the shift of every slot of a cycle, all at one frequency.

        Args:
            n: The raw frame.
            f_mod_hz: Modulation frequency [Hz]; None: that of the raw frame.
        """
        f = float(self.sequence.frame_frequencies[n]) if f_mod_hz is None else f_mod_hz
        return self._rendered.of((n, f), lambda: self._render(n, f))

    @torch.no_grad()
    def _render(self, n: int, f: float) -> dict[str, np.ndarray]:
        assert self.run is not None, "a sequence alone has nothing to render"
        time, camera = float(self.sequence.times[n]), self.recording.camera(n)
        fit = image = self._renderers[f](time, camera)
        # corrections of a run that goes on would be decided anew for every state
        if self.finished and f == self.sequence.frequencies[0]:
            image = self.run.corrected(fit, time, camera)
        arrays = {k: getattr(image, k).cpu().numpy().copy() for k in ("distance", "opacity")}
        shifts = self.sequence.shifts[: self.sequence.cycle]
        slots = [quad_of_shift(fit, self.run.sensor, float(shift)) for shift in shifts]
        return arrays | {"slots": np.stack([slot.cpu().numpy() for slot in slots])}

    def ours(self, n: int) -> Mapping[str, np.ndarray] | None:
        """Images of the run at the first frequency, see :meth:`rendered`; None: there is no
        run.
        """
        return None if self.run is None else self.rendered(n, self.sequence.frequencies[0])

    @functools.cached_property
    def residuals(self) -> Residuals | None:
        """How well the run explains the quads; None where it was not fitted to them."""
        return None if self.run is None else self.run.explained

    def chi_square(self, n: int) -> Float[np.ndarray, "h w"] | None:
        """Of the quartet of a raw frame [1], at the size of the fit; None: not known."""
        residuals, i = self.residuals, n // self.sequence.cycle
        if residuals is None or not residuals.noisy or i not in residuals.quartets:
            return None
        return residuals.chi_square[residuals.quartets.index(i)]


def _opened(path: Path, device: torch.device | str, sequence: str | Path | None) -> Run:
    """A run whose sequence may be in another folder than it was."""
    run = Run.open(path, device)
    return run if sequence is None else run.linked(sequence)
