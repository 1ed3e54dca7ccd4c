"""The order of splats: by a key of few bits, which is monotonic in z-depth,
with ties by index and the culled last.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from cases import CASES, SMALL, Case, gaussians, light
from comparison import DEVICES, Comparison

from gftorf_warp.bench.scenes import inputs_of
from gftorf_warp.render import buffers as sizes
from gftorf_warp.render import launch, reference, stages
from gftorf_warp.render.buffers import Buffers, RenderSettings

NEXT = float(np.nextafter(np.float32(1.0), np.float32(2.0)))
PRESETS = 0.135, 7.425  # near and far at 20 MHz [m]
RANGES = [
    PRESETS,
    (0.05, 1000.0),
    (1e-6, 1e6),
    (1.0, NEXT),
    (1.0, 1.0 + 2.0**-7),
    (0.1, 0.3),
    (3.0, float("inf")),
]


@pytest.fixture(params=DEVICES)
def device(request) -> str:
    """Where the kernels run."""
    return request.param


def between(near, far, count=3000):
    """Return z-depths [count] in [near, far], with its ends and their neighbours,
    and some as near as floats can be.
    """
    rng = np.random.default_rng(0)
    near, far = np.float32(near), np.minimum(np.float32(far), np.float32(1e6))
    z = np.exp(rng.uniform(np.log(near), np.log(far), count)).astype(np.float32)
    z[: count // 2] = np.nextafter(z[count // 2 :][: count // 2], far)
    z[:4] = near, far, np.nextafter(near, far), np.nextafter(far, near)
    return rng.permutation(np.clip(z, near, far))


def ordered(z, settings, device, opacity=0.5):
    """Return keys and order of Gaussians on the axis of a camera, as the stages make them."""
    z = np.asarray(z, np.float32)
    count = len(z)
    scene = {
        "mean": np.stack([np.zeros(count), np.zeros(count), z], 1),
        "log_scale": np.log(np.repeat(0.01 * np.maximum(np.abs(z), 1e-6)[:, None], 3, 1)),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "opacity_logit": np.broadcast_to(np.log(opacity / (1 - np.asarray(opacity))), (count,)),
        "colour": np.zeros((count, 3)),
        "reflectivity": np.full(count, 0.5),
    }
    buffers = Buffers(count, SMALL.width, SMALL.height, settings, wp.get_device(device))
    stages.project(
        inputs_of(scene, device), launch.uploaded(SMALL, (), settings, buffers.device), buffers
    )
    keys = buffers.depth_key.numpy()[:count].copy()
    stages.sort_by_depth(buffers)
    return keys, buffers.order.numpy()[:count]


@pytest.mark.parametrize("bits", [24, 16])
@pytest.mark.parametrize("bounds", RANGES, ids=str)
def test_keys_order_like_depths(bounds, bits, device):
    """Never the other way round, equal only within the width of a key, ties by index,
    and all before the culled.
    """
    settings = RenderSettings(near=bounds[0], far=bounds[1], depth_bits=bits)
    z = between(*bounds)
    keys, order = ordered(z, settings, device)
    by_depth = np.argsort(z, kind="stable")
    assert (np.diff(keys[by_depth]) >= 0).all()
    assert 0 <= keys.min() == keys[z == z.min()].max()
    assert keys.max() < settings.depth_culled == 2**bits - 1
    np.testing.assert_array_equal(order, np.lexsort((np.arange(len(z)), keys)))
    floats = z[by_depth].view(np.int32)
    apart = np.diff(floats) >= 2**settings.depth_shift
    assert (np.diff(keys[by_depth])[apart] > 0).all()
    if settings.depth_shift == 0:
        np.testing.assert_array_equal(order, by_depth)


@pytest.mark.parametrize("bits", [24, 16])
@pytest.mark.parametrize(
    "bounds", [*RANGES, (1e-45, 1e38), (1e-50, float("inf")), (1e-30, 1e50)], ids=str
)
def test_a_key_drops_as_few_bits_as_fit(bounds, bits):
    """With one bit less dropped, the farthest depth would have the key of the culled,
    or a longer one.
    """
    settings = RenderSettings(near=bounds[0], far=bounds[1], depth_bits=bits)
    with np.errstate(over="ignore", under="ignore"):
        near, far = (int(np.float32(z).view(np.int32)) for z in bounds)
    assert (far - near) >> settings.depth_shift < settings.depth_culled
    if settings.depth_shift:
        assert (far - near) >> (settings.depth_shift - 1) >= settings.depth_culled


@pytest.mark.parametrize(("bits", "width"), [(24, 0.95e-6), (16, 0.245e-3)])
def test_presets_tell_depths_apart_as_documented(bits, width, device):
    """At 3 m a key is 2^-20 m wide, with 16 bits 2^-12 m;
    nowhere wider than a part of the depth.
    """
    settings = RenderSettings(near=PRESETS[0], far=PRESETS[1], depth_bits=bits)
    step = 2.0 ** (settings.depth_shift - 22)  # floats between 2 and 4 m are 2^-22 m apart
    assert step == pytest.approx(width, rel=0.01)
    keys, _ = ordered(3.0 + step * np.arange(4), settings, device)
    assert np.diff(keys).tolist() == [1, 1, 1]
    assert 2.0 ** (settings.depth_shift - 23) <= {24: 5e-7, 16: 1.3e-4}[bits]


@pytest.mark.parametrize("bits", [24, 16])
def test_the_culled_come_last(bits, device):
    """Behind the camera, too near, too far, too faint: behind the farthest that is seen,
    in order of index. What has no finite place comes first, to be seen.
    """
    settings = RenderSettings(near=0.2, far=20.0, depth_bits=bits)
    z = np.array([-1.0, 20.0, 0.1, 25.0, 5.0, -0.0, 0.2, 1e9, 5.0, 3.0, -np.inf, np.nan])
    opacity = np.full(len(z), 0.5)
    opacity[9] = 0.001
    keys, order = ordered(z, settings, device, opacity)
    assert order.tolist() == [6, 10, 11, 4, 8, 1, 0, 2, 3, 5, 7, 9]
    assert (keys[[0, 2, 3, 5, 7, 9]] == settings.depth_culled).all()
    assert (keys[[10, 11]] == 0).all()


def layers(bits):
    """Many Gaussians within 8 mm: some of them share a key of 16 bits,
    in whatever order memory has them.
    """
    field = gaussians(40, SMALL, seed=21, z=(2.0, 2.008), scale=(0.1, 0.4), opacity=(0.3, 0.8))
    settings = RenderSettings(near=0.2, far=20.0, depth_bits=bits)
    return Case(field=field, camera=SMALL, settings=settings, background=light(SMALL, 4, seed=21))


@pytest.mark.parametrize("bits", [24, 16])
def test_few_bits_match_the_oracle(bits, device):
    """Which orders by the same keys: images and gradients."""
    comparison = Comparison(layers(bits), device)
    comparison.check_images()
    comparison.check_gradients(*comparison.want)


@pytest.mark.parametrize("name", ["posed", "released"])
def test_sixteen_bits_match_the_oracle_on_ordinary_scenes(name, device):
    """As 24 do."""
    case = CASES[name]()
    comparison = Comparison(replace(case, settings=replace(case.settings, depth_bits=16)), device)
    comparison.check_images()
    comparison.check_gradients(*comparison.want)


def test_sixteen_bits_are_wrong_by_no_more_than_a_key():
    """Fewer bits exchange Gaussians of one key only, and do exchange some:
    then the image is another one.
    """
    orders, images = {}, {}
    for bits in (24, 16):
        case = layers(bits)
        splats = reference.project(case.field.map(torch.Tensor.double), case.camera, case.settings)
        orders[bits] = splats.z_depth.detach()
        images[bits] = case.outputs(reference.rasterize, case.inputs(torch.float64))[
            "quads"
        ].detach()
    # how far a splat lies before the farthest one of those before it
    behind = orders[16].cummax(0).values - orders[16]
    width = 2.0 ** (layers(16).settings.depth_shift - 22)
    assert 0.1 * width < behind.max() <= width
    assert (orders[24].diff() > -1e-6).all()
    assert (images[16] - images[24]).abs().max() > 1e-3 * images[24].abs().max()


def test_undecided_are_pairs_on_two_sides_of_an_edge():
    """Where memory has the farther one first: rounding may give both one key.
    Elsewhere the order is certain.
    """
    settings = RenderSettings(near=0.25, far=16.0, depth_bits=16)
    width = 2.0 ** (settings.depth_shift - 23)  # from 1 m to 2 m
    for low, high, wanted in (
        (0.5, 0.9, False),
        (-0.3, 1e-3, True),
        (-0.3, 0.3, False),
        (0.0, 1.5, False),
    ):
        depths = [1.5 + high * width, 1.5 + low * width]
        for z, undecided in ((depths, wanted), (depths[::-1], False)):
            field = gaussians(2, SMALL, seed=0, spread=0.0, opacity=(0.5, 0.5))
            field = replace(
                field, mean=torch.tensor([[0.0, 0.0, z[0]], [0.0, 0.0, z[1]]], dtype=torch.float64)
            )
            assert (
                bool(reference.undecided_pixels(field, SMALL, settings).float().mean() > 0.05)
                == undecided
            ), z


@pytest.mark.parametrize("bits", [0, 8, 20, 32, -16])
def test_other_numbers_of_bits_are_named(bits):
    """With the number."""
    with pytest.raises(ValueError, match=f"depth_bits must be 16 or 24, got {bits}"):
        RenderSettings(depth_bits=bits)


@pytest.mark.parametrize("bits", [24, 16])
@pytest.mark.parametrize("kind", ["wide", "equal", "culled", "few", "wall", "last"])
@pytest.mark.parametrize("count", [1, 2, 31, 500, 5000])
def test_classes_give_the_order_of_a_sort(count, kind, bits, device, monkeypatch):
    """Spread keys, one for all, only culled ones, few with ties, two classes, and those beside the
    culled ones.

    The culled come last, in any order.
    """
    settings = RenderSettings(near=PRESETS[0], far=PRESETS[1], depth_bits=bits)
    rng, culled = np.random.default_rng(count), settings.depth_culled
    keys = {
        "wide": rng.integers(0, culled, count),
        "equal": np.full(count, 77),
        "culled": np.full(count, culled),
        "few": np.where(rng.random(count) < 0.3, culled, rng.integers(0, 5, count)),
        "wall": rng.integers(8 << 8, 10 << 8, count) if bits == 24 else rng.integers(8, 10, count),
        "last": rng.integers(culled - 3, culled + 1, count),
    }[kind]
    found = []
    for most in (0, 1 << 20):
        monkeypatch.setitem(sizes.BINNED_MAX, "cpu" if device == "cpu" else "cuda", most)
        buffers = Buffers(count, 64, 48, settings, wp.get_device(device))
        assert buffers.binned == (most > 0)
        buffers.depth_key.assign(np.concatenate([keys, keys]).astype(np.int32))
        buffers.order.assign(np.concatenate([np.arange(count)] * 2).astype(np.int32))
        stages.sort_by_depth(buffers)
        found.append(buffers.order.numpy()[:count].copy())
    seen = int((keys != culled).sum())
    np.testing.assert_array_equal(found[0][:seen], np.argsort(keys, kind="stable")[:seen])
    np.testing.assert_array_equal(found[1][:seen], found[0][:seen])
    assert sorted(found[1]) == list(range(count))
