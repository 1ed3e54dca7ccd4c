"""The oracle of displaced Gaussians: plain torch, any precision, differentiated by autograd."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from ..scene.gaussians import product
from ..scene.motion import KeyMotion


def displaced(
    mean: Float[Tensor, "N 3"],
    quaternion: Float[Tensor, "N 4"],
    motion: KeyMotion,
    weights: Float[Tensor, "R K"],
    *,
    channels: bool,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"], Float[Tensor, "N C"] | None]:
    """Oracle of :func:`gftorf_warp.render.displacement.displaced`."""
    offsets = torch.einsum("rk,knc->rnc", weights, motion.offset)
    turned = quaternion
    if motion.rotation is not None:
        turned = product(torch.einsum("k,knc->nc", weights[0], motion.rotation), quaternion)
    return mean + offsets[0], turned, torch.cat([*offsets[1:]], dim=1) if channels else None
