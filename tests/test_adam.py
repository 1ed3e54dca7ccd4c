"""Our Adam against torch's class: the same bits and the same stored dictionary, without torch's compiler."""

import subprocess
import sys
from io import BytesIO

import pytest
import torch
from gftorf_warp.recon.adam import Adam
from small_runs import KEYS, field, random, same

from gftorf_warp.recon.optimiser import BETAS, EPSILON, Optimiser
from gftorf_warp.scene.motion import Nodes

STEPS = 6


def optimiser():
    """Five Gaussians on three nodes."""
    motion = Nodes(KEYS, random(3, 3), torch.ones(3, dtype=torch.long))
    return Optimiser(field(random(5, 3), torch.ones(5, dtype=torch.long)), motion)


def twin_of(own):
    """Torch's class over copies of the same tensors."""
    groups = [
        {"name": name, "params": [t.detach().clone().requires_grad_() for t in group], "lr": 0.0}
        for name, group in own.adam.groups.items()
    ]
    return torch.optim.Adam(groups, betas=BETAS, eps=EPSILON, fused=True)


def tensors_of(twin):
    """Of all groups of torch's class."""
    return [tensor for group in twin.param_groups for tensor in group["params"]]


def step_of_twin(twin, gradients, rates, longest):
    """A step of torch's class and torch's clip; groups of rate 0 have no gradient."""
    for tensor, gradient in zip(tensors_of(twin), gradients, strict=True):
        tensor.grad = None if gradient is None else gradient.clone()
    torch.nn.utils.clip_grad_norm_(twin.param_groups[-1]["params"], longest)
    for group in twin.param_groups:
        group["lr"] = rates[group["name"]]
        for tensor in group["params"]:
            tensor.grad = None if group["lr"] == 0.0 else tensor.grad
    twin.step()


def stepped(own, twin, first, count):
    """Steps of both: long and short gradients, some of none, and groups that rest at times."""
    for n in range(first, first + count):
        generator = torch.Generator().manual_seed(n)
        gradients = [10.0 ** (n - 3) * torch.randn(leaf.shape, generator=generator) for leaf in own.leaves]
        gradients[n % len(gradients)] = None
        rates = {name: 0.01 * (k + n) * (n % (k + 2) > 0) for k, name in enumerate(own.adam.groups)}
        step_of_twin(twin, gradients, rates, 1.0)
        own.step(gradients, rates, 1.0)


def assert_same(own, twin):
    """Tensors and what is stored agree to the bit."""
    assert same([leaf.detach() for leaf in own.leaves], [tensor.detach() for tensor in tensors_of(twin)])
    assert same(own.adam.state_dict(), twin.state_dict())


def test_steps_are_those_of_torch_to_the_bit():
    """Values, moments, numbers of steps and rates, with clipping, absent gradients and rest."""
    own = optimiser()
    twin = twin_of(own)
    assert same(own.adam.state_dict(), twin.state_dict())
    before = own.tensors["mean"].detach().clone()
    stepped(own, twin, 0, STEPS)
    assert not torch.equal(own.tensors["mean"].detach(), before)
    assert len({float(state["step"]) for state in own.adam.state.values()}) > 1, "no group ever rested"
    assert_same(own, twin)


def test_what_is_stored_goes_on_in_either():
    """A file of torch's class in ours and the other way round."""
    own = optimiser()
    twin = twin_of(own)
    stepped(own, twin, 0, STEPS)
    files = [BytesIO(), BytesIO()]
    for file, adam in zip(files, (own.adam, twin), strict=True):
        torch.save(adam.state_dict(), file)
        file.seek(0)
    by_own, by_torch = (torch.load(file, weights_only=True) for file in files)
    twin.load_state_dict(by_own)
    again = optimiser()
    again.adam.load_state_dict(by_torch)
    for leaf, value in zip(again.leaves, own.leaves, strict=True):
        leaf.data.copy_(value.detach())
    assert_same(again, twin)
    stepped(again, twin, STEPS, 3)
    assert_same(again, twin)


def test_a_state_of_other_groups_is_refused():
    """It is of another field."""
    adam = Adam({"mean": [torch.zeros(2)]}, BETAS, EPSILON)
    with pytest.raises(ValueError, match="tensors per group"):
        adam.load_state_dict(Adam({"mean": [torch.zeros(2), torch.zeros(1)]}, BETAS, EPSILON).state_dict())


SHORT_RUN = """
import sys
from small_runs import demo, small
from gftorf_warp.recon.train import reconstruct
reconstruct(small(), sys.argv[1], demo(images=12, warm_up=0, log_every=4))
print("imported:", *(name for name in ("torch._dynamo", "torch._inductor", "sympy") if name in sys.modules))
"""


def test_a_run_does_not_import_the_compiler_of_torch(tmp_path):
    """It takes a second or three, and compiles nothing here; in a process of its own, since others may have it."""
    command = [sys.executable, "-c", SHORT_RUN, str(tmp_path / "run")]
    done = subprocess.run(command, cwd=__file__.rpartition("/")[0], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "imported:"


def test_a_gradient_may_be_a_slice():
    """The harmonics of the colour are two tensors, so their gradients are parts of one: the same step as of copies."""
    whole = random(5, 16, 3, seed=3) - 0.5
    parts = [whole[:, :1], whole[:, 1:]]
    assert not any(part.is_contiguous() for part in parts)
    own, other = ([torch.zeros(5, n, 3) for n in (1, 15)] for _ in range(2))
    for tensors, gradients in (
        (own, parts),
        (other, [part.clone(memory_format=torch.contiguous_format) for part in parts]),
    ):
        adam = Adam({"constant": tensors[:1], "rest": tensors[1:]}, BETAS, EPSILON)
        for _ in range(2):
            adam.step(gradients, {"constant": 0.1, "rest": 0.2})
    for one, two, part, rate in zip(own, other, parts, (0.1, 0.2), strict=True):
        assert torch.equal(one, two)
        torch.testing.assert_close(one, -2 * rate * part.sign(), rtol=1e-4, atol=1e-6)
