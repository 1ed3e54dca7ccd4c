"""A volume, its optimiser and its random numbers, between two steps and in a checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...scene.motion import Products
from ..settings import ReconSettings
from ..state import FORMAT
from .models import new_volume, volume_from_dict
from .settings import VolumeSettings
from .targets import Draw, Targets
from .volume import Volume


class VolumeState:
    """A volume, its optimiser and the random numbers between two steps."""

    def __init__(self, volume: Volume, settings: VolumeSettings, seed: int):
        """Begin at step 0."""
        self.volume, self.images, self.seconds = volume, 0, 0.0
        self.restarts = 0
        """How often the run began again, with another seed."""
        self.optimiser = torch.optim.Adam(
            volume.parameters(), lr=settings.rate, eps=settings.epsilon, fused=True
        )
        half = settings.products == Products.HALF
        self.scaler = torch.amp.GradScaler(volume.device.type, enabled=half)
        self.draw = Draw(seed, volume.device)
        self.sums: dict[str, Tensor] = {}
        """Terms summed over the steps since the last logged row; their memory stays the same."""
        self.counts: dict[str, int] = {}
        """In how many of them each term was."""

    def to_dict(self) -> dict[str, Any]:
        """Tensors and plain values, for a checkpoint."""
        return {
            "format": FORMAT,
            "images": self.images,
            "seconds": self.seconds,
            "restarts": self.restarts,
            "volume": self.volume.to_dict(),
            "adam": self.optimiser.state_dict(),
            "scaler": self.scaler.state_dict(),
            "draw": self.draw.states(),
            "sums": dict(self.sums),
            "counts": dict(self.counts),
        }


def begin(
    settings: ReconSettings, targets: Targets, seed: int, device: torch.device
) -> VolumeState:
    """A run before its first step."""
    assert settings.volume is not None, "presets of volumes have it"
    volume = new_volume(settings.method, settings.volume, targets, seed, device)
    return VolumeState(volume, settings.volume, seed)


def from_dict(
    run: Path, settings: ReconSettings, stored: dict[str, Any], device: torch.device
) -> VolumeState:
    """A run as :meth:`VolumeState.to_dict` stored it; on a CPU it continues to the same bits.

    Raises:
        InputError: If the checkpoint does not fit the settings, or is not finite.
    """
    assert settings.volume is not None, "presets of volumes have it"
    volume = volume_from_dict(run, settings.method, settings.volume, stored, device)
    state = VolumeState(volume, settings.volume, seed=0)
    state.optimiser.load_state_dict(stored["adam"])
    state.scaler.load_state_dict(stored["scaler"])
    state.draw.restore(stored["draw"])
    state.images, state.seconds = stored["images"], stored["seconds"]
    state.restarts = stored.get("restarts", 0)  # those of before had none
    state.counts = dict(stored["counts"])
    state.sums = {name: value.to(volume.device) for name, value in stored["sums"].items()}
    return state
