"""Public entry point of the renderer: documented, validated once, then handed to the bridge."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..scene.camera import Camera
from ..scene.gaussians import GaussianField
from ..scene.sensor import Sensor, uploaded
from .bridge import IMAGES, INPUTS, Rasterize, Request, left_out
from .buffers import RenderSettings, Workspace
from .control import DeviceCamera, check
from .inputs import CHOICES, DIFFERENTIABLE, wanted_images


@dataclass(frozen=True, kw_only=True, eq=False)
class Background:
    """Light behind all Gaussians, added as T_e * background; a missing field is black.

    Each field is broadcast to its image, so a number, [C, 1, 1] or [C, H, W] all work; all are
    differentiable.

    >>> import torch
    >>> from gftorf_warp import Background
    >>> blue = Background(colour=torch.tensor([0.0, 0.0, 1.0])[:, None, None])
    """

    quads: Tensor | None = None
    """[Q, H, W] in quad units."""
    phasor: Tensor | None = None
    """[3, H, W] in quad units."""
    colour: Tensor | None = None
    """[3, H, W] linear RGB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """Images of one rendering. With w = alpha T, and T_e the transmittance behind the last splat.

    An image that was not requested has no elements. Distance is a sum of weights, too short where
    the opacity is below 1:

    >>> import torch
    >>> from gftorf_warp import Camera, GaussianField, Sensor, rasterize
    >>> from gftorf_warp.scene.gaussians import constant_sh
    >>> ball = GaussianField(
    ...     mean=torch.tensor([[0.0, 0.0, 3.0]]),
    ...     log_scale=torch.full((1, 3), 0.2).log(),
    ...     quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
    ...     opacity_logit=torch.zeros(1),
    ...     reflectivity_sh=constant_sh(torch.tensor([0.8])),
    ... )
    >>> camera = Camera.from_fov(65, 49, horizontal_fov_deg=60.0)
    >>> images = rasterize(ball, camera, Sensor(), images=("distance", "opacity"))
    >>> images.distance[24, 32].item(), images.opacity[24, 32].item(), len(images.phasor)
    (1.5, 0.5, 0)
    """

    quads: Float[Tensor, "Q H W"]
    """Sum of w T a (cos(psi - shift) + b), plus T_e times the background."""
    phasor: Float[Tensor, "3 H W"] | Float[Tensor, "0 H W"]
    """(re, im, amplitude): sum of w T 2a (cos psi, sin psi, 1), plus T_e times the background."""
    colour: Float[Tensor, "3 H W"] | None
    """Sum of w c, plus T_e times the background; None if the field has no colour."""
    distance: Float[Tensor, "H W"] | Float[Tensor, "0 W"]
    """Sum of w d [m], *not* divided by the opacity."""
    opacity: Float[Tensor, "H W"] | Float[Tensor, "0 W"]
    """Sum of w = 1 - T_e [1]."""
    distortion: Float[Tensor, "H W"] | Float[Tensor, "0 W"]
    """Sum over all pairs of w_k w_l (d_k - d_l)^2 [m^2], or as the settings say."""
    distance_median: Float[Tensor, "H W"] | Float[Tensor, "0 W"]
    """Distance of the splat at which the transmittance falls below one half [m], 0 where it does
    not; without a derivative."""
    extra: Float[Tensor, "D H W"] | None
    """Sum of w times the extra channels; no background."""
    screen: ScreenGradient | None
    """Filled by the backward pass if it was requested."""
    source: UInt8[Tensor, "H W"] | None = None
    """Where the distance is from, see recon/fallback.py; None: from the Gaussians everywhere."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScreenGradient:
    """Statistics of the last backward pass for densification; zero before it."""

    values: Float[Tensor, "N 4"]
    """All columns."""

    @property
    def gradient(self) -> Float[Tensor, "N 2"]:
        """Derivative of the loss by the image position of each Gaussian [1/px]."""
        return self.values[:, :2]

    @property
    def pixels(self) -> Float[Tensor, "N"]:
        """Number of pixels each Gaussian contributed to."""
        return self.values[:, 2]

    @property
    def weight(self) -> Float[Tensor, "N"]:
        """Sum of its weights w = alpha T in them [px]: how much of the image it is."""
        return self.values[:, 3]


def rasterize(
    field: GaussianField,
    camera: Camera,
    sensor: Sensor,
    settings: RenderSettings = RenderSettings(),
    *,
    background: Background | None = None,
    extra: Float[Tensor, "N D"] | None = None,
    extra_detached: bool = False,
    images: Collection[str] = DIFFERENTIABLE,
    screen_gradient: bool = False,
    workspace: Workspace | None = None,
    control: DeviceCamera | None = None,
) -> Rendering:
    """Render Gaussians into everything a C-ToF pixel could record (paper, equations 3-5).

    A field with a parameter that is NaN or infinite is refused. In one of many renderings, with
    ``workspace``, ``control`` or a pair capacity, where nothing may wait for the device, it is
    drawn instead: NaN where a Gaussian has a reflectivity or colour that is NaN, and everywhere if
    its position, size, orientation or opacity is not finite.

    Runs on the device of the field. Differentiable in every tensor of the field except its layer,
    in ``background``, ``extra`` and the 0-d tensors of the sensor.

    Args:
        field: N Gaussians, float32.
        camera: Where from; light and camera coincide.
        sensor: Its modulation, offsets and shifts; noise is not applied here.
        settings: How.
        background: Light from behind everything; None is black.
        extra: D more channels per Gaussian, composited like colour, for example 3D motion [m].
        extra_detached: Whether gradients of the extra images reach ``extra`` only. All weights are
            held fixed under them, as if a detached field were rendered a second time for them;
            other images are as they were.
        images: Which of quads, phasor, distance, opacity, distortion and distance_median are
            wanted; what is left out saves its time, above all distortion.
        screen_gradient: Whether ``Rendering.screen`` is wanted.
        workspace: Memory of consecutive renderings of one size; None: each rendering allocates its
            own.
        control: Pose, intrinsics, calibration and shifts in device memory, in place of those of
            ``camera`` and ``sensor``, whose size, kind of lens and number of shifts still count;
            None: they are uploaded.

    Raises:
        ValueError: If a tensor is not float32 or lives elsewhere than the field, a parameter of the
            field is not finite, or there is no such image.

    Example: a Gaussian 3 m away, its distance in the middle of the image, and the derivative of
    that by its three coordinates.

    >>> import torch
    >>> from gftorf_warp import Camera, GaussianField, Sensor, rasterize
    >>> from gftorf_warp.scene.gaussians import constant_sh
    >>> centre = torch.tensor([[0.0, 0.0, 3.0]], requires_grad=True)
    >>> ball = GaussianField(
    ...     mean=centre,
    ...     log_scale=torch.full((1, 3), 0.2).log(),
    ...     quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
    ...     opacity_logit=torch.zeros(1),
    ...     reflectivity_sh=constant_sh(torch.tensor([0.8])),
    ... )
    >>> camera = Camera.from_fov(65, 49, horizontal_fov_deg=60.0)
    >>> images = rasterize(ball, camera, Sensor())
    >>> images.quads.shape
    torch.Size([4, 49, 65])
    >>> distance = images.distance[24, 32] / images.opacity[24, 32]
    >>> distance.backward()
    >>> round(distance.item(), 3), [round(x, 3) + 0.0 for x in centre.grad[0].tolist()]
    (3.0, [0.0, 0.0, 1.0])
    """
    count, size = len(field), (camera.height, camera.width)
    tensors: dict[str, Tensor | None] = dict.fromkeys(INPUTS)
    tensors |= field.parameters()
    if extra is not None:
        if extra.ndim != 2 or len(extra) != count:
            want = f"(N, D) with N = {count}, the length of the field"
            raise ValueError(f"extra {tuple(extra.shape)} must be {want}")
        tensors["extra"] = extra if extra.shape[1] else None
    background = background or Background()
    channels = {"quads": len(sensor.shifts), "phasor": 3, "colour": 3}
    for name, number in channels.items():
        value = getattr(background, name)
        if value is not None and not (name == "colour" and field.colour_sh is None):
            label, shape = f"background.{name}", (number, *size)
            tensors[f"background_{name}"] = _spread(label, value, shape, field)
    if control is not None:
        check(control, len(sensor.shifts), field.device)
    tensors["calibration"] = _calibration(sensor, field) if control is None else control.calibration
    for name, tensor in tensors.items():
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device != field.device):
            want = f"float32 on {field.device}, where the field is"
            raise ValueError(f"{name} is {tensor.dtype} on {tensor.device}, must be {want}")
    if control is None and workspace is None and settings.pair_capacity is None:
        field.check_finite()
    screen = torch.zeros(count, 4, device=field.device) if screen_gradient else None
    ordered = [None if t is None else t.contiguous() for t in (tensors[name] for name in INPUTS)]
    request = Request(
        camera=camera,
        shifts=tuple(float(shift) for shift in sensor.shifts),
        settings=settings,
        screen=screen,
        images=wanted_images(images),
        workspace=workspace,
        control=control,
        extra_detached=extra_detached,
    )
    rendered = dict(zip(IMAGES, Rasterize.apply(request, *ordered), strict=True))
    for name in CHOICES:
        if rendered[name] is None:
            rendered[name] = left_out(name, field.mean, *size)
    if extra is not None and rendered["extra"] is None:
        rendered["extra"] = extra.new_zeros(0, *size)
    return Rendering(**rendered, screen=None if screen is None else ScreenGradient(values=screen))


def _spread(
    name: str, value: Tensor | float, shape: tuple[int, ...], field: GaussianField
) -> Tensor:
    """A background as [C, H, W]."""
    if isinstance(value, Tensor):
        tensor = value.to(device=field.device, dtype=torch.float32)
    else:  # filled on the device: an upload would synchronise
        tensor = torch.full((), float(value), dtype=torch.float32, device=field.device)
    try:
        return tensor.expand(shape)
    except RuntimeError:
        raise ValueError(f"{name} {tuple(tensor.shape)} cannot be broadcast to {shape}") from None


def _calibration(sensor: Sensor, field: GaussianField) -> Tensor:
    """[4] phase slope [rad/m], phase offset [rad], source intensity, DC offset; uploaded once."""
    values = sensor.calibration
    if any(isinstance(value, Tensor) for value in values):
        like = field.mean
        return torch.stack(
            [torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in values]
        )
    return uploaded(values, torch.float32, field.device)
