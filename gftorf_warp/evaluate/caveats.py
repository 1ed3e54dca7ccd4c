"""Caveats: what a reader of the numbers of a comparison has to know about its run and its truth."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..data.decode import unambiguous_range
from ..data.sequence import Sequence, Truth
from ..data.truth import known_distance

LOG = logging.getLogger("gftorf_warp")


def caveats(config: Mapping[str, Any], sequence: Sequence, truth: Truth | None) -> list[str]:
    """Sentences for metrics.json and the report, which are logged as warnings; usually none.

    Args:
        config: Content of the run's config.json, with what :meth:`Run.open` adds.
        sequence: What the run was made from.
        truth: What it is scored against; None: unknown.
    """
    sentences = [
        _damaged(config),
        _edited(config),
        _tried_again(config.get("attempts")),
        *(
            f"{window}: {_tried_again(attempts)}"
            for window, attempts in config.get("attempts_of_windows", {}).items()
        ),
        _beyond_range(sequence, truth),
    ]
    texts = [text for text in sentences if text]
    for text in texts:
        LOG.warning("%s", text)
    return texts


def _damaged(config: Mapping[str, Any]) -> str:
    """About checkpoints that could not be read."""
    damaged = config.get("damaged_checkpoints")
    if not damaged:
        return ""
    state = f"image {config['images_optimised']} of {config['images']}"
    return f"Damaged: {', '.join(damaged)}. This is the state of the checkpoint before, {state}."


def _edited(config: Mapping[str, Any]) -> str:
    """About a run that was edited, which no command repeats."""
    source = config.get("edited_from")
    return f"Its Gaussians were edited after the reconstruction in {source}." if source else ""


def _tried_again(attempts: list[dict[str, Any]] | None) -> str:
    """About a fit that failed, and the one that followed it."""
    if not attempts:
        return ""
    each = ", ".join(
        f"{one['start']}: {100 * (one['unexplained_share'] or 0.0):.2g} % of the pixels are not "
        "explained"
        for one in attempts
    )
    kept = next(one["attempt"] for one in attempts if one["kept"])
    return f"The first fit failed and was repeated from another start ({each}); fit {kept} stays."


def _beyond_range(sequence: Sequence, truth: Truth | None) -> str:
    """About true distances beyond the unambiguous range."""
    if truth is None:
        return ""
    distance, most = known_distance(truth), unambiguous_range(sequence)
    known = np.isfinite(distance)
    share = float((distance[known] > most).mean()) if known.any() else 0.0
    if not share:
        return ""
    return (
        f"{100 * share:.3g} % of the true distances lie beyond the unambiguous range of "
        f"{most:.4g} m: distances that are decoded from quads are wrapped there."
    )
