"""Gaussians as PLY files with the property names that splat viewers read, one file per time.

    x y z, nx ny nz   centre [m]; zero normals, which readers expect
    f_dc_0 .. 2       constant harmonic of red, green, blue
    f_rest_0 ..       all others, channel by channel; absent if they are zero
    opacity           before the sigmoid
    scale_0 .. 2      natural logarithm of the standard deviations [log m]
    rot_0 .. 3        unit quaternion wxyz

A viewer computes max(0, sum of Y h + 0.5) and shows it as it is. Harmonics are those of linear
colour in the sequence's units, or of the reflectivity, the same in all channels and scaled to 0..1.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..constants import SH_BIAS, SH_Y0
from ..data.files import write_through
from ..scene.gaussians import GaussianField
from ..scene.windows import AWAY
from .moments import Moments, Progress
from .ply import ply_bytes, table

WHITE = 0.99  # quantile of the reflectivity that is shown as 1, so that a highlight darkens nothing
SEEN = 0.1  # opacity from which a Gaussian counts for that


@torch.no_grad()
def write(moments: Moments, folder: Path, progress: Progress, *, colour: str) -> None:
    """Fill a folder with one PLY file per time; see :func:`gaussians_at`."""
    harmonics = colour_harmonics(moments, colour)
    for index in range(len(moments)):
        field = gaussians_at(moments, index, harmonics)
        data = ply_bytes(vertices(field), [*moments.about(index), f"f_dc, f_rest: {colour}"])
        write_through(moments.path(folder, index, "ply"), data)
        progress(index + 1, len(moments))


def colour_harmonics(moments: Moments, colour: str) -> Float[Tensor, "N 16 3"]:
    """Harmonics of what is shown: ``colour`` [units of the sequence], or ``reflectivity`` [1]."""
    field = moments.run.field
    if colour == "colour":
        assert field.colour_sh is not None, "only what a run has is shown"
        return scaled(field.colour_sh, 1.0 / moments.run.colour_scale)
    constant = (field.reflectivity_sh[:, 0] * SH_Y0 + SH_BIAS).clamp_min(0.0)
    seen = constant[field.opacity > SEEN]
    white = float(torch.quantile(seen[:: 1 + len(seen) // 1_000_000], WHITE)) if len(seen) else 0.0
    grey = scaled(field.reflectivity_sh, 1.0 / white if white > 0.0 else 1.0)
    return grey[:, :, None].expand(-1, -1, 3)


def scaled(harmonics: Float[Tensor, "N 16 *c"], factor: float) -> Float[Tensor, "N 16 *c"]:
    """Harmonics of ``factor`` times what they describe, sum of Y h + 0.5."""
    result = factor * harmonics
    result[:, 0] += (factor - 1.0) * SH_BIAS / SH_Y0
    return result


def gaussians_at(moments: Moments, index: int, harmonics: Float[Tensor, "N 16 3"]) -> GaussianField:
    """The Gaussians that exist at the index-th time; ``harmonics`` become their colour."""
    field, exists = at_moment(moments, index)
    present = replace(field, colour_sh=harmonics.cpu())
    return present.map(lambda tensor: tensor[exists])


@torch.no_grad()
def at_moment(moments: Moments, index: int) -> tuple[GaussianField, Bool[Tensor, "N"]]:
    """All Gaussians where they are at the index-th time, on the CPU, and which of them exist then.

    They are as wide as the sequence's own camera has to see them, see ``Run.widened``, so that a
    rendering of them at its size is that of the run.
    """
    run, time = moments.run, moments.times[index]
    field = run.field.moved(*run.motion.at(run.binding, time))
    field = run.widened(field, moments.cameras[index]).map(lambda tensor: tensor.detach().cpu())
    return field, (field.mean.abs() < 0.5 * AWAY).all(dim=1)


def vertices(field: GaussianField) -> np.ndarray:
    """The table of a field with colour; rows with a number that is not finite are left out."""
    assert field.colour_sh is not None, "harmonics of what is shown are its colour"
    colour = field.colour_sh.detach().numpy()
    rest = colour[:, 1 : (degree(colour) + 1) ** 2].transpose(0, 2, 1).reshape(len(field), -1)
    turn = torch.nn.functional.normalize(field.quaternion, dim=1)
    columns = numbered("xyz", field.mean)
    columns |= dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(field), np.float32))
    columns |= numbered("f_dc_", colour[:, 0]) | numbered("f_rest_", rest)
    columns |= {"opacity": field.opacity_logit.numpy()}
    columns |= numbered("scale_", field.log_scale) | numbered("rot_", turn)
    rows = table(columns)
    return rows[np.isfinite(np.stack([*columns.values()])).all(axis=0)]


def numbered(name: str, values: Float[Tensor, "N C"] | np.ndarray) -> dict[str, np.ndarray]:
    """Columns of a table as name_0, name_1 ..; of ``xyz``, one for each letter."""
    columns = np.asarray(values).T
    letters = name if name == "xyz" else [f"{name}{k}" for k in range(len(columns))]
    return dict(zip(letters, columns, strict=True))


def degree(harmonics: Float[np.ndarray, "N 16 C"]) -> int:
    """The highest degree, 0 to 3, with a coefficient that is not zero."""
    used = np.flatnonzero(harmonics.any(axis=(0, 2)))
    return int(np.sqrt(used[-1])) if len(used) else 0
