"""What a rendering reads and fills, as Warp arrays by name."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields

import warp as wp


@dataclass(kw_only=True, eq=False)
class Inputs:
    """Differentiable inputs as Warp arrays of one device; None: absent or no gradient wanted."""

    mean: wp.array | None  # [N] vec3
    log_scale: wp.array | None  # [N] vec3
    quaternion: wp.array | None  # [N] vec4
    opacity_logit: wp.array | None  # [N]
    reflectivity_sh: wp.array | None  # [N, 16]
    colour_sh: wp.array | None = None  # [N, 16] vec3
    # [4] phase slope [rad/m], phase offset [rad], source intensity, DC offset
    calibration: wp.array | None
    background_quads: wp.array | None = None  # [Q, H, W]
    background_phasor: wp.array | None = None  # [3, H, W]
    background_colour: wp.array | None = None  # [3, H, W]
    extra: wp.array | None = None  # [N, D]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """Camera and shifts of a rendering in device memory; without a derivative."""

    camera: wp.array
    """[1] CameraView."""
    shifts: wp.array
    """[Q] vec2, (cos, sin) of the phase shifts."""
    lens: bool
    """Whether the camera distorts: another kernel projects."""


@dataclass(kw_only=True, eq=False)
class Images:
    """Images of a rendering, row-major; None: not wanted, in a gradient set zero."""

    quads: wp.array | None  # [Q, H, W]
    phasor: wp.array | None  # [3, H, W]
    colour: wp.array | None = None  # [3, H, W]
    distance: wp.array | None  # [H, W]
    opacity: wp.array | None  # [H, W]
    distortion: wp.array | None  # [H, W]
    distance_median: wp.array | None = None  # [H, W] without a derivative
    extra: wp.array | None = None  # [D, H, W]


DIFFERENTIABLE = ("quads", "phasor", "distance", "opacity", "distortion")
"""Those of ``CHOICES`` that have a derivative: what is rendered by default."""
CHOICES = (*DIFFERENTIABLE, "distance_median")
"""Images that a rendering may do without; colour and extra depend on what there is to render."""


def shapes_of(quads: int, height: int, width: int, extra: int = 0) -> dict[str, tuple[int, ...]]:
    """Shape of every image by name, of so many quads and extra channels."""
    planes = {"quads": quads, "phasor": 3, "colour": 3, "extra": extra}
    return dict.fromkeys(CHOICES, (height, width)) | {
        name: (n, height, width) for name, n in planes.items()
    }


def wanted_images(names: Collection[str]) -> frozenset[str]:
    """Names of the requested images.

    Raises:
        ValueError: If one is not in ``CHOICES``.
    """
    unknown = [name for name in names if name not in CHOICES]
    if unknown:
        raise ValueError(f"there is no image {unknown[0]!r} to ask for, only {', '.join(CHOICES)}")
    return frozenset(names)


def names_of(kind: type) -> list[str]:
    """Names of the fields of :class:`Inputs` or :class:`Images`, in order."""
    return [f.name for f in fields(kind)]


def present_in(group: Inputs | Images) -> dict[str, wp.array]:
    """The arrays that are not None, by name."""
    return {
        name: getattr(group, name)
        for name in names_of(type(group))
        if getattr(group, name) is not None
    }


def gradients_in(group: Inputs | Images) -> dict[str, wp.array]:
    """The gradients of the arrays that have one, by name."""
    return {name: array.grad for name, array in present_in(group).items() if array.requires_grad}


def channel_groups(inputs: Inputs) -> list[tuple[str, int]]:
    """(image, first channel) of each group of three T-weighted channels."""
    groups = [("colour", 0)] if inputs.colour_sh is not None else []
    if inputs.extra is not None:
        groups += [("extra", start) for start in range(0, inputs.extra.shape[1], 3)]
    return groups
