"""The renderer as a good citizen of torch: graphs, threads, streams, strides, broadcasting,
errors.
"""

from dataclasses import replace

import pytest
import torch
from cases import CASES, SENSOR_SCALARS
from comparison import DEVICES, gradients_of, same
from torch.testing import assert_close

from gftorf_warp.render import api
from gftorf_warp.render.api import Background


@pytest.fixture(params=DEVICES)
def device(request) -> str:
    """Where the kernels run."""
    return request.param


def test_two_forwards_before_one_backward(device):
    """A rendering keeps what its backward pass needs, whatever is rendered in between."""
    case, other = CASES["translucent"](), CASES["opaque"]()
    inputs, others = case.inputs(torch.float32, device), other.inputs(torch.float32, device)
    want = gradients_of(case.outputs(api.rasterize, inputs), inputs)
    first = case.outputs(api.rasterize, inputs)
    second = other.outputs(api.rasterize, others)
    kept = {name: image.detach().clone() for name, image in first.items()}
    gradients_of(second, others)
    same(gradients_of(first, inputs), want, exact=device == "cpu")
    for name, image in first.items():
        assert torch.equal(image.detach(), kept[name]), name


def test_one_graph_can_be_differentiated_twice(device):
    """With retain_graph, a second backward pass gives the same; another cotangent,
    another gradient.
    """
    case = CASES["saturated"]()
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    first = gradients_of(images, inputs, retain_graph=True)
    other = gradients_of(images, inputs, seed=1, retain_graph=True)
    same(gradients_of(images, inputs), first, exact=device == "cpu")
    assert not torch.equal(other["mean"], first["mean"])


def test_gradients_accumulate_in_leaves(device):
    """Two calls of backward() add up in .grad, as torch promises."""
    case = CASES["single"]()
    inputs = case.inputs(torch.float32, device)
    for _ in range(2):
        case.outputs(api.rasterize, inputs)["quads"].square().sum().backward()
    twice = inputs["mean"].grad.clone()
    inputs["mean"].grad = None
    case.outputs(api.rasterize, inputs)["quads"].square().sum().backward()
    assert twice.abs().max() > 1e-3
    assert_close(twice, 2 * inputs["mean"].grad, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", ["posed", "opaque"])
def test_threads_change_sums_by_rounding_only(name):
    """On the CPU the images of one, two and five threads are the same to the bit;
    gradients are to rounding.
    """
    results = []
    for threads in (1, 2, 5):
        case = CASES[name]()
        case = replace(case, settings=replace(case.settings, threads=threads))
        inputs = case.inputs(torch.float32)
        images = case.outputs(api.rasterize, inputs)
        results.append(
            ({k: v.detach().clone() for k, v in images.items()}, gradients_of(images, inputs))
        )
    for images, gradients in results[1:]:
        same(images, results[0][0], exact=True)
        same(gradients, results[0][1], exact=False)


def test_same_call_same_bytes():
    """On the CPU a rendering and its gradients can be repeated to the bit."""
    case = CASES["posed"]()
    results = []
    for _ in range(2):
        inputs = case.inputs(torch.float32)
        images = case.outputs(api.rasterize, inputs)
        results.append(
            {**images, **{f"grad {k}": v for k, v in gradients_of(images, inputs).items()}}
        )
    same(results[1], results[0], exact=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="streams exist on CUDA only")
def test_a_side_stream_is_followed():
    """On a stream of its own, the renderer waits for torch's work before it,
    and torch's work after it waits.
    """
    case = CASES["posed"]()
    inputs = case.inputs(torch.float32, "cuda")
    want = case.outputs(api.rasterize, inputs)
    gradients = gradients_of(want, inputs)
    busy = torch.randn(3000, 3000, device="cuda")
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(20):
            busy = busy @ busy / 3000  # work that has to end before the next line means anything
        late = {**inputs, "mean": inputs["mean"] + busy.sum() * 0.0}
        got = case.outputs(api.rasterize, late)
        again = gradients_of(got, inputs)
    stream.synchronize()
    for name, image in want.items():
        assert torch.equal(got[name], image), name
    same(again, gradients, exact=False)


@pytest.mark.parametrize(
    "wanted", [("mean",), ("colour_sh",), ("background.quads",), ("f_mod_hz",), ("extra", "mean")]
)
def test_a_gradient_may_be_wanted_of_some_inputs_only(wanted, device):
    """The same numbers as when all are wanted."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    want = gradients_of(case.outputs(api.rasterize, inputs), inputs)
    inputs = case.inputs(torch.float32, device, grad=False)
    for name in wanted:
        inputs[name].requires_grad_()
    got = gradients_of(case.outputs(api.rasterize, inputs), inputs)
    same(got, {name: want[name] for name in wanted}, exact=device == "cpu")


def test_without_gradients_nothing_is_recorded(device):
    """Frozen inputs or no_grad: the same images, without a graph."""
    case = CASES["translucent"]()
    want = case.outputs(api.rasterize, case.inputs(torch.float32, device))
    frozen = case.outputs(api.rasterize, case.inputs(torch.float32, device, grad=False))
    with torch.no_grad():
        quiet = case.outputs(api.rasterize, case.inputs(torch.float32, device))
    for name, image in want.items():
        assert image.requires_grad
        assert not frozen[name].requires_grad
        assert not quiet[name].requires_grad
        assert torch.equal(frozen[name], image)
        assert torch.equal(quiet[name], image)


def test_strided_inputs_and_cotangents_are_welcome(device):
    """Views of larger tensors, transposed ones and expanded ones give what their copies give."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    images = case.outputs(api.rasterize, inputs)
    want = gradients_of(images, inputs)
    strided = {}
    for name, value in inputs.items():
        if value.ndim:
            holder = torch.zeros(*value.shape[:-1], 2 * value.shape[-1], device=device)
            holder[..., ::2] = value.detach()
            strided[name] = holder[..., ::2].requires_grad_()
            assert not strided[name].is_contiguous() or value.shape[-1] == 1
        else:
            strided[name] = value
    got = case.outputs(api.rasterize, strided)
    for name, image in images.items():
        assert torch.equal(got[name], image), name
    same(gradients_of(got, strided), want, exact=device == "cpu")

    fresh = case.outputs(api.rasterize, inputs)
    weight = torch.randn(24, 20, generator=torch.Generator().manual_seed(0)).to(device).T
    (loose,) = torch.autograd.grad(fresh["distance"], inputs["mean"], weight, retain_graph=True)
    (tight,) = torch.autograd.grad(
        fresh["distance"], inputs["mean"], weight.contiguous(), retain_graph=True
    )
    (spread,) = torch.autograd.grad(fresh["opacity"].sum(), inputs["mean"])  # an expanded cotangent
    assert_close(loose, tight, rtol=1e-5, atol=1e-6)
    assert spread.abs().max() > 0.1


@pytest.mark.parametrize("kind", ["number", "channel", "image"])
def test_backgrounds_broadcast(kind, device):
    """A number, one value per channel or an image: the same light,
    and the gradient of the given shape.
    """
    case = CASES["translucent"]()
    shape = {"number": (), "channel": (4, 1, 1), "image": (4, 20, 24)}[kind]
    value = (
        torch.randn(shape, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
    )
    inputs = case.inputs(torch.float32, device, grad=False)
    quads = [
        replace(case, background=Background(quads=light)).render(
            api.rasterize,
            {**{k: v for k, v in inputs.items() if "." not in k}, "background.quads": light},
        )
        for light in (value, value.detach().expand(4, 20, 24).contiguous())
    ]
    assert_close(quads[0].quads, quads[1].quads)
    weight = torch.randn(4, 20, 24, generator=torch.Generator().manual_seed(1)).to(device)
    (gradient,) = torch.autograd.grad(quads[0].quads, value, weight)
    want = (weight * (1 - quads[0].opacity)).sum_to_size(shape)
    assert_close(gradient, want, rtol=1e-4, atol=1e-4)
    assert gradient.abs().max() > 0.5


def test_sensor_numbers_and_tensors_agree(device):
    """A sensor of plain numbers renders what one of 0-d tensors renders."""
    case = CASES["posed"]()
    inputs = case.inputs(torch.float32, device, grad=False)
    numbers = {name: value for name, value in inputs.items() if name not in SENSOR_SCALARS}
    want, got = case.render(api.rasterize, inputs), case.render(api.rasterize, numbers)
    assert_close(got.quads, want.quads, rtol=1e-5, atol=1e-6)
    assert_close(got.phasor, want.phasor, rtol=1e-5, atol=1e-6)


def test_reserved_pairs_change_nothing(device):
    """With room reserved in advance the host need not wait,
    and the images are the same to the bit.
    """
    case = CASES["posed"]()
    inputs = case.inputs(torch.float32, device)
    want = case.outputs(api.rasterize, inputs)
    case = replace(case, settings=replace(case.settings, pair_capacity=20_000))
    got = case.outputs(api.rasterize, inputs)
    for name, image in want.items():
        assert torch.equal(got[name], image), name
    assert gradients_of(got, inputs)["mean"].abs().max() > 1


@pytest.mark.contract
@pytest.mark.parametrize("name", ["mean", "opacity_logit", "colour_sh", "extra"])
def test_wrong_dtype_is_named(name, device):
    """The error says which tensor, what it is, and what it must be."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    inputs[name] = inputs[name].detach().double()
    with pytest.raises(ValueError, match=rf"{name} is torch.float64.* must be float32"):
        case.render(api.rasterize, inputs)


@pytest.mark.contract
def test_wrong_device_is_named(device):
    """Likewise for a tensor that lives elsewhere."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    inputs["quaternion"] = inputs["quaternion"].detach().to("meta")
    with pytest.raises(ValueError, match=rf"quaternion .*meta.* {device}"):
        case.render(api.rasterize, inputs)


@pytest.mark.contract
def test_wrong_shapes_are_named(device):
    """Extra channels for another number of Gaussians, a background of another size."""
    case = CASES["translucent"]()
    inputs = case.inputs(torch.float32, device)
    with pytest.raises(ValueError, match=r"extra \(39, 3\).* 40"):
        case.render(api.rasterize, {**inputs, "extra": inputs["extra"][1:].detach()})
    with pytest.raises(ValueError, match=r"background.colour \(3, 20, 23\).*\(3, 20, 24\)"):
        case.render(
            api.rasterize,
            {**inputs, "background.colour": inputs["background.colour"][..., 1:].detach()},
        )
