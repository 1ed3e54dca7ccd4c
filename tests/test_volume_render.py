"""Compositing of neural volumes: against the Gaussian oracle, closed forms, finite differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import turned
from torch.testing import assert_close

from gftorf_warp.recon.volume import composite
from gftorf_warp.recon.volume.composite import Samples
from gftorf_warp.recon.volume.network import TimeCodes, VolumeNetwork
from gftorf_warp.recon.volume.product import linear
from gftorf_warp.recon.volume.rays import Depths, Views, evenly, mean_pose
from gftorf_warp.recon.volume.settings import NetworkSettings, TimeCode
from gftorf_warp.render import reference
from gftorf_warp.render.buffers import RenderSettings
from gftorf_warp.render.inputs import DIFFERENTIABLE
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.encoding import encoded
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor

SENSOR = Sensor(phase_offset=0.4, dc_offset=0.7)
NETWORK = NetworkSettings(
    layers=3, width=16, skip_after=2, position_octaves=3, direction_octaves=2, time_octaves=2
)


def fog(alpha, samples):
    """One ray through a medium of one opacity per sample and of strength 1."""
    distance = torch.linspace(1.0, 4.0, samples, dtype=torch.float64)[None]
    alpha = torch.full_like(distance, alpha)
    return Samples(distance=distance, alpha=alpha, strength=alpha)


def generator(seed=0):
    """Random numbers of a test."""
    return torch.Generator().manual_seed(seed)


def test_light_is_that_of_the_gaussian_oracle():
    """Three Gaussians on the ray of the middle pixel: their opacities are alphas, their centres
    samples, twice their amplitude the strength.
    """
    camera = Camera(width=5, height=5, fx=4.0, fy=4.0, cx=2.5, cy=2.5)
    z = torch.tensor([1.2, 1.9, 3.1], dtype=torch.float64)
    opacity = torch.tensor([0.35, 0.6, 0.8], dtype=torch.float64)
    reflectivity = torch.tensor([0.7, 1.3, 0.9], dtype=torch.float64)
    field = GaussianField(
        mean=torch.stack([0 * z, 0 * z, z], dim=1),
        log_scale=torch.full((3, 3), math.log(0.5), dtype=torch.float64),
        quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(3, 4),
        opacity_logit=torch.logit(opacity),
        reflectivity_sh=constant_sh(reflectivity),
    )
    want = reference.rasterize(
        field,
        camera,
        SENSOR,
        RenderSettings(near=0.1, far=9.0),
        images=(*DIFFERENTIABLE, "distance_median"),
    )
    samples = Samples(
        distance=z[None],
        alpha=opacity[None],
        strength=(opacity * 2.0 * reflectivity / z.square())[None],
    )
    passed = samples.transmittance
    quads = composite.quads(samples, SENSOR, passed)[:, 0]
    assert quads.abs().min() > 0.01
    assert_close(quads, want.quads[:, 2, 2], rtol=1e-6, atol=1e-8)
    found = composite.phasor(samples, SENSOR, passed)[:, 0]
    assert_close(found, want.phasor[:, 2, 2], rtol=1e-6, atol=1e-8)
    distance = composite.expected(samples, passed, samples.distance)[0]
    assert_close(distance, want.distance[2, 2], rtol=1e-6, atol=1e-8)
    median = composite.median_distance(samples, passed)[0]
    assert_close(median, want.distance_median[2, 2], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("alpha", [0.02, 0.2, 0.7])
def test_light_of_a_fog_is_a_geometric_series(alpha):
    """Sum of alpha T^2 is 1 / (2 - alpha), that of alpha T is 1: the light passes twice."""
    samples = fog(alpha, samples=2000)
    passed = samples.transmittance
    amplitude = composite.phasor(samples, SENSOR, passed)[2, 0]
    assert_close(amplitude.item(), 1.0 / (2.0 - alpha), rtol=1e-6, atol=0.0)
    opacity = composite.expected(samples, passed, torch.ones_like(samples.alpha))[0]
    assert_close(opacity.item(), 1.0, rtol=1e-6, atol=0.0)


def test_a_thin_medium_is_the_integral_of_its_phasor():
    """Density s from 1 m on: the integral of s exp(-2 s (d - 1)) exp(i kappa d) to infinity."""
    density, slope = 8.0, float(SENSOR.phase_slope)
    z = torch.linspace(1.0, 5.0, 8001, dtype=torch.float64)[None]
    alpha = composite.opacities(
        torch.full_like(z, density), Depths.between(z).interval, torch.ones(1)
    )
    samples = Samples(distance=z, alpha=alpha, strength=alpha)
    re, im, _ = composite.phasor(samples, SENSOR, samples.transmittance)[:, 0].tolist()
    start = np.exp(1j * (slope + SENSOR.phase_offset))
    want = start * density / (2.0 * density - 1j * slope)
    assert (re, im) == pytest.approx((want.real, want.imag), abs=1e-3)


def test_the_last_sample_closes_the_volume():
    """Behind it is nothing, so any density in it stops all light; oblique rays have longer
    intervals.
    """
    z = torch.tensor([[1.0, 1.5, 2.0]], dtype=torch.float64)
    raw = torch.tensor([[-1.0, 0.4, 1e-3]], dtype=torch.float64)
    alpha = composite.opacities(
        raw, Depths.between(z).interval, torch.tensor([1.2], dtype=torch.float64)
    )[0]
    assert_close(alpha, torch.tensor([0.0, 1.0 - math.exp(-0.4 * 0.6), 1.0], dtype=torch.float64))


def test_gradients_agree_with_finite_differences():
    """Of quads, phasor, colour and distance by densities, reflectivities and colours."""
    draw = generator()
    raw = torch.rand(2, 5, generator=draw, dtype=torch.float64) + 0.1
    light = torch.rand(2, 5, generator=draw, dtype=torch.float64) + 0.5
    tint = torch.rand(2, 5, 3, generator=draw, dtype=torch.float64)
    z = torch.linspace(1.0, 3.0, 5, dtype=torch.float64).expand(2, 5)
    length = torch.tensor([1.0, 1.3], dtype=torch.float64)

    def images(raw, light, tint):
        alpha = composite.opacities(raw, Depths.between(z).interval, length)
        samples = Samples(
            distance=z * length[:, None],
            alpha=alpha,
            strength=alpha * light,
            colour=alpha[..., None] * tint,
        )
        passed = samples.transmittance
        return (
            composite.quads(samples, SENSOR, passed),
            composite.phasor(samples, SENSOR, passed),
            composite.colour(samples, passed),
            composite.expected(samples, passed, samples.distance),
        )

    leaves = [value.requires_grad_() for value in (raw, light, tint)]
    gradient = torch.autograd.grad(images(*leaves)[0][0].sum(), raw)[0]
    assert gradient.abs().max() > 1e-2, "a vanished gradient would pass"
    assert torch.autograd.gradcheck(images, leaves)


def test_gradients_of_the_network_agree_with_finite_differences():
    """By the points, which a scene flow moves, and by the time code."""
    codes = TimeCodes(NETWORK, 8, 4, generator())
    network = VolumeNetwork(NETWORK, codes.size, generator(1)).double()
    points = torch.rand(2, 3, 3, generator=generator(2), dtype=torch.float64).requires_grad_()
    code = codes(torch.tensor([0, 1])).double().requires_grad_()

    def values(points, code):
        trunk = network.trunk(points, code)
        return network.density_head(trunk), network.flow_head(trunk) * 1e5

    assert values(points, code)[1].abs().max() > 0.01
    assert torch.autograd.gradcheck(values, (points, code), eps=1e-7, atol=1e-4)


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("added", [None, (2, 7), (2, 6, 7)])
def test_a_product_is_that_of_a_linear_layer(added, relu):
    """And so are its gradients, with a bias of the layer, one for each of several parts, or another
    product added, and with a ReLU.
    """
    layer = torch.nn.Linear(5, 7, bias=added is None).double()
    rows = torch.randn(2, 6, 5, generator=generator(), dtype=torch.float64).requires_grad_()
    weight = torch.rand(2, 6, 7, generator=generator(2), dtype=torch.float64)
    if added is None:
        values, plain, last = linear(layer, rows, relu=relu), layer(rows), layer.bias
    else:
        last = torch.rand(added, generator=generator(1), dtype=torch.float64).requires_grad_()
        values = linear(layer, rows, last, relu=relu)
        plain = layer(rows) + (last[:, None] if len(added) == 2 else last)
    if relu:
        assert plain.min() < -0.1
        plain = torch.relu(plain)
    assert_close(values, plain)
    leaves = [rows, layer.weight, last]
    ours = torch.autograd.grad((values * weight).sum(), leaves)
    theirs = torch.autograd.grad((plain * weight).sum(), leaves)
    assert min(each.abs().max() for each in theirs) > 0.1
    for one, other in zip(ours, theirs, strict=True):
        assert_close(one, other)


def test_an_encoding_is_the_same_with_a_gradient():
    """Order and padding included."""
    value = torch.rand(4, 3, generator=generator())
    plain = encoded(value, 3, columns=24)
    assert_close(encoded(value.clone().requires_grad_(), 3, columns=24).detach(), plain)


def test_the_input_is_joined_as_if_it_were_one_matrix():
    """Sums of products are the product of the concatenation, with Glorot's bounds of the whole."""
    codes = TimeCodes(NETWORK, 8, 4, generator())
    network = VolumeNetwork(NETWORK, codes.size, generator(1))
    points = torch.rand(1, 4, 3, generator=generator(2))
    known = encoded(points[0], NETWORK.position_octaves, columns=24)
    code = codes(torch.tensor([1])).expand(4, -1)
    first = torch.cat([network.entry["0"].weight, network.time["0"].weight], dim=1)
    values = torch.relu(torch.cat([known, code], dim=1) @ first.T)
    values = torch.relu(values @ network.hidden["1"].weight.T)
    parts = (network.entry["2"], network.time["2"], network.hidden["2"])
    joined = torch.cat([part.weight for part in parts], dim=1)
    values = torch.relu(torch.cat([known, code, values], dim=1) @ joined.T)
    assert_close(network.trunk(points, codes(torch.tensor([1])))[0], values)
    bound = math.sqrt(6.0 / (joined.shape[1] + 16))
    assert 0.95 * bound < joined.abs().max() <= bound


def test_time_codes():
    """Positional: (K i + 1) / F and its waves; learnt: of length 1, one per quartet."""
    found = TimeCodes(NETWORK, 10, 4, generator())(torch.tensor([0, 2]))
    assert_close(found[:, 0], torch.tensor([0.1, 0.9]))
    assert found.shape == (2, 1 + 2 * 2)
    learnt = TimeCodes(
        replace(NETWORK, time_code=TimeCode.LEARNT, time_values=7), 10, 4, generator()
    )
    assert learnt.values.shape == (3, 7)
    assert_close(learnt(torch.tensor([0, 2])).norm(dim=1), torch.ones(2))


def test_rays_and_their_samples():
    """A point on a ray projects back to its pixel; jitter stays within the cells."""
    camera = Camera(width=6, height=4, fx=5.0, fy=5.0, cx=3.0, cy=2.0)
    poses = np.stack([turned(20.0, (0.5, 0.0, 0.0)), turned(-20.0, (-0.5, 0.2, 0.0))])
    pose = mean_pose(poses)
    np.testing.assert_allclose(pose[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [0.0, -0.1, 0.0], atol=1e-12)
    cameras = [camera.at(one) for one in poses]
    views = Views(cameras, pose, "cpu")
    pixels = torch.tensor([0, 9, 23])
    rays = views.rays(1, pixels)
    z = evenly((1.0, 3.0), 3, 8, pixels.device, generator()).z
    world = rays.at(z) + torch.tensor([0.0, 0.1, 0.0])
    centres = torch.tensor([[0.5, 0.5], [3.5, 1.5], [5.5, 3.5]])
    assert_close(cameras[1].project(world), centres[:, None].expand(3, 8, 2), atol=1e-4, rtol=0)
    depth = world @ torch.tensor(poses[1][2, :3]).float() + poses[1][2, 3]
    assert_close(depth, z, atol=1e-5, rtol=0)
    distance = (world - torch.tensor([-0.5, 0.2, 0.0])).norm(dim=-1)
    assert_close(z * rays.length[:, None], distance, atol=1e-5, rtol=0)
    even = evenly((1.0, 3.0), 3, 8, pixels.device).z
    assert (z[:, 1:] > z[:, :-1]).all()
    assert 0.01 < (z - even).abs().max() <= 1.0 / 7.0 + 1e-6
