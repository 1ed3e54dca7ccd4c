"""Every motion model: the same start, store, gradients, training and rendering;
splines and rotations in particular.
"""

import math
from dataclasses import replace

import pytest
import torch
from cases import gaussians
from small_runs import KEYS, demo, field, random, rows, same, small, stored
from test_replay import CAMERA, DEVICES, TIMES, aside, compare, run  # noqa: F401

from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Weights
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.stepper import Stepper
from gftorf_warp.recon.train import CHANGES, reconstruct
from gftorf_warp.render import descent
from gftorf_warp.render.buffers import ClampGradient
from gftorf_warp.scene.changes import changed
from gftorf_warp.scene.models import KINDS, MODELS, motion_from_dict
from gftorf_warp.scene.motion import KeyMotion, MotionSettings, MotionStart, interpolated
from gftorf_warp.scene.rigid_nodes import quaternion_of
from gftorf_warp.scene.spline import Spline

SMALL = {"layers": 3, "width": 16, "skip_after": 2, "position_frequencies": 3, "nodes": 6}


def layered(n=9, seed=2):
    """Gaussians of which every third is static."""
    return field(random(n, 3, seed=seed), (torch.arange(n) % 3 > 0).long())


def made(kind, gaussians, *, keys=KEYS, size=0.2):
    """A model with random parameters, which displaces by decimetres."""
    initial = MotionStart(
        key_times=keys,
        field=gaussians,
        tracks=None,
        duration=0.1,
        unambiguous_range=7.5,
        generator=torch.Generator().manual_seed(0),
    )
    motion = KINDS[kind].start(MotionSettings(kind=kind, **SMALL), initial)
    with torch.no_grad():
        for n, parameter in enumerate(motion.parameters()):
            parameter.add_(size * (random(*parameter.shape, seed=n) - 0.5))
    return motion


@pytest.mark.parametrize("kind", KINDS)
def test_weights_sum_to_one_and_hold_the_ends(kind):
    """At any time, over no more keys than the model says;
    before the first key and after the last nothing changes.
    """
    scene = layered()
    motion = made(kind, scene)
    for time in (*KEYS.tolist(), -3.0, 0.01, 0.0401, 0.099, 7.0):
        keys = motion.keys_at(time)
        assert sum(keys.weight) == pytest.approx(1.0, abs=1e-12)
        assert len(keys.index) <= motion.support
        assert all(0 <= index < motion.key_count for index in keys.index)
        assert list(keys.index) == sorted(set(keys.index))
    assert motion.keys_at(-3.0).index == (0,)
    assert motion.keys_at(7.0).index == (motion.key_count - 1,)


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_stores_and_loads_itself(kind, tmp_path):
    """Through a file that a safe loader reads; also a model of another kind is not mistaken for
    it.
    """
    scene = layered()
    motion = made(kind, scene)
    torch.save(motion.to_dict(), tmp_path / "motion.pt")
    again = motion_from_dict(torch.load(tmp_path / "motion.pt", weights_only=True))
    assert type(again) is type(motion) is KINDS[kind]
    before, after = (one.at(one.bind(scene), 0.05) for one in (motion, again))
    for one, other in zip(before, after, strict=True):
        assert (one is None and other is None) or torch.equal(one, other)
    assert kind == "still" or before.offset.abs().max() > 1e-3


def test_checkpoints_of_before_models_stored_themselves_load():
    """The dictionaries that recon/state.py wrote, of the three models of that time."""
    times, node = KEYS, random(2, 3)
    tensors = {
        "key_times": times,
        "node": node,
        "layer": torch.tensor([1, 1]),
        "offset": random(4, 2, 3, seed=1),
    }
    assert (
        type(motion_from_dict({"kind": "still", "tensors": {"key_times": times}})) is KINDS["still"]
    )
    nodes = motion_from_dict({"kind": "nodes", "tensors": tensors, "neighbours": 3})
    assert nodes.neighbours == 3
    assert torch.equal(nodes.offset, tensors["offset"])
    network = made("network", layered())
    shape = {
        "kind": "network", "nodes": 64, "neighbours": 4, "from_tracks": True, "layers": 3,
        "width": 16, "skip_after": 2,
        "position_frequencies": 3, "time_frequencies": 10, "input_scale": 1.0,
    }  # fmt: skip
    old = {
        "kind": "network",
        "tensors": network.state_dict(),
        "shape": shape,
        "duration": 0.1,
        "length": 7.5,
    }
    for more in ({}, {"products": "float32"}):
        again = motion_from_dict(old | {"shape": shape | more})
        assert same(again.state_dict(), network.state_dict())


@pytest.mark.parametrize("kind", ["still", "nodes", "network"])
def test_a_whole_checkpoint_of_format_2_loads(kind):
    """Its motion had these keys; the state of a torch generator was where the seed of the noise is
    now.
    """
    settings = demo(motion=MotionSettings(kind=kind, layers=3, width=16, skip_after=2))
    state = begin(observe(small(), settings, "cpu"), settings, seed=3, device="cpu")
    stored = to_dict(state)
    keys = {"still": set(), "nodes": {"neighbours"}, "network": {"shape", "duration", "length"}}
    assert stored["motion"].keys() == {"kind", "tensors"} | keys[kind]
    del stored["noise_seed"]
    again = from_dict(
        stored | {"format": 2, "noise": torch.Generator().manual_seed(3).get_state()}, "cpu"
    )
    assert type(again.motion) is KINDS[kind]
    assert again.noise_seed == state.noise_seed
    for one, other in zip(
        state.motion.at(state.binding, 0.05), again.motion.at(again.binding, 0.05), strict=True
    ):
        assert (one is None and other is None) or torch.equal(one, other)


def test_an_unknown_model_is_refused_by_name():
    """In a checkpoint, in settings and on the command line; all that exist are listed."""
    with pytest.raises(
        InputError,
        match=r"unknown motion model 'flock'(.|\n)*still, nodes, "
        r"network",
    ):
        motion_from_dict({"kind": "flock", "tensors": {}})
    with pytest.raises(ValueError, match=r"motion.kind must be one of still, .*, got 'flock'"):
        demo(motion=MotionSettings(kind="flock"))
    with pytest.raises(UsageError, match=r"motion.kind=flock(.|\n)*rigid_nodes"):
        changed(presets.demo(), ["motion.kind=flock"], CHANGES)
    assert changed(presets.demo(), ["motion.kind=spline"], CHANGES).motion.kind == "spline"
    assert len(KINDS) == len(MODELS)


def test_splines_reproduce_lines():
    """Control points on a line, evenly spaced: the curve is at the same point of it at every
    time.
    """
    motion = Spline(KEYS, random(1, 3), torch.ones(1, dtype=torch.long))
    for time in torch.linspace(0.0, float(KEYS[-1]), 23).tolist():
        keys = motion.keys_at(time)
        assert sum(
            w * motion.times[k] for k, w in zip(keys.index, keys.weight, strict=True)
        ) == pytest.approx(time)


def test_splines_have_two_continuous_derivatives():
    """Across every inner key, for any control points; a curve that is linear between keys has
    none.
    """
    values, h = random(len(KEYS), seed=5).double(), 1e-4

    def at(motion, time):
        keys = motion.keys_at(time)
        return sum(w * float(values[k]) for k, w in zip(keys.index, keys.weight, strict=True))

    jumps = {}
    for kind in ("spline", "nodes"):
        motion = made(kind, layered())
        for key in motion.times[1:-1]:
            left, right = ([at(motion, key + side * n * h) for n in (0, 1, 2)] for side in (-1, 1))
            slopes = [(one[1] - one[0]) / (side * h) for side, one in ((-1, left), (1, right))]
            bends = [(one[2] - 2 * one[1] + one[0]) / h**2 for one in (left, right)]
            jumps.setdefault(kind, []).append(
                (abs(slopes[1] - slopes[0]), abs(bends[1] - bends[0]))
            )
    size = float(values.abs().max()) * 30  # per second: keys are a thirtieth apart
    assert max(slope for slope, _ in jumps["spline"]) < 0.02 * size
    assert max(bend for _, bend in jumps["spline"]) < 0.02 * size * 30
    assert min(slope for slope, _ in jumps["nodes"]) > 0.1 * size


def skew(vector):
    """Matrices of the cross product."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def matrix(q):
    """Rotation matrices of unit quaternions, by rotating the axes."""
    w, u = q[..., :1, None], skew(q[..., 1:])
    return torch.eye(3).to(q) + 2.0 * w * u + 2.0 * u @ u


def test_rotations_are_matrix_exponentials():
    """Of any angle, zero included, where the derivative is half the vector."""
    vector = (4.0 * (random(20, 3) - 0.5)).double()
    vector[0] = 0.0
    torch.testing.assert_close(matrix(quaternion_of(vector)), torch.matrix_exp(skew(vector)))
    slope = torch.autograd.functional.jacobian(quaternion_of, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(slope, torch.cat([torch.zeros(1, 3), 0.5 * torch.eye(3)]).double())


def rigid():
    """In float64: a model, its binding, and which Gaussians move."""
    scene = layered().map(lambda t: t.double() if t.is_floating_point() else t)
    motion = made("rigid_nodes", scene, size=1.0).double()
    return motion, motion.bind(scene), scene


def test_rigid_nodes_are_their_definition():
    """By R(w) (x - p) + p + t with weighted means, written out in matrices;
    the static layer does not move.
    """
    motion, binding, scene = rigid()
    weight, got = binding[:, : len(motion.node)], motion.at_keys(binding, [0, 3])
    for n, key in enumerate((0, 3)):
        turn = torch.matrix_exp(skew(weight @ motion.rotation[key]))
        centre = weight @ motion.node
        want = (
            (turn @ (scene.mean - centre)[..., None])[..., 0] + centre + weight @ motion.offset[key]
        )
        torch.testing.assert_close(scene.mean + got.offset[n], want)
        torch.testing.assert_close(matrix(got.rotation[n]), turn)
    static = scene.layer == 0
    assert got.offset[:, static].abs().max() == 0
    assert got.offset[:, ~static].abs().max() > 0.1


def test_gradients_of_rigid_nodes_are_those_of_finite_differences():
    """W.r.t. rotations, translations and means, of which the gradient is the rotation;
    from no rotation, too.
    """
    motion, binding, scene = rigid()
    weight, mean = binding[:, : len(motion.node)], scene.mean

    def results(rotation, offset, mean):
        values = {"rotation": rotation, "offset": offset}
        arguments = torch.cat([weight, mean], dim=1), [1, 2]
        return tuple(
            torch.func.functional_call(
                _AtKeys(motion), {f"motion.{k}": v for k, v in values.items()}, arguments
            )
        )

    for factor in (1.0, 0.0):
        leaves = [(factor * motion.rotation).detach(), motion.offset.detach(), mean]
        assert torch.autograd.gradcheck(results, [leaf.clone().requires_grad_() for leaf in leaves])
    leaf = mean.clone().requires_grad_()
    cotangent = random(*mean.shape, seed=9).double()
    moved = leaf + motion.at_keys(motion.bind(replace(scene, mean=leaf)), [1]).offset[0]
    (gradient,) = torch.autograd.grad((moved * cotangent).sum(), leaf)
    turn = torch.matrix_exp(skew(weight @ motion.rotation[1]))
    torch.testing.assert_close(gradient, (turn.mT @ cotangent[..., None])[..., 0])
    assert (gradient - cotangent).abs().max() > 0.01


class _AtKeys(torch.nn.Module):
    """``at_keys`` as the forward pass that torch calls with other parameters."""

    def __init__(self, motion):
        super().__init__()
        self.motion = motion

    def forward(self, binding, keys):
        return self.motion.at_keys(binding, keys)


def test_a_rigid_motion_that_nodes_share_is_reproduced():
    """Rotation by 0.7 about an axis through any point: all Gaussians of the layer follow exactly,
    covariances too.
    """
    scene = replace(
        layered(30), layer=torch.ones(30, dtype=torch.long), quaternion=random(30, 4, seed=7)
    )
    motion = made("rigid_nodes", scene, size=0.0)
    axis, centre = (
        torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0),
        torch.tensor([0.2, 0.9, -0.4]),
    )
    turn = torch.matrix_exp(skew(0.7 * axis))
    with torch.no_grad():
        motion.rotation[1] = 0.7 * axis
        motion.offset[1] = (motion.node - centre) @ turn.T + centre - motion.node
    moved = scene.moved(*motion.at(motion.bind(scene), motion.times[1]))
    torch.testing.assert_close(
        moved.mean, (scene.mean - centre) @ turn.T + centre, rtol=1e-5, atol=1e-6
    )
    one, other = (
        matrix(torch.nn.functional.normalize(g.quaternion, dim=1)) for g in (scene, moved)
    )
    torch.testing.assert_close(other, turn @ one, rtol=1e-5, atol=1e-6)


def test_rotations_are_interpolated_on_the_shorter_way():
    """Halfway between no rotation and a third of a turn is a sixth, whatever displacements do."""
    angle = 2 * math.pi / 3
    ends = quaternion_of(torch.tensor([[[0.0, 0, 0]], [[0.0, 0, angle]]]))
    turn = interpolated(KeyMotion(torch.zeros(2, 1, 3), ends), [0, 1], [0.5, 0.5]).rotation
    want = quaternion_of(torch.tensor([[0.0, 0, angle / 2]]))
    torch.testing.assert_close(torch.nn.functional.normalize(turn, dim=1), want)


@pytest.mark.parametrize("kind", KINDS)
def test_a_replay_draws_what_render_draws(run, kind):  # noqa: F811
    """Curves and rotations alike, from cameras that widen and cameras that do not."""
    scene = replace(gaussians(60, CAMERA, seed=3), layer=torch.ones(60, dtype=torch.long))
    motion = made(kind, scene, size=0.5).to(run.field.device)
    scene = scene.map(lambda tensor: tensor.to(run.field.device))
    moving = replace(run, field=scene, motion=motion, binding=motion.bind(scene))
    render = moving.renderer()
    for camera in (CAMERA, aside(0.1), CAMERA.resized(20, 15)):
        for time in (*TIMES, 0.02, 0.05):
            compare(render(time, camera), moving.render(time, camera))
    images = [render(time, CAMERA).distance.clone() for time in (0.0, 0.0667)]
    assert kind == "still" or float((images[1] - images[0]).abs().max()) > 0.05


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", ["spline", "rigid_nodes"])
def test_a_short_fit_lowers_the_loss_and_is_read_again(kind, device, tmp_path):
    """Sixty images; all parameters move, and the folder gives back the model that was trained."""
    settings = demo(
        images=60, log_every=12, warm_up=0, motion=MotionSettings(kind=kind, from_tracks=False)
    )
    run = reconstruct(small(), tmp_path / "run", settings, device=device)  # noqa: F811
    losses = [row["loss"] for row in rows(run.path) if "loss" in row]
    assert losses[-1] < 0.9 * losses[0]
    assert type(run.motion) is KINDS[kind]
    for name, parameter in run.motion.named_parameters():
        assert parameter.abs().max() > 1e-4, name
    again = Run.open(run.path)
    assert same(again.motion.state_dict(), {n: t.cpu() for n, t in run.motion.state_dict().items()})
    assert stored(run.path)["motion"]["kind"] == kind
    torch.testing.assert_close(
        again.render(0.06).quads, run.render(0.06).quads.cpu(), rtol=1e-4, atol=1e-4
    )


def test_a_training_step_differentiates_means_through_rotations(monkeypatch):
    """Its gradient is that of finite differences of its loss,
    where the moving layer is rotated by one radian.
    """
    weights = Weights(quads=1.0, ssim=0.0, distortion=0.0, flow=0.0, motion_size=0.0)
    settings = demo(
        images=60,
        warm_up=0,
        weights=weights,
        background=0.0,
        motion=MotionSettings(kind="rigid_nodes"),
    )
    settings = replace(
        settings, render=replace(settings.render, clamp_gradient=ClampGradient.EXACT)
    )
    observations, lists = observe(small(), settings, "cpu"), []
    point = descent.AdamTable.point
    monkeypatch.setattr(
        descent.AdamTable,
        "point",
        lambda table, given, pairs: lists.append(given) or point(table, given, pairs),
    )

    def loss(shift=0.0):
        """Mean over the images of the first batch, with all nodes in one rigid motion;
        means moved before it.
        """
        state = begin(observations, settings, seed=0, device="cpu")
        vector = torch.tensor([0.2, 0.9, -0.3])
        with torch.no_grad():
            arm = state.motion.node - state.motion.node.mean(dim=0)
            state.motion.rotation[:] = vector
            state.motion.offset[:] = arm @ torch.matrix_exp(skew(vector)).T - arm
            state.optimiser.tensors["mean"].add_(shift)
        stepper = Stepper(state, observations, settings)
        stepper.step()
        stepper.collect()
        return float(state.sums["loss"] / state.sums["count"]), state.optimiser

    _, optimiser = loss()
    row, batch = list(optimiser.tensors).index("mean"), len(observations.batches[0])
    gradient = sum(given[row] for given in lists[0] if given[row] is not None) / batch
    gradient = gradient * (optimiser.layer > 0)[:, None]
    step = 1e-3 * gradient / gradient.abs().max()
    slope = (loss(step)[0] - loss(-step)[0]) / 2.0
    assert slope > 1e-6
    assert slope == pytest.approx(float((gradient * step).sum()), rel=0.03)
