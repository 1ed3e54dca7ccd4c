"""Flow loss and the end of a step as kernels, against plain torch in float64 and torch's Adam."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from comparison import DEVICES
from gftorf_warp.recon.objective import flow_between

from gftorf_warp.recon import densify
from gftorf_warp.render import descent, fused
from gftorf_warp.render.api import ScreenGradient
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion

SIZES = [(36, 48), (7, 5), (33, 31)]  # whole warps, less than one, a last one that is not full


@pytest.fixture(params=DEVICES)
def device(request):
    """Where there is a GPU, it is tested, too."""
    return request.param


def pose(angle, shift):
    """A turn about an oblique axis, and a step."""
    axis = np.array([0.6, -0.64, 0.48])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    result = np.eye(4)
    result[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    result[:3, 3] = shift
    return result


def cameras(size, kind):
    """Where from, and the cameras at the ends of two flows: at rest, or moving with other lenses."""
    height, width = size
    first = Camera.from_fov(width, height, 60.0, camera_from_world=pose(0.3, [0.1, -0.2, 0.5]))
    if kind == "rest":
        return first, [first, first]
    if kind == "bent":  # both through one lens, or the later one without
        first = replace(first, distortion=Distortion(k1=-0.12, k2=0.05, p1=0.02, p2=-0.03, k3=-0.01))
        turned = first.at(pose(0.9, [0.15, -0.2, 0.55]))
        return first, [turned, replace(turned, distortion=Distortion())]
    turned = first.at(pose(0.36, [0.15, -0.2, 0.55]))
    lens = {"fx": 1.3 * first.fx, "fy": 0.9 * first.fy, "cx": 0.4 * width, "cy": 0.6 * height}
    other = Camera(width=width, height=height, camera_from_world=pose(0.27, [0.0, -0.1, 0.4]), **lens)
    return first, [turned, other]


def flow_case(size, device):
    """Distances, one of them nothing, displacements, and three rows of flows with unknown pixels."""
    generator = torch.Generator().manual_seed(2)
    distance = 1.0 + 2.0 * torch.rand(size, generator=generator)
    distance[1, 2] = 0.0
    displacement = 0.1 * torch.randn((6, *size), generator=generator)
    displacement[:, 1, 2] *= 1e-7  # of nothing nothing moves
    measured = torch.randn((3, 2, 2, *size), generator=generator)
    measured[1, 0, 0, 3:5, 1:3] = math.nan
    measured[1, 1, 1, 0, 0] = math.inf
    measured[1, :, :, 1, 2] = math.nan
    return distance.to(device), displacement.to(device), measured.to(device)


@pytest.mark.parametrize("kind", ["rest", "moving", "bent"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_loss_of_flow_is_the_oracles(device, size, kind):
    """Value and gradient to 2e-5 of their size, the row read from memory, unknown pixels without a gradient."""
    distance, displacement, measured = flow_case(size, device)
    first, later = cameras(size, kind)
    leaf = displacement.requires_grad_()
    row = torch.tensor([1], dtype=torch.int32, device=device)
    loss = fused.flow_loss(distance, leaf, measured, first, later, row=row)
    (gradient,) = torch.autograd.grad(3.0 * loss, leaf)
    exact = displacement.detach().double().cpu().requires_grad_()
    rays = torch.from_numpy(first.centre), first.rays(dtype=torch.float64)
    want = flow_between(distance.double().cpu(), exact, list(measured[1].double().cpu()), first, later, rays)
    (slope,) = torch.autograd.grad(3.0 * want, exact)
    assert float(loss.detach()) == pytest.approx(float(want.detach()), rel=2e-5)
    scale = float(slope.abs().max())
    assert scale > 0
    torch.testing.assert_close(gradient.double().cpu(), slope, rtol=2e-5, atol=2e-5 * scale)
    assert gradient[:3, 3:5, 1:3].abs().max() == 0
    assert gradient[3:, 0, 0].abs().max() == 0 < gradient[3:, 3:5, 1:3].abs().max()


def test_gradient_of_flow_is_that_of_finite_differences(device):
    """Along the gradient itself, where the slope is the square of its length."""
    distance, displacement, measured = flow_case((36, 48), device)
    first, later = cameras((36, 48), "moving")
    leaf = displacement.requires_grad_()
    (gradient,) = torch.autograd.grad(fused.flow_loss(distance, leaf, measured, first, later), leaf)
    direction, h = gradient / gradient.abs().max(), 2e-3
    ends = [
        fused.flow_loss(distance, displacement.detach() + s * h * direction, measured, first, later) for s in (1, -1)
    ]
    slope = float(ends[0].double() - ends[1].double()) / (2 * h)
    assert slope == pytest.approx(float((gradient * direction).sum()), rel=5e-3)


def test_flows_that_do_not_fit_are_refused():
    """Shapes and precision are checked before any kernel reads them."""
    first, later = cameras((4, 5), "rest")
    flow = torch.zeros(1, 2, 2, 4, 5)
    with pytest.raises(ValueError, match=r"displacement \(3, 4, 5\)"):
        fused.flow_loss(torch.ones(4, 5), torch.zeros(3, 4, 5), flow, first, later)
    with pytest.raises(ValueError, match="float32"):
        fused.flow_loss(torch.ones(4, 5), torch.zeros(6, 4, 5), flow.double(), first, later)


class Descent:
    """Tensors of a field and a motion, one of them without a gradient, and torch's steps of the same."""

    shapes = ((700, 3), (37,), (5, 4, 3), (3000,), (64, 33), (1,))
    rates = (1e-3, 5e-2, 3e-2, 1e-4, 1e-2, 2e-3)
    motion_from = 3
    absent = 2
    weights = (1.0, 1.0, 1.0, 0.5, 0.0, 0.0)

    def __init__(self, device, images):
        """Zero moments."""
        self.device, self.images = device, images
        self.generator = torch.Generator().manual_seed(1)
        self.values = [self.draw(shape) for shape in self.shapes]
        self.moments = [(torch.zeros((), device=device), torch.zeros_like(x), torch.zeros_like(x)) for x in self.values]
        self.table = descent.AdamTable(self.values, [None] * len(self.values), self.moments)
        self.ledger = descent.Ledger.empty(4, torch.device(device))
        self.twins = [value.clone().requires_grad_() for value in self.values]
        groups = [{"params": [twin], "lr": rate} for twin, rate in zip(self.twins, self.rates, strict=True)]
        self.adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, fused=True)

    def draw(self, shape):
        """Normal values."""
        return torch.randn(shape, generator=self.generator).to(self.device)

    def step(self, gradients, longest, pairs=(5, 5, 5, 5), capacity=9, **found):
        """One by kernels; what was found of every image, by name."""
        self.table.point(gradients)
        self.table.send()
        for name, value in found.items():
            self.ledger.found[: self.images, descent.FOUND_NAMES.index(name)] = value
        descent.descend(
            self.table,
            torch.tensor(self.rates, device=self.device),
            self.ledger,
            self.weights,
            motion_from=self.motion_from,
            motion_gradient_max=longest,
            pairs=[torch.tensor([n], dtype=torch.int32, device=self.device) for n in pairs[: self.images]],
            capacity=capacity,
            betas=(0.9, 0.999),
            epsilon=1e-15,
        )

    def kept(self):
        """Copies of everything that a step may change."""
        return [x.clone() for value, kept in zip(self.values, self.moments, strict=True) for x in (value, *kept)]


@pytest.mark.parametrize("images", [1, 4])
@pytest.mark.parametrize("longest", [None, 1.0, 1e4])
def test_a_descent_is_torchs_mean_clip_and_adam(device, images, longest):
    """Ten steps: every tensor, moment and count; a tensor without a gradient is left alone, step included."""
    case = Descent(device, images)
    for _ in range(10):
        drawn = [case.draw(shape) for shape in case.shapes]
        drawn[case.absent] = None
        for twin, gradient in zip(case.twins, drawn, strict=True):
            twin.grad = None if gradient is None else gradient / images
        if longest is not None:
            torch.nn.utils.clip_grad_norm_(case.twins[case.motion_from :], longest)
        case.adam.step()
        case.step(drawn, longest, quads=2.0, flow=4.0, quad_mse=0.25, opacity=0.5, distortion=math.nan)
    for n, (value, twin, (step, first, _)) in enumerate(zip(case.values, case.twins, case.moments, strict=True)):
        torch.testing.assert_close(value, twin.detach(), rtol=1e-5, atol=1e-6)
        assert float(step) == (0 if n == case.absent else 10)
        if n != case.absent:
            torch.testing.assert_close(first, case.adam.state[twin]["exp_avg"], rtol=1e-4, atol=1e-6)
    sums = dict(zip(descent.SUM_NAMES, case.ledger.sums.tolist(), strict=True))
    each = {"quads": 2.0, "flow": 2.0, "quad_mse": 0.25, "opacity": 0.5, "loss": 4.0, "count": 1.0}
    assert sums == {name: pytest.approx(10 * images * each.get(name, 0.0)) for name in sums}
    assert case.ledger.counts.tolist() == [0, 0, 5, 0]


@pytest.mark.parametrize("broken", ["gradient", "motion", "loss", "pairs"])
def test_a_step_that_is_not_sound_changes_nothing_but_counts(device, broken):
    """Whatever is not finite, and whichever image dropped pairs; the next sound step ends the row."""
    case = Descent(device, 2)
    drawn = [case.draw(shape) for shape in case.shapes]
    case.step(drawn, 1.0, quads=1.0, flow=0.0, quad_mse=0.5, opacity=0.5)
    before, sums = case.kept(), case.ledger.sums.clone()
    bad = [gradient.clone() for gradient in drawn]
    bad[0][699, 2] = math.nan if broken == "gradient" else 0.0
    bad[4][63, 32] = math.inf if broken == "motion" else 0.0
    for _ in range(2):
        quads = torch.tensor([1.0, math.nan if broken == "loss" else 1.0], device=device)
        case.step(bad, 1.0, (5, 10 if broken == "pairs" else 5), quads=quads)
    assert all(torch.equal(old, new) for old, new in zip(before, case.kept(), strict=True))
    assert torch.equal(case.ledger.sums, sums)
    assert case.ledger.counts.tolist() == ([2, 2, 10, 2] if broken == "pairs" else [2, 2, 5, 0])
    gradient = torch.zeros(20, device=device)
    screen = ScreenGradient(values=torch.ones(20, 4, device=device))
    descent.observe([screen], (8, 6), case.ledger, gradient, gradient.clone(), gradient.clone())
    assert not gradient.any()
    case.step(drawn, 1.0, quads=1.0)
    assert case.ledger.counts.tolist()[:2] == [2, 0]
    assert not torch.equal(before[0], case.values[0])


@pytest.mark.parametrize("images", [1, 2, 3, 4])
def test_statistics_are_densifications(device, images):
    """Of one to four images."""
    generator = torch.Generator().manual_seed(0)
    screens = [ScreenGradient(values=torch.rand(50, 4, generator=generator).to(device)) for _ in range(images)]
    camera = Camera.from_fov(30, 20, 60.0)
    start = torch.rand(50, generator=generator).to(device)
    names = ["gradient", "pixels", "weight"]
    sums = {name: start.clone() for name in names}
    want = densify.Statistics(**{name: start.clone() for name in names}, earlier=torch.zeros_like(start))
    for screen in screens:
        want = densify.observe(want, screen, camera)
    descent.observe(screens, (30, 20), descent.Ledger.empty(4, torch.device(device)), **sums)
    for name in names:
        torch.testing.assert_close(sums[name], getattr(want, name), rtol=1e-5, atol=1e-6)
