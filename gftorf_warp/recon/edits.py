"""Runs whose Gaussians were changed after the reconstruction: their motion, and their folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from ..data.files import atomic_folder
from ..errors import InputError, UsageError
from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from . import checkpoint, densify, folder
from .optimiser import Optimiser
from .settings import Method
from .state import from_dict, to_dict

EDITED = "edited_from"
"""Key of config.json: the folder of the run that was edited."""


def binding_of(
    field: GaussianField,
    rows: Int[Tensor, "N"] | None,
    before: GaussianField,
    motion: Motion,
    binding: Float[Tensor, "B M"],
) -> Float[Tensor, "N M"]:
    """Binding (:meth:`Motion.bind`) of the Gaussians of an edited field to the motion of a run.

    Args:
        field: The edited Gaussians.
        rows: Which of the ``before`` each of them moves like; None: as many, in their order.
        before: The Gaussians of the run.
        motion: Its motion.
        binding: Of the ``before``.

    Raises:
        ValueError: If a Gaussian is not finite, the field has other tensors than before or lives
            elsewhere, or ``rows`` does not fit.
    """
    if not len(before):
        raise ValueError("this run has no Gaussians to edit: nothing was fitted")
    names, wanted = [*field.tensors()], [*before.tensors()]
    if names != wanted or field.device != before.device:
        raise ValueError(
            f"field has {names} on {field.device}, the run {wanted} on {before.device}"
        )
    field.check_finite()
    count = len(before) if rows is None else len(rows)
    if len(field) != count:
        raise ValueError(
            f"field has {len(field)} Gaussians, must have {count}, or state their rows"
        )
    if rows is not None and len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < len(before):
        raise ValueError(f"rows must be in 0..{len(before) - 1}")
    if motion.follows_means:
        return motion.bind(field)
    return binding if rows is None else binding[rows.to(binding.device)]


def save(
    run: Path,
    out: Path,
    config: Mapping[str, Any],
    field: GaussianField,
    motion: Motion,
    binding: Float[Tensor, "N M"],
) -> None:
    """Write an edited run: the newest state of ``run`` with other Gaussians and zero moments.

    Args:
        run: The folder of the run that was edited.
        out: A new or empty folder.
        config: Of the run.
        field: Its Gaussians now.
        motion: Their motion.
        binding: Their binding to it.

    Raises:
        InputError: If ``run`` has no checkpoint any more that can be read.
        UsageError: If the run is of another method, or ``out`` is not empty or cannot be written.
        ResourceError: If the disk is full.
    """
    method = Method(config["settings"].get("method", Method.GAUSSIANS))
    if method != Method.GAUSSIANS:
        why = f"its method is {method}, and what is stored is an edited run of Gaussians"
        raise UsageError("the run has no Gaussians", where=run, why=why, fix="copy its folder")
    stored = checkpoint.last(run, field.device)
    if stored is None:
        why = "a run is stored with the state of the one it is from, which holds Gaussians"
        fix = "restore its folder"
        raise InputError("no checkpoint", where=run, why=why, fix=fix)
    with checkpoint.rebuilding(run):
        state = from_dict(stored, field.device)
    state = replace(
        state,
        optimiser=Optimiser(field, motion, betas=state.optimiser.betas),
        motion=motion,
        binding=binding,
        statistics=densify.start(field),
    )
    with atomic_folder(out) as partial:
        folder.write_config(partial, {**config, EDITED: str(run.resolve())})
        checkpoint.save(partial, to_dict(state))


def check_finite(run: Path, field: GaussianField, motion: Motion) -> None:
    """Check what a checkpoint holds.

    Raises:
        InputError: If a Gaussian or a parameter of the motion is NaN or infinite.
    """
    why = None
    try:
        field.check_finite()
    except ValueError as error:
        why = str(error)
    for name, value in motion.named_parameters():
        if why is None and not bool(value.isfinite().all()):
            why = f"{name} of the motion is not finite"
    if why is not None:
        fix = "restore an older checkpoint, or start over with `gftorf reconstruct` and --fresh"
        raise InputError("the run is not finite", where=run, why=why, fix=fix)
