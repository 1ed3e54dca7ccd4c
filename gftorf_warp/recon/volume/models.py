"""The volumes by method, made for a recording or read from a checkpoint."""

from __future__ import annotations

from typing import Any

import torch

from ..settings import Method
from .ftorf import Ftorf
from .settings import VolumeSettings
from .targets import Targets
from .torf import Torf
from .volume import Box, Volume, box_of

VOLUMES: dict[Method, type[Volume]] = {kind.method: kind for kind in (Torf, Ftorf)}
"""All final classes of Volume."""


def new_volume(
    method: Method, settings: VolumeSettings, targets: Targets, seed: int, device: torch.device
) -> Volume:
    """A volume with random networks."""
    generator = torch.Generator().manual_seed(seed)
    return VOLUMES[method](settings, box_of(targets, settings), generator).to(device)


def volume_from_dict(
    method: Method, settings: VolumeSettings, stored: dict[str, Any], device: torch.device | str
) -> Volume:
    """The volume of a checkpoint.

    Args:
        method: ``torf`` or ``ftorf``.
        settings: How it is sampled.
        stored: What :meth:`Volume.to_dict` returned.
        device: Where it is wanted.
    """
    generator = torch.Generator().manual_seed(0)  # its numbers are replaced
    box = stored["box"] | {"bounds": tuple(stored["box"]["bounds"])}
    volume = VOLUMES[method](settings, Box(**box), generator)
    volume.load_state_dict(stored["weights"])
    return volume.to(device)
