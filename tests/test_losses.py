"""Losses: values against definitions, gradients against finite differences,
and what must not pass a gradient.
"""

import math

import pytest
import torch
from torch.autograd import gradcheck

from gftorf_warp.losses import image, prior, tof
from gftorf_warp.scene.camera import Camera


def draw(*shape, seed=0):
    """Seeded float64 values in [-1, 1]."""
    return (
        torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2
        - 1
    )


def naive_similarity(a, b):
    """The definition, window by window."""
    reach = 5
    height, width = a.shape
    weight = torch.tensor(
        [
            [math.exp(-(i * i + j * j) / (2 * 1.5**2)) for j in range(-reach, reach + 1)]
            for i in range(-reach, reach + 1)
        ],
        dtype=a.dtype,
    )
    weight = weight / weight.sum()
    padded_a, padded_b = (torch.nn.functional.pad(x, (reach,) * 4) for x in (a, b))
    result = torch.zeros_like(a)
    for y in range(height):
        for x in range(width):
            wa, wb = (p[y : y + 11, x : x + 11] for p in (padded_a, padded_b))
            ma, mb = (weight * wa).sum(), (weight * wb).sum()
            va, vb = (weight * wa * wa).sum() - ma**2, (weight * wb * wb).sum() - mb**2
            cov = (weight * wa * wb).sum() - ma * mb
            result[y, x] = (
                (2 * ma * mb + 1e-4)
                * (2 * cov + 9e-4)
                / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
            )
    return result


def test_similarity_is_the_published_formula():
    """Also where the window reaches beyond the border, and for signed values."""
    a, b = draw(13, 17), draw(13, 17, seed=1)
    torch.testing.assert_close(
        image.similarity(a, b), naive_similarity(a, b), rtol=1e-9, atol=1e-12
    )


def test_similarity_of_an_image_with_itself_is_one_and_works_on_stacks():
    """Channels do not mix."""
    a, b = draw(3, 12, 14), draw(3, 12, 14, seed=1)
    torch.testing.assert_close(image.similarity(a, a), torch.ones_like(a))
    torch.testing.assert_close(image.similarity(a, b)[1], image.similarity(a[1], b[1]))
    assert image.similarity(a, b).mean() < 0.5


def test_similarity_has_the_right_gradient():
    """Against finite differences."""
    a, b = draw(12, 11).requires_grad_(), draw(12, 11, seed=1)
    assert gradcheck(lambda x: image.similarity(x, b), a)
    (gradient,) = torch.autograd.grad(image.similarity(a, b).mean(), a)
    assert gradient.abs().max() > 1e-4


def test_quad_error_is_squared():
    """Unreduced: one value per quad and pixel."""
    a, b = draw(2, 3, 4), draw(2, 3, 4, seed=1)
    torch.testing.assert_close(tof.quad_error(a, b), (a - b) ** 2)


@pytest.mark.contract
def test_quad_error_compares_equal_shapes_only():
    """Broadcasting would compare slots never measured."""
    a, b = draw(2, 3, 4), draw(2, 3, 4, seed=1)
    with pytest.raises(ValueError, match=r"\(2, 3, 4\).*\(1, 3, 4\)"):
        tof.quad_error(a, b[:1])


CAMERA = Camera(width=6, height=4, fx=5.0, fy=6.0, cx=3.2, cy=1.9)


def test_image_motion_is_focal_length_times_motion_over_depth():
    """A fronto-parallel plane that slides; and one that approaches spreads from the principal
    point.
    """
    rays = CAMERA.rays(dtype=torch.float64)
    plane = rays / rays[..., 2:] * 2.0
    slide = torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64)[:, None, None].expand(3, 4, 6)
    flow = prior.image_motion(plane, slide, CAMERA.project)
    torch.testing.assert_close(flow[0], torch.full((4, 6), 5.0 * 0.3 / 2.0, dtype=torch.float64))
    torch.testing.assert_close(flow[1], torch.full((4, 6), 6.0 * -0.2 / 2.0, dtype=torch.float64))
    approach = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)[:, None, None].expand(3, 4, 6)
    flow = prior.image_motion(plane, approach, CAMERA.project)
    x = torch.arange(6, dtype=torch.float64) + 0.5
    # twice as near, twice as far from the centre
    torch.testing.assert_close(flow[0], (x - 3.2).expand(4, 6))


def test_image_motion_passes_gradient_to_the_motion_only():
    """The surface is held fixed (method, section 5)."""
    surface = (CAMERA.rays(dtype=torch.float64) * 2.5).requires_grad_()
    motion = (0.1 * draw(3, 4, 6)).requires_grad_()
    flow = prior.image_motion(surface, motion, CAMERA.project)
    assert torch.autograd.grad(
        flow.square().sum(), surface, retain_graph=True, allow_unused=True
    ) == (None,)
    (gradient,) = torch.autograd.grad(flow.square().sum(), motion)
    assert gradient.abs().max() > 1e-2
    assert gradcheck(lambda m: prior.image_motion(surface.detach(), m, CAMERA.project), motion)


def test_unknown_flow_has_no_error_and_no_gradient():
    """One NaN must not poison the loss."""
    rendered = draw(2, 4, 6).requires_grad_()
    measured = draw(2, 4, 6, seed=1)
    measured[1, 2, 3] = math.nan
    error, known = prior.flow_error(rendered, measured)
    assert known.sum() == 23
    assert not known[2, 3]
    assert error[:, 2, 3].abs().max() == 0
    (gradient,) = torch.autograd.grad(error.sum(), rendered)
    assert gradient.isfinite().all()
    assert gradient[:, 2, 3].abs().max() == 0
    torch.testing.assert_close(gradient[:, 0, 0], 2 * (rendered - measured).detach()[:, 0, 0])


def test_motion_size_is_a_length_with_a_finite_derivative_at_rest():
    """Zero there, a unit vector elsewhere."""
    motion = draw(5, 3)
    motion[2] = 0.0
    motion.requires_grad_()
    size = prior.motion_size(motion)
    torch.testing.assert_close(size, motion.detach().norm(dim=1))
    (gradient,) = torch.autograd.grad(size.sum(), motion)
    assert gradient[2].abs().max() == 0
    torch.testing.assert_close(gradient[0], motion.detach()[0] / motion.detach()[0].norm())
