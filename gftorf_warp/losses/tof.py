"""Errors of what a C-ToF pixel recorded, quads or the two parts of a phasor (method, section 5)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def quad_error(
    rendered: Float[Tensor, "*q H W"], measured: Float[Tensor, "*q H W"]
) -> Float[Tensor, "*q H W"]:
    """Squared difference of quads, in squared quad units; the L2 part of the quad loss is its mean.

    Raises:
        ValueError: If the shapes differ: broadcasting would compare a quad with the slots that were
            not measured.
    """
    if rendered.shape != measured.shape:
        raise ValueError(
            f"rendered {tuple(rendered.shape)} and measured {tuple(measured.shape)} "
            f"must have one shape"
        )
    return (rendered - measured).square()
