"""The volumes by method, made for a recording or read from a checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ...errors import InputError
from ..settings import Method
from .ftorf import Ftorf
from .grid_volume import GridVolume
from .settings import VolumeSettings
from .targets import Targets
from .torf import Torf
from .volume import Box, Volume, box_of

VOLUMES: dict[Method, type[Volume]] = {kind.method: kind for kind in (Torf, Ftorf, GridVolume)}
"""All final classes of Volume."""


def new_volume(
    method: Method, settings: VolumeSettings, targets: Targets, seed: int, device: torch.device
) -> Volume:
    """A volume with random networks."""
    generator = torch.Generator().manual_seed(seed)
    return VOLUMES[method](settings, box_of(targets, settings), generator).to(device)


def volume_from_dict(
    run: Path,
    method: Method,
    settings: VolumeSettings,
    stored: dict[str, Any],
    device: torch.device | str,
) -> Volume:
    """The volume of a checkpoint.

    Args:
        run: Folder of the run, for messages.
        method: ``torf``, ``ftorf`` or ``volume``.
        settings: How it is sampled.
        stored: The checkpoint; its ``volume`` is what :meth:`Volume.to_dict` returned.
        device: Where it is wanted.

    Raises:
        InputError: If the checkpoint is of another kind of run, or a parameter is not finite.
    """
    generator = torch.Generator().manual_seed(0)  # its numbers are replaced
    try:
        volume = VOLUMES[method](settings, Box(**stored["volume"]["box"]), generator)
        volume.load_state_dict(stored["volume"]["weights"])
    except (LookupError, TypeError, ValueError, RuntimeError) as error:
        why = f"it holds no networks of the shape in config.json: {str(error).splitlines()[0]}"
        fix = "restore config.json and ckpt/ from one copy, or start over with --fresh"
        raise InputError("the checkpoint does not fit", where=run, why=why, fix=fix) from error
    for name, value in volume.named_parameters():
        if not bool(value.isfinite().all()):
            fix = "restore an older checkpoint, or start over with --fresh"
            why = f"{name} of the volume is not finite"
            raise InputError("the run is not finite", where=run, why=why, fix=fix)
    return volume.to(device)
