"""Derivatives through the sensor: of decoding, and of a rendered distance by what the sensor is
set to.
"""

import math
from dataclasses import replace

import pytest
import torch
from comparison import DEVICES

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.render import api, reference
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.gaussians import GaussianField, constant_sh
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor, phasor_from_quads

CAMERA = Camera.from_fov(25, 21, 60.0)  # the optical axis meets the centre of pixel [10, 12]
DISTANCES, AMPLITUDES = (2.0, 2.7, 3.4), (1.0, 0.3, 0.1)  # three paths, one behind the other
OPACITY = 0.3
BY_FREQUENCY = -1.42258428e-9  # [m/Hz] sensor notes, T29
TURN = 2 * math.pi


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
@pytest.mark.parametrize(
    "shifts", [Sensor().shifts, (0.1, 0.1 + TURN / 3, 0.1 + 2 * TURN / 3), (0.1, 1.0, 2.5, 4, 5)]
)
def test_phase_by_each_quad(shifts, dtype, tolerance):
    """Sensor notes, T29: sin(shift - psi) / |z| of even shifts; of any, those of least squares."""
    theta = torch.tensor(shifts, dtype=dtype)
    for psi in (0.4, 2.0, 5.9):
        quads = (2.0 + 0.7 * torch.cos(psi - theta)).requires_grad_()
        re, im = phasor_from_quads(quads, shifts)
        (got,) = torch.autograd.grad(torch.atan2(im, re), quads)
        if len(shifts) < 5:
            want = torch.sin(theta - psi) / (0.7 * len(shifts) / 2)
            torch.testing.assert_close(got, want, rtol=tolerance, atol=tolerance)
        along = {
            -math.sin(psi) / 0.7: torch.cos(theta),
            math.cos(psi) / 0.7: torch.sin(theta),
            0.0: torch.ones_like(theta),
        }
        for want, direction in along.items():
            assert torch.dot(got, direction).item() == pytest.approx(
                want, rel=tolerance, abs=tolerance
            )


def three_surfaces(dtype, device="cpu"):
    """Wide Gaussians on the axis whose light has the amplitudes above:
    each passes those before it twice.
    """
    d = torch.tensor(DISTANCES, dtype=torch.float64)
    through = OPACITY * (1 - OPACITY) ** (2.0 * torch.arange(3))
    reflectivity = 0.05 * torch.tensor(AMPLITUDES) * d**2 / through
    field = GaussianField(
        mean=torch.stack([0 * d, 0 * d, d], 1),
        log_scale=torch.full((3, 3), math.log(30.0)),
        quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(3, 4),
        opacity_logit=torch.logit(torch.full((3,), OPACITY, dtype=torch.float64)),
        reflectivity_sh=constant_sh(reflectivity),
    )
    return field.map(lambda tensor: tensor.to(device=device, dtype=dtype))


def decoded(rasterize, field, sensor):
    """Distance [m] that four rendered quads decode to on the axis, and the quads."""
    quads = rasterize(field, CAMERA, sensor).quads[:, 10, 12]
    return distance_from_phasor(*phasor_from_quads(quads, sensor.shifts), sensor), quads


def tensors(dtype, device="cpu"):
    """A sensor all of whose differentiable settings are tensors, and these."""
    values = {"f_mod_hz": 20e6, "phase_offset": 0.3, "dc_offset": 0.4, "source_intensity": 1.5}
    leaves = {
        name: torch.tensor(v, dtype=dtype, device=device, requires_grad=True)
        for name, v in values.items()
    }
    return Sensor(**leaves), leaves


def test_distance_by_frequency_exactly():
    """Sensor notes, T29: -d/f + Re(sum a L e^{i psi} conj S) / (f |S|^2) of three paths;
    the oracle, float64, 1e-6.
    """
    sensor, leaves = tensors(torch.float64)
    distance, _ = decoded(reference.rasterize, three_surfaces(torch.float64), sensor)
    (got,) = torch.autograd.grad(distance, leaves["f_mod_hz"])
    assert got.item() == pytest.approx(BY_FREQUENCY, rel=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_distance_by_frequency_in_float32(device):
    """Sensor notes, T29: the kernels, float32, 1e-3."""
    sensor, leaves = tensors(torch.float32, device)
    distance, _ = decoded(api.rasterize, three_surfaces(torch.float32, device), sensor)
    (got,) = torch.autograd.grad(distance, leaves["f_mod_hz"])
    assert got.item() == pytest.approx(BY_FREQUENCY, rel=1e-3)


@pytest.mark.parametrize("device", DEVICES)
def test_every_differentiable_setting_has_its_closed_form(device):
    """Of a quad by phase offset, DC offset, source intensity and frequency:
    sums over the three paths, 1e-3.
    """
    sensor, leaves = tensors(torch.float32, device)
    shots = [replace(sensor, shifts=(shift,)) for shift in (0.0, 1.0, 4.0)]
    for shot in shots:
        quad = api.rasterize(three_surfaces(torch.float32, device), CAMERA, shot).quads[0, 10, 12]
        got = dict(zip(leaves, torch.autograd.grad(quad, [*leaves.values()]), strict=True))
        slope = 4 * math.pi / SPEED_OF_LIGHT
        waves = [
            (0.05 * a, slope * 20e6 * d + 0.3 - shot.shifts[0], d)
            for a, d in zip(AMPLITUDES, DISTANCES, strict=True)
        ]
        want = {
            "f_mod_hz": sum(-1.5 * a * slope * d * math.sin(angle) for a, angle, d in waves),
            "phase_offset": sum(-1.5 * a * math.sin(angle) for a, angle, _ in waves),
            "dc_offset": sum(1.5 * a for a, _, _ in waves),
            "source_intensity": sum(a * (math.cos(angle) + 0.4) for a, angle, _ in waves),
        }
        for name, value in want.items():
            assert got[name].item() == pytest.approx(value, rel=1e-3, abs=1e-4 * abs(value)), name


def test_a_shot_of_a_cycle_keeps_the_gradient():
    """The sensor of one raw frame shares the leaves of the whole:
    what is recorded asynchronously can be calibrated.
    """
    sensor, leaves = tensors(torch.float64)
    field = three_surfaces(torch.float64)
    whole = reference.rasterize(field, CAMERA, sensor).quads[2, 10, 12]
    alone = reference.rasterize(field, CAMERA, sensor.at_frame(6)).quads[0, 10, 12]
    for one, other in zip(
        *(torch.autograd.grad(quad, [*leaves.values()]) for quad in (whole, alone)), strict=True
    ):
        torch.testing.assert_close(one, other)
