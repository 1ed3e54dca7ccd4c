"""Named, deterministic scenes on which renderers are compared, and how far float32 may stray from
float64.

A case is small on purpose: 24x20 pixels, at most 60 Gaussians. ``inputs`` and ``outputs`` name
everything that can be differentiated and everything that comes out, so that a test over all of them
cannot forget one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.render import reference
from gftorf_warp.render.api import Background, Rendering
from gftorf_warp.render.buffers import (
    ClampGradient,
    Distortion,
    RenderSettings,
    SplatDistance,
    Stop,
    Support,
)
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion as Lens
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor

SENSOR_SCALARS = ("f_mod_hz", "phase_offset", "dc_offset", "source_intensity")
OUTPUTS = ("quads", "phasor", "colour", "distance", "opacity", "distortion", "extra")
SENSOR = Sensor(phase_offset=0.4, dc_offset=0.3, source_intensity=1.5)
SETTINGS = RenderSettings(near=0.2, far=20.0)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One scene; tensors are float32 on the CPU, and float64 copies of them are exact."""

    field: GaussianField
    camera: Camera
    sensor: Sensor = SENSOR
    settings: RenderSettings = SETTINGS
    background: Background | None = None
    extra: Tensor | None = None

    def inputs(
        self, dtype: torch.dtype, device: str = "cpu", grad: bool = True
    ) -> dict[str, Tensor]:
        """Fresh leaves of everything that can be differentiated, by name."""
        tensors = dict(self.field.parameters())
        if self.extra is not None:
            tensors["extra"] = self.extra
        for name in ("quads", "phasor", "colour"):
            if self.background is not None and getattr(self.background, name) is not None:
                tensors[f"background.{name}"] = getattr(self.background, name)
        for name in SENSOR_SCALARS:
            # float32 first, so that all dtypes start equal
            tensors[name] = torch.tensor(getattr(self.sensor, name))
        return {
            name: value.detach().float().to(device=device, dtype=dtype).clone().requires_grad_(grad)
            for name, value in tensors.items()
        }

    def render(
        self, rasterize: Callable[..., Rendering], inputs: dict[str, Tensor], **options
    ) -> Rendering:
        """The case with ``inputs`` in place of its own tensors, by the kernels or by the oracle."""
        layer = self.field.layer
        field = GaussianField(
            **{name: value for name, value in inputs.items() if name in self.field.parameters()},
            layer=None if layer is None else layer.to(inputs["mean"].device),
        )
        lights = {
            name.split(".")[1]: value
            for name, value in inputs.items()
            if name.startswith("background.")
        }
        sensor = replace(
            self.sensor, **{name: inputs[name] for name in SENSOR_SCALARS if name in inputs}
        )
        background = Background(**lights) if self.background is not None else None
        extra = {"background": background, "extra": inputs.get("extra")}
        return rasterize(field, self.camera, sensor, self.settings, **extra, **options)

    def outputs(
        self, rasterize: Callable[..., Rendering], inputs: dict[str, Tensor], **options
    ) -> dict[str, Tensor]:
        """The images of :meth:`render` that exist, by name."""
        rendering = self.render(rasterize, inputs, **options)
        images = {name: getattr(rendering, name) for name in OUTPUTS}
        return {name: image for name, image in images.items() if image is not None}


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far a result may be from the float64 oracle."""

    image: float
    """Largest error of a pixel, as a part of the largest pixel of that image."""
    image_floor: float
    """Error of a pixel that is allowed in any image, of values of the order of 1."""
    distortion: float
    """Largest error of the distortion, as a part of the square of the largest distance (1 for the
    released one)."""
    gradient: float
    """Largest error of a gradient's element, as a part of its largest element."""
    gradient_norm: float
    """Length of a gradient's error, as a part of the length of the gradient."""
    scalar: float
    """Error of the gradient of a sensor scalar (of the frequency: of its logarithm), as a part of
    that gradient."""
    floor: float
    """Error of any gradient's element that is allowed whatever its size, under cotangents of the
    order of 1."""


TOLERANCES = {
    # eps is 6e-8. A pixel sums tens of terms, and an exponent carries the rounding of an image
    # position, 2e-6 of 50 px, times its slope: 1e-6 where there is light, 1e-5 in an image that
    # shows but a tail (slope 6 per px, the worst of thousands of random scenes; most images are
    # good to 1e-6). A quad whose cosine is near zero has the error of a full one: its floor.
    # Distortion is the small difference A V - M^2 of numbers of the size of d^2, good to eps. A
    # gradient's weight T is restored back to front by dividing by 1 - alpha, which may be 0.01 and
    # is good to eps: some 6e-6 for every clamped layer; a sum over hundreds of pixels of both signs
    # costs another digit. Again most gradients are good to 1e-6. A sensor scalar sums all pixels
    # and all Gaussians; what is left can be 1 % of the terms: yet another digit. The floor of
    # gradients is eps times terms of the order of d^2 that cancel, in the gradient of a distortion
    # near zero.
    torch.float32: Tolerance(
        image=2e-5,
        image_floor=1e-7,
        distortion=2e-6,
        gradient=1e-4,
        gradient_norm=1e-4,
        scalar=5e-4,
        floor=5e-6,
    ),
    # Another order of the same sums: eps is 1e-16, and the losses are the same.
    torch.float64: Tolerance(
        image=1e-13,
        image_floor=1e-15,
        distortion=1e-13,
        gradient=1e-12,
        gradient_norm=1e-12,
        scalar=1e-11,
        floor=1e-13,
    ),
}
# at most this share of the pixels may sit on a jump (undecided_pixels) and be left out
UNDECIDED_SHARE = 0.02


def cotangents(images: dict[str, Tensor], undecided: Tensor, seed: int = 0) -> dict[str, Tensor]:
    """A random derivative of the loss for every image, float32,
    0 at the pixels that sit on a jump.
    """
    generator = torch.Generator().manual_seed(seed)
    return {
        name: (torch.randn(image.shape, generator=generator) * ~undecided).to(image.device)
        for name, image in images.items()
    }


def gaussians(
    n: int,
    camera: Camera,
    *,
    seed: int,
    z: tuple[float, float] = (1.0, 5.0),
    scale: tuple[float, float] = (0.04, 0.3),
    opacity: tuple[float, float] = (0.1, 0.6),
    reflectivity: tuple[float, float] = (0.3, 0.9),
    spread: float = 1.0,
    colour: bool = True,
) -> GaussianField:
    """N Gaussians in front of ``camera``, anisotropic, at any angle, each brighter from some sides
    than from others.

    ``z`` [m] and ``scale`` [m] are ranges, centres fill ``spread`` times the image.
    """
    rng = np.random.default_rng(seed)
    depth = rng.uniform(*z, n)
    x = (0.5 + spread * rng.uniform(-0.5, 0.5, n)) * camera.width
    y = (0.5 + spread * rng.uniform(-0.5, 0.5, n)) * camera.height
    local = np.stack(
        [(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth], 1
    )
    chance = rng.uniform(*opacity, n)
    sides = torch.from_numpy(rng.normal(0.0, 0.1, (n, 16)))
    hues = torch.from_numpy(rng.normal(0.0, 0.15, (n, 16, 3)))
    sides[:, 0] = constant_sh(torch.from_numpy(rng.uniform(*reflectivity, n)))[:, 0]
    return GaussianField(
        mean=torch.from_numpy(
            (local - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3]
        ),
        log_scale=torch.from_numpy(np.log(np.exp(rng.uniform(*np.log(scale), (n, 3))))),
        quaternion=torch.from_numpy(rng.normal(size=(n, 4))),
        opacity_logit=torch.from_numpy(np.log(chance / (1 - chance))),
        reflectivity_sh=sides,
        colour_sh=hues if colour else None,
    ).map(lambda tensor: tensor.float())


def light(camera: Camera, shifts: int, *, seed: int, colour: bool = True) -> Background:
    """A random background for every pixel and channel."""
    generator = torch.Generator().manual_seed(seed)
    size = camera.height, camera.width
    quads, phasor, rgb = (2 * torch.rand(c, *size, generator=generator) - 1 for c in (shifts, 3, 3))
    return Background(quads=quads, phasor=phasor, colour=rgb if colour else None)


def channels(field: GaussianField, count: int, *, seed: int = 7) -> Tensor:
    """``count`` extra channels per Gaussian."""
    return torch.randn(len(field), count, generator=torch.Generator().manual_seed(seed))


def pose(
    axis: tuple[float, float, float], angle: float, translation: tuple[float, float, float]
) -> np.ndarray:
    """A rigid motion [4, 4]: by ``angle`` [rad] about ``axis``, then by ``translation`` [m]."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    motion = np.eye(4)
    motion[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    motion[:3, 3] = translation
    return motion


def sphere() -> tuple[Tensor, Tensor]:
    """Points [P, 3] and weights [P] that integrate products of harmonics exactly: Gauss in z,
    even in azimuth.
    """
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    ring, circle = np.sqrt(1 - z**2)[:, None], np.ones(16)
    points = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z[:, None] * circle], -1)
    return torch.from_numpy(points.reshape(-1, 3)), torch.from_numpy(
        np.repeat(weight, 16) * 2 * np.pi / 16
    )


def moved_world(
    case: Case, axis: tuple[float, ...], angle: float, translation: tuple[float, ...]
) -> Case:
    """The same scene and camera in a world that was turned by ``angle`` [rad] about ``axis`` and
    shifted [m].
    """
    motion = pose(axis, angle, translation)
    rotation, shift = torch.from_numpy(motion[:3, :3]), torch.from_numpy(motion[:3, 3])
    points, weight = sphere()
    turned, still = (
        reference.spherical_harmonics(points, 3),
        reference.spherical_harmonics(points @ rotation, 3),
    )
    # coefficients of the turned function, by projection
    harmonics = turned.T @ (weight[:, None] * still)
    half = angle / 2
    w1, v1 = (
        math.cos(half),
        torch.from_numpy(math.sin(half) * np.asarray(axis) / np.linalg.norm(axis)),
    )
    field = case.field.map(lambda tensor: tensor.double())
    w2, v2 = field.quaternion[:, :1], field.quaternion[:, 1:]
    v1 = v1.expand(len(field), 3)
    moved = replace(
        field,
        mean=field.mean @ rotation.T + shift,
        quaternion=torch.cat(
            [w1 * w2 - (v1 * v2).sum(1, keepdim=True), w1 * v2 + w2 * v1 + v1.cross(v2, dim=1)], 1
        ),
        reflectivity_sh=field.reflectivity_sh @ harmonics.T,
        colour_sh=None
        if field.colour_sh is None
        else torch.einsum("ij,njc->nic", harmonics, field.colour_sh),
    )
    camera = case.camera.at(case.camera.camera_from_world @ np.linalg.inv(motion))
    dtype = case.field.mean.dtype
    return replace(case, field=moved.map(lambda tensor: tensor.to(dtype)), camera=camera)


SMALL = Camera.from_fov(24, 20, 60.0)
POSED = Camera(
    width=50,
    height=37,
    fx=41.0,
    fy=46.0,
    cx=21.3,
    cy=20.9,
    camera_from_world=pose((1, 2, -0.5), 0.7, (0.2, -0.4, 0.3)),
)


def translucent() -> Case:
    """Everything shines through everything; all outputs and all inputs exist."""
    field = gaussians(40, SMALL, seed=1)
    return Case(
        field=field, camera=SMALL, background=light(SMALL, 4, seed=1), extra=channels(field, 3)
    )


def opaque() -> Case:
    """Most pixels stop early, some Gaussians are hidden altogether; no colour, no background."""
    field = gaussians(60, SMALL, seed=2, scale=(0.3, 0.8), opacity=(0.6, 0.97), colour=False)
    return Case(field=field, camera=SMALL, extra=channels(field, 1))


def saturated() -> Case:
    """Opacity above 0.99, hence clamped alpha around the centres, some of it behind a veil."""
    field = gaussians(40, SMALL, seed=3, scale=(0.3, 0.8), opacity=(0.9995, 0.9999))
    field.opacity_logit[::2] = torch.linspace(-2.0, 0.0, 20)
    return Case(field=field, camera=SMALL, background=light(SMALL, 4, seed=3))


def outside() -> Case:
    """Off-screen on both sides of the guard of the projection, behind the camera,
    nearer than near, beyond far.
    """
    field = gaussians(48, SMALL, seed=4, z=(0.8, 3.0), scale=(0.2, 0.6), spread=2.2)
    field.mean[:4, 2] *= -1.0
    field.mean[4:6, 2] = 0.1
    field.mean[6:8, 2] = 30.0
    return Case(
        field=field, camera=SMALL, background=light(SMALL, 4, seed=4), extra=channels(field, 6)
    )


def dark() -> Case:
    """Half of the reflectivities, and many colours, are clamped at 0:
    they occlude without a light of their own.
    """
    field = gaussians(40, SMALL, seed=5, reflectivity=(-0.4, 0.5))
    return Case(
        field=replace(field, colour_sh=field.colour_sh * 3.0),
        camera=SMALL,
        background=light(SMALL, 4, seed=5),
    )


def posed() -> Case:
    """A turned and moved camera, principal point off the middle, two focal lengths, 50x37 pixels,
    five shifts.
    """
    field = gaussians(60, POSED, seed=6)
    sensor = Sensor(
        shifts=(0.3, 1.1, 2.9, 4.0, 5.5), phase_offset=-0.9, dc_offset=1.0, source_intensity=0.7
    )
    background = light(POSED, 5, seed=6)
    return Case(
        field=field, camera=POSED, sensor=sensor, background=background, extra=channels(field, 7)
    )


BENT = replace(POSED, distortion=Lens(k1=-0.25, k2=0.08, p1=0.02, p2=-0.03, k3=-0.01))


def distorted() -> Case:
    """A lens that bends by up to five pixels, also far outside of what it sees,
    where its tangent goes on.
    """
    field = gaussians(80, BENT, seed=16, z=(0.8, 3.0), scale=(0.2, 1.0), spread=4.0)
    return Case(
        field=field, camera=BENT, background=light(BENT, 4, seed=16), extra=channels(field, 2)
    )


def three_shifts() -> Case:
    """Three taps at 30 MHz, 33x9 pixels, numbers as background, extra with no channel at all."""
    camera = Camera.from_fov(33, 9, 70.0)
    field = gaussians(30, camera, seed=7, colour=False)
    sensor = Sensor(
        f_mod_hz=30e6, shifts=tuple(2 * math.pi / 3 * i for i in range(3)), dc_offset=0.5
    )
    background = Background(
        quads=torch.tensor(0.3), phasor=torch.tensor([[[0.1]], [[-0.2]], [[0.4]]])
    )
    return Case(
        field=field, camera=camera, sensor=sensor, background=background, extra=channels(field, 0)
    )


def needles() -> Case:
    """Thirty times as long as wide, at any angle; a few as small as a tenth of a pixel."""
    field = gaussians(50, SMALL, seed=8, scale=(0.01, 0.3), opacity=(0.3, 0.9))
    return Case(field=field, camera=SMALL, background=light(SMALL, 4, seed=8))


def coplanar() -> Case:
    """All centres at one z-depth: the order is that of the memory."""
    field = gaussians(20, SMALL, seed=9, z=(2.0, 2.0), scale=(0.1, 0.4), opacity=(0.3, 0.8))
    return Case(field=field, camera=SMALL, extra=channels(field, 2))


def behind_surface() -> Case:
    """Twenty thin layers, a dense wide one, and twenty-four behind it at T = 1e-3:
    E summed forward loses digits.
    """
    n = 45
    field = gaussians(n, SMALL, seed=10, scale=(0.8, 1.5), opacity=(0.05, 0.1), spread=0.3)
    field.mean[:, 2] = torch.linspace(1.0, 5.0, n)
    field.opacity_logit[20], field.log_scale[20] = 4.2, 2.0
    return Case(field=field, camera=SMALL, background=light(SMALL, 4, seed=10))


def smooth() -> Case:
    """Six Gaussians, each larger than the image, none on a jump anywhere:
    finite differences work with any step.
    """
    field = gaussians(
        6, SMALL, seed=11, z=(2.0, 5.0), scale=(3.0, 5.0), opacity=(0.2, 0.6), spread=0.5
    )
    return Case(
        field=field, camera=SMALL, background=light(SMALL, 4, seed=11), extra=channels(field, 2)
    )


def tiles() -> Case:
    """A few wide Gaussians, cut by the released code's 3-sigma tiles:
    at the edges alpha is up to 0.011.
    """
    field = gaussians(6, POSED, seed=15, z=(2.0, 4.0), scale=(0.4, 0.6), opacity=(0.8, 0.98))
    settings = replace(SETTINGS, support=Support.SIGMA3_TILE16)
    return Case(field=field, camera=POSED, settings=settings, background=light(POSED, 4, seed=15))


def released() -> Case:
    """Every switch of the published code at once: tiles, exclusive stop, straight gradient, zeta,
    single phasor.
    """
    field = gaussians(
        50, POSED, seed=12, scale=(0.3, 0.9), opacity=(0.5, 0.9999), reflectivity=(-0.1, 0.8)
    )
    settings = RenderSettings(
        near=0.5,
        far=7.4,
        phasor_factor=1.0,
        support=Support.SIGMA3_TILE16,
        stop=Stop.EXCLUSIVE,
        clamp_gradient=ClampGradient.STRAIGHT,
        distortion=Distortion.RELEASED,
    )
    return Case(field=field, camera=POSED, settings=settings, background=light(POSED, 4, seed=12))


PLANES = replace(SETTINGS, splat_distance=SplatDistance.PLANE)


def sloped() -> Case:
    """Every pixel of a splat has its own distance; round enough that none is clamped."""
    field = gaussians(60, POSED, seed=17, scale=(0.12, 0.3))
    background = light(POSED, 4, seed=17)
    return Case(
        field=field,
        camera=POSED,
        settings=PLANES,
        background=background,
        extra=channels(field, 7),
    )


def sloped_distorted() -> Case:
    """The same through a lens."""
    field = gaussians(60, BENT, seed=18, z=(1.0, 3.0), scale=(0.1, 0.2), spread=1.2)
    return Case(
        field=field,
        camera=BENT,
        settings=PLANES,
        background=light(BENT, 4, seed=18),
        extra=channels(field, 2),
    )


def single() -> Case:
    """One Gaussian."""
    field = gaussians(1, SMALL, seed=13, spread=0.3, z=(2.0, 2.0), scale=(0.2, 0.4))
    return Case(
        field=field, camera=SMALL, background=light(SMALL, 4, seed=13), extra=channels(field, 3)
    )


def empty() -> Case:
    """No Gaussian at all: background alone."""
    field = gaussians(0, SMALL, seed=14)
    return Case(
        field=field, camera=SMALL, background=light(SMALL, 4, seed=14), extra=channels(field, 3)
    )


CASES: dict[str, Callable[[], Case]] = {
    make.__name__: make
    for make in (
        translucent,
        opaque,
        saturated,
        outside,
        dark,
        posed,
        distorted,
        sloped,
        sloped_distorted,
        three_shifts,
        needles,
        coplanar,
        behind_surface,
        smooth,
        tiles,
        released,
        single,
        empty,
    )
}
assert CANONICAL_SHIFTS == Sensor().shifts, "the backgrounds above have four quads"
