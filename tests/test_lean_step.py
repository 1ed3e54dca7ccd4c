"""Flow loss and the end of a step as kernels, against plain torch in float64 and Adam of torch."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from comparison import DEVICES
from plain_step import plain_flow_error

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
    """Where from, and the cameras at the ends of two flows: at rest,
    or moving with other lenses.
    """
    height, width = size
    first = Camera.from_fov(width, height, 60.0, camera_from_world=pose(0.3, [0.1, -0.2, 0.5]))
    if kind == "rest":
        return first, [first, first]
    if kind == "bent":  # both through one lens, or the later one without
        first = replace(
            first, distortion=Distortion(k1=-0.12, k2=0.05, p1=0.02, p2=-0.03, k3=-0.01)
        )
        turned = first.at(pose(0.9, [0.15, -0.2, 0.55]))
        return first, [turned, replace(turned, distortion=Distortion())]
    turned = first.at(pose(0.36, [0.15, -0.2, 0.55]))
    lens = {"fx": 1.3 * first.fx, "fy": 0.9 * first.fy, "cx": 0.4 * width, "cy": 0.6 * height}
    other = Camera(
        width=width, height=height, camera_from_world=pose(0.27, [0.0, -0.1, 0.4]), **lens
    )
    return first, [turned, other]


def views(first, later, device):
    """Cameras as kernels read them."""
    return torch.from_numpy(fused.flow_cameras(first, later)).to(device)


def flow_case(size, device):
    """Distances, one of them nothing, displacements, and three rows of flows with unknown
    pixels.
    """
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
    """Value and gradient to 2e-5 of their size, the row read from memory,
    unknown pixels without a gradient.
    """
    distance, displacement, measured = flow_case(size, device)
    first, later = cameras(size, kind)
    leaf = displacement.requires_grad_()
    row = torch.tensor([1], dtype=torch.int32, device=device)
    loss = fused.flow_loss(distance, leaf, measured, views(first, later, device), row=row)
    (gradient,) = torch.autograd.grad(3.0 * loss, leaf)
    exact = displacement.detach().double().cpu().requires_grad_()
    rays = torch.from_numpy(first.centre), first.rays(dtype=torch.float64)
    want = plain_flow_error(
        distance.double().cpu(), exact, list(measured[1].double().cpu()), first, later, rays
    )
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
    table = views(*cameras((36, 48), "moving"), device)
    leaf = displacement.requires_grad_()
    (gradient,) = torch.autograd.grad(fused.flow_loss(distance, leaf, measured, table), leaf)
    direction, h = gradient / gradient.abs().max(), 2e-3
    ends = [
        fused.flow_loss(distance, displacement.detach() + s * h * direction, measured, table)
        for s in (1, -1)
    ]
    slope = float(ends[0].double() - ends[1].double()) / (2 * h)
    assert slope == pytest.approx(float((gradient * direction).sum()), rel=5e-3)


def test_flows_that_do_not_fit_are_refused():
    """Shapes and precision are checked before any kernel reads them."""
    table = views(*cameras((4, 5), "rest"), "cpu")
    flow = torch.zeros(1, 2, 2, 4, 5)
    with pytest.raises(ValueError, match=r"displacement \(3, 4, 5\)"):
        fused.flow_loss(torch.ones(4, 5), torch.zeros(3, 4, 5), flow, table)
    with pytest.raises(ValueError, match="float32"):
        fused.flow_loss(torch.ones(4, 5), torch.zeros(6, 4, 5), flow.double(), table)


class Descent:
    """Tensors of a field and a motion, one of them without a gradient,
    and torch's steps of the same.
    """

    shapes = ((700, 3), (37,), (5, 4, 3), (3000,), (64, 33), (1,))
    rates = (1e-3, 5e-2, 3e-2, 1e-4, 1e-2, 2e-3)
    motion_from = 3
    absent = 2
    # three terms: the last one is not computed
    weights = (1.0, 1.0, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0)

    def __init__(self, device, images):
        """Zero moments."""
        self.device, self.images = device, images
        self.generator = torch.Generator().manual_seed(1)
        self.values = [self.draw(shape) for shape in self.shapes]
        self.moments = [
            (torch.zeros((), device=device), torch.zeros_like(x), torch.zeros_like(x))
            for x in self.values
        ]
        self.table = descent.AdamTable(self.values, self.moments)
        self.output = descent.StepResults.empty(4, 3, torch.device(device))
        self.twins = [value.clone().requires_grad_() for value in self.values]
        groups = [
            {"params": [twin], "lr": rate}
            for twin, rate in zip(self.twins, self.rates, strict=True)
        ]
        self.adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, fused=True)

    def draw(self, shape):
        """Normal values."""
        return torch.randn(shape, generator=self.generator).to(self.device)

    def step(self, gradients, longest, *results, pairs=(5, 5, 5, 5), capacity=9, rates=None):
        """One by kernels; ``gradients`` are one to four lists, ``results`` those of every image,
        or of all alike.
        """
        counts = torch.tensor(pairs[: self.images], dtype=torch.int32, device=self.device)
        self.table.point(gradients, counts.split(1))
        self.table.send()
        self.output.results[: self.images] = torch.tensor([*results], device=self.device)
        descent.descend(
            self.table,
            torch.tensor(rates or self.rates, device=self.device),
            self.output,
            torch.tensor([self.weights] * 4, device=self.device),
            torch.tensor([float(self.images)], device=self.device),
            images=self.images,
            motion_from=self.motion_from,
            motion_gradient_max=longest,
            capacity=capacity,
            betas=(0.9, 0.999),
            epsilon=1e-15,
        )

    def kept(self):
        """Copies of everything that a step may change."""
        return [
            x.clone()
            for value, kept in zip(self.values, self.moments, strict=True)
            for x in (value, *kept)
        ]


RESULTS = (2.0, 0.25, 0.5, 4.0, math.nan, math.nan, math.nan, math.inf, 0.0)
VALID = (1.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("images", [1, 4])
@pytest.mark.parametrize("longest", [None, 1.0, 1e4])
def test_a_descent_is_mean_clipping_and_adam_of_torch(device, images, longest):
    """Ten steps: every tensor, moment and count; a tensor without a gradient is left alone, step
    included.

    Gradients come as one to four lists, which are summed; results of weight 0 are not read.
    """
    case = Descent(device, images)
    for n in range(10):
        lists = [[case.draw(shape) for shape in case.shapes] for _ in range(n % 4 + 1)]
        for drawn in lists:
            drawn[case.absent] = None
        if len(lists) > 1:
            lists[1][0] = None  # zero
        for k, twin in enumerate(case.twins):
            present = [drawn[k] for drawn in lists if drawn[k] is not None]
            twin.grad = torch.stack(present).sum(dim=0) / images if present else None
        if longest is not None:
            torch.nn.utils.clip_grad_norm_(case.twins[case.motion_from :], longest)
        case.adam.step()
        case.step(lists, longest, RESULTS)
    for n, (value, twin, (step, first, _)) in enumerate(
        zip(case.values, case.twins, case.moments, strict=True)
    ):
        torch.testing.assert_close(value, twin.detach(), rtol=1e-5, atol=1e-6)
        assert float(step) == (0 if n == case.absent else 10)
        if n != case.absent:
            torch.testing.assert_close(
                first, case.adam.state[twin]["exp_avg"], rtol=1e-4, atol=1e-6
            )
    names = ("quads", "flow", "absent", *descent.TOTAL_NAMES)
    sums = dict(zip(names, case.output.sums.tolist(), strict=True))
    each = {"quads": 2.0, "flow": 2.0, "absent": 0.0, "quad_mse": 0.25, "opacity": 0.5, "loss": 4.0}
    want = {name: pytest.approx(10 * images * value) for name, value in each.items()}
    assert sums == want | {"count": 10 * images}
    assert case.output.counts.tolist() == [0, 0, 5, 0]


def test_a_group_of_rate_zero_is_left_alone(device):
    """Values, moments and number of steps; the others are not."""
    case = Descent(device, 1)
    rates = tuple(0.0 if n in (0, 4) else rate for n, rate in enumerate(case.rates))
    before = case.kept()
    case.step([[case.draw(shape) for shape in case.shapes]], None, VALID, rates=rates)
    unchanged = [torch.equal(old, new) for old, new in zip(before, case.kept(), strict=True)]
    assert unchanged == [n // 4 in (0, 4) for n in range(len(unchanged))]


@pytest.mark.parametrize("broken", ["gradient", "motion", "loss", "pairs"])
def test_an_invalid_step_changes_nothing_but_counts(device, broken):
    """Whatever is not finite, and whichever image dropped pairs;
    the next valid step ends the row.
    """
    case = Descent(device, 2)
    drawn = [case.draw(shape) for shape in case.shapes]
    case.step([drawn], 1.0, VALID)
    before, sums = case.kept(), case.output.sums.clone()
    bad = [gradient.clone() for gradient in drawn]
    bad[0][699, 2] = math.nan if broken == "gradient" else 0.0
    bad[4][63, 32] = math.inf if broken == "motion" else 0.0
    for _ in range(2):
        second = (math.nan, *VALID[1:]) if broken == "loss" else VALID
        case.step([bad], 1.0, VALID, second, pairs=(5, 10 if broken == "pairs" else 5))
    assert all(torch.equal(old, new) for old, new in zip(before, case.kept(), strict=True))
    assert torch.equal(case.output.sums, sums)
    assert case.output.counts.tolist() == ([2, 2, 10, 2] if broken == "pairs" else [2, 2, 5, 0])
    gradient = torch.zeros(20, device=device)
    screen = ScreenGradient(values=torch.ones(20, 4, device=device))
    descent.add_statistics(
        [screen], (8, 6), case.output, gradient, gradient.clone(), gradient.clone()
    )
    assert not gradient.any()
    case.step([drawn], 1.0, VALID)
    assert case.output.counts.tolist()[:2] == [2, 0]
    assert not torch.equal(before[0], case.values[0])


def test_all_pairs_fit_where_there_is_no_capacity(device):
    """None: memory is allocated after they were counted."""
    case = Descent(device, 1)
    case.step(
        [[case.draw(shape) for shape in case.shapes]], None, VALID, pairs=(1 << 30,), capacity=None
    )
    assert case.output.counts.tolist() == [0, 0, 1 << 30, 0]


def test_tensors_that_do_not_fit_the_table_are_refused():
    """Their addresses would be read as something else;
    and there is memory for so many terms only.
    """
    moments = [(torch.zeros(()), torch.zeros(4), torch.zeros(4))]
    for value in (torch.zeros(4, dtype=torch.float64), torch.zeros(8)[::2]):
        with pytest.raises(ValueError, match="contiguous float32"):
            descent.AdamTable([value], moments)
    table = descent.AdamTable([torch.zeros(4)], moments)
    with pytest.raises(ValueError, match="the shape of the parameter"):
        table.point([[torch.zeros(5)]])
    with pytest.raises(ValueError, match="33 terms, at most 32"):
        descent.StepResults.empty(4, 33, torch.device("cpu"))
    with pytest.raises(ValueError, match="65 renderings, at most 64"):
        table.point([[torch.zeros(4)]], [torch.zeros(1, dtype=torch.int32)] * 65)


@pytest.mark.parametrize("images", [1, 2, 3, 4, 6])
def test_statistics_are_sums_over_images(device, images):
    """Of one to six images: pixels times the screen gradient in half image sizes, pixels,
    weights.
    """
    generator = torch.Generator().manual_seed(0)
    screens = [
        ScreenGradient(values=torch.rand(50, 4, generator=generator).to(device))
        for _ in range(images)
    ]
    start = torch.rand(50, generator=generator).to(device)
    sums = [start.clone() for _ in range(3)]
    descent.add_statistics(
        screens, (30, 20), descent.StepResults.empty(4, 1, torch.device(device)), *sums
    )
    lengths = [
        one.pixels * torch.hypot(15.0 * one.gradient[:, 0], 10.0 * one.gradient[:, 1])
        for one in screens
    ]
    for got, parts in zip(
        sums, (lengths, [s.pixels for s in screens], [s.weight for s in screens]), strict=True
    ):
        torch.testing.assert_close(got, start + torch.stack(parts).sum(dim=0), rtol=1e-5, atol=1e-6)
