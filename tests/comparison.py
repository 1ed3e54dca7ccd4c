"""What comparisons with the oracle have in common: devices, bounds, and gradients by name."""

import torch
from cases import SENSOR_SCALARS, TOLERANCES, UNDECIDED_SHARE, Case, cotangents
from torch import Tensor
from torch.testing import assert_close

from gftorf_warp.render import api, reference
from gftorf_warp.render.buffers import Distortion

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]

TOLERANCE = TOLERANCES[torch.float32]

# cases in which every output and every input exists
FULL = ("translucent", "posed", "outside", "distorted", "sloped", "sloped_distorted")


class Comparison:
    """One case by kernel and by oracle, from equal inputs."""

    def __init__(self, case: Case, device: str):
        """Render both."""
        self.case = case
        undecided = reference.undecided_pixels(case.field, case.camera, case.settings)
        assert undecided.double().mean() <= UNDECIDED_SHARE
        self.exact, self.inputs = case.inputs(torch.float64), case.inputs(torch.float32, device)
        self.want, self.got = (
            case.outputs(reference.rasterize, self.exact),
            case.outputs(api.rasterize, self.inputs),
        )
        self.weight, self.decided = cotangents(self.want, undecided), ~undecided

    def check_images(self) -> None:
        """Every image, at every pixel that does not sit on a jump."""
        assert self.got.keys() == self.want.keys()
        for name, want in self.want.items():
            got = self.got[name].detach().cpu()
            assert got.dtype == torch.float32
            assert got.shape == want.shape, name
            if want.numel() == 0:
                continue
            bound = TOLERANCE.image * want.abs().max().item() + TOLERANCE.image_floor
            if name == "distortion":
                metric = self.case.settings.distortion is Distortion.PAPER
                scale = self.want["distance"].max().item() ** 2 if metric else 1.0
                bound = TOLERANCE.distortion * scale + TOLERANCE.image_floor
            assert torch.isfinite(got).all(), name
            assert ((got - want).abs() * self.decided).max() <= bound, name

    def check_gradients(self, *outputs: str) -> dict[str, Tensor]:
        """Derivatives of the randomly weighted ``outputs`` by every input;
        those of the oracle are returned.
        """
        results = []
        for images, inputs in ((self.want, self.exact), (self.got, self.inputs)):
            loss = sum(
                (images[name] * self.weight[name].to(images[name])).sum() for name in outputs
            )
            gradients = torch.autograd.grad(
                loss, [*inputs.values()], retain_graph=True, allow_unused=True
            )
            results.append(
                {
                    name: torch.zeros_like(value) if gradient is None else gradient
                    for (name, value), gradient in zip(inputs.items(), gradients, strict=True)
                }
            )
        for name, want in results[0].items():
            check_gradient(name, results[1][name], want, self.exact[name])
        return results[0]


def check_gradient(name: str, got: Tensor, want: Tensor, value: Tensor) -> None:
    """One gradient, element by element and as a whole."""
    assert got.dtype == torch.float32
    assert got.shape == want.shape, name
    if want.numel() == 0:
        return
    assert torch.isfinite(got).all(), name
    # by the logarithm of the frequency
    scale = value.detach().item() if name == "f_mod_hz" else 1.0
    want, error = want * scale, (got.cpu() - want) * scale
    scalar = name in SENSOR_SCALARS
    part = TOLERANCE.scalar if scalar else TOLERANCE.gradient
    assert error.abs().max() <= part * want.abs().max() + TOLERANCE.floor, name
    if not scalar:
        assert error.norm() <= TOLERANCE.gradient_norm * want.norm() + TOLERANCE.floor, name


def magnitude(name: str, gradient: Tensor, value: Tensor) -> float:
    """Largest element, in a unit in which every gradient of the cases is of the order of 1."""
    return (
        gradient.abs().max() * (value.detach().abs().max() if name == "f_mod_hz" else 1.0)
    ).item()


def gradients_of(
    images: dict[str, Tensor], inputs: dict[str, Tensor], seed: int = 0, **options
) -> dict[str, Tensor]:
    """Gradients of randomly weighted images by all inputs that need them."""
    decided_everywhere = torch.zeros(images["opacity"].shape, dtype=torch.bool)
    weight = cotangents(images, decided_everywhere, seed)
    wanted = {name: value for name, value in inputs.items() if value.requires_grad}
    loss = sum((images[name] * weight[name]).sum() for name in images)
    return dict(zip(wanted, torch.autograd.grad(loss, [*wanted.values()], **options), strict=True))


def same(got: dict[str, Tensor], want: dict[str, Tensor], exact: bool) -> None:
    """Equal gradients: to the bit on the CPU; on CUDA atomics add in any order."""
    assert got.keys() == want.keys()
    for name, value in want.items():
        if exact:
            assert torch.equal(got[name], value), name
        else:
            assert_close(got[name], value, rtol=1e-4, atol=1e-5 * value.abs().max().item() + 1e-12)
