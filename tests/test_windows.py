"""Moving Gaussians that exist during one quartet: presence, straight motion, training, storage."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import gaussians
from small_runs import KEYS, field, random, small

from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.errors import UsageError
from gftorf_warp.recon import densify, presets, renderings
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.presets import Recorded
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Batch, DensifySettings
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.stepper import Stepper
from gftorf_warp.recon.train import chosen_settings
from gftorf_warp.render import api, reference
from gftorf_warp.render.buffers import RenderSettings, SplatDistance
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.motion import Motion, MotionSettings, MotionStart
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.scene.windows import Windows

CAMERA = Camera.from_fov(40, 30, 60.0)
LENS = Distortion(k1=-0.25, k2=0.08, p1=0.02, p2=-0.03, k3=-0.01)
WINDOWS = len(KEYS) - 1
PERIOD = float(KEYS[1])  # [s] of a quartet
# at the start and the end of the recording and beyond, in every window, at both sides of a border
TIMES = (
    -0.5,
    0.0,
    0.4 * PERIOD,
    PERIOD - 1e-9,
    PERIOD,
    1.5 * PERIOD,
    2.2 * PERIOD,
    float(KEYS[-1]),
)


def window_at(time):
    """Number of the window of a time [s]."""
    return min(max(int(np.floor(time / PERIOD + 1e-12)), 0), WINDOWS - 1)


def labelled(n=12, seed=2):
    """Gaussians in front of the camera: static ones, and as many of every window."""
    scene = gaussians(n, CAMERA, seed=seed, opacity=(0.5, 0.9))
    return replace(scene, layer=torch.arange(n) % (WINDOWS + 1))


def started(scene, velocity=None, **settings):
    """Windows of the moving Gaussians of a field, with velocities [m per window]."""
    initial = MotionStart(
        key_times=KEYS,
        field=scene,
        tracks=None,
        duration=0.1,
        unambiguous_range=7.5,
        generator=torch.Generator(),
        velocity=velocity,
    )
    return Windows.start(MotionSettings(kind="windows", **settings), initial)


def model(scene):
    """Windows of nodes with random velocities of some decimetres."""
    motion = started(scene, nodes=5, neighbours=3)
    with torch.no_grad():
        motion.velocity.add_(0.4 * (random(*motion.velocity.shape, seed=4) - 0.5))
    return motion


def present(scene, time):
    """Which Gaussians exist at a time."""
    return (scene.layer == 0) | (scene.layer == 1 + window_at(time))


@pytest.mark.parametrize("time", TIMES)
def test_a_gaussian_exists_in_its_own_window_only_and_static_ones_never_move(time):
    """Also before the recording and after it; at a border the later window counts."""
    scene = labelled()
    motion = model(scene)
    offset = motion.at(motion.bind(scene), time).offset
    here = present(scene, time)
    assert 0 < here.sum() < len(here)
    assert offset[scene.layer == 0].abs().max() == 0.0
    assert offset[here].abs().max() < 0.3
    assert offset[~here].abs().min() > 1e5


@pytest.mark.parametrize("time", TIMES)
def test_motion_in_a_window_is_straight(time):
    """(t - middle) / duration times the weighted mean of the velocities of the nearest nodes."""
    scene = labelled(24)
    motion = model(scene)
    offset = motion.at(motion.bind(scene), time).offset
    start = PERIOD * window_at(time)
    share = np.clip((time - start) / PERIOD, 0.0, 1.0) - 0.5
    node, label = motion.node.numpy(), motion.label.numpy()
    for row in (scene.layer == 1 + window_at(time)).nonzero()[:, 0].tolist():
        own = np.flatnonzero(label == int(scene.layer[row]))
        apart = np.linalg.norm(scene.mean[row].numpy() - node[own], axis=1)
        near = np.argsort(apart)[: motion.neighbours]
        weight = np.exp(-2.0 * (apart[near] / apart[near].max()) ** 2)
        velocity = motion.velocity.detach().numpy()[own[near]]
        want = share * (weight / weight.sum()) @ velocity
        np.testing.assert_allclose(offset[row].detach().numpy(), want, rtol=1e-4, atol=1e-7)


def test_nodes_start_with_the_median_velocity_of_their_own_window():
    """Windows that cross each other in space share nothing; the ends of a window are one velocity
    apart.
    """
    mean = random(90, 3, seed=1) + torch.tensor([0.0, 0.0, 2.0])
    scene = field(mean, 1 + torch.arange(90) % 3)
    speeds = torch.tensor([[0.1, 0, 0], [0, -0.2, 0], [0, 0, 0.3]])
    velocity = speeds[scene.layer - 1].clone()
    velocity[::7] = 5.0  # outliers
    motion = started(scene, velocity, nodes=8)
    assert motion.label.tolist() == sorted([1, 2, 3] * 8)
    torch.testing.assert_close(motion.velocity.detach(), speeds[motion.label - 1])
    ends = motion.at_keys(motion.bind(scene), [2, 3]).offset
    own = scene.layer == 2
    torch.testing.assert_close((ends[1] - ends[0])[own], speeds[1].expand(30, 3))


def test_a_recording_in_which_nothing_moves_has_no_nodes():
    """Static Gaussians are rendered; a field without labels is refused."""
    scene = replace(labelled(), layer=torch.zeros(12, dtype=torch.long))
    motion = model(scene)
    assert len(motion.velocity) == 0
    assert motion.at(motion.bind(scene), 0.05).offset.abs().max() == 0.0
    again = Windows.from_dict(motion.to_dict())
    assert torch.equal(again.at(again.bind(scene), 0.05).offset, torch.zeros(12, 3))
    with pytest.raises(ValueError, match="one layer per quartet"):
        started(replace(scene, layer=None))


def test_gradients_of_velocities_are_those_of_finite_differences():
    """Within a window, at both of its ends; those of other windows are zero."""
    scene = labelled(24)
    motion = model(scene)
    binding = motion.bind(scene).double()
    for time in (1.1 * PERIOD, PERIOD, 2.0 * PERIOD - 1e-6):
        leaf = motion.velocity.detach().double().clone().requires_grad_()

        def offsets(velocity, time=time):
            keys = motion.keys_at(time)
            held = {"velocity": velocity}
            there = torch.func.functional_call(_AtKeys(motion), _named(held), (binding, keys.index))
            moved = (there * torch.tensor(keys.weight)[:, None, None].double()).sum(dim=0)
            return moved[present(scene, time)]

        assert torch.autograd.gradcheck(offsets, [leaf])
        (gradient,) = torch.autograd.grad(offsets(leaf).square().sum(), leaf)
        own = motion.label == 2
        assert gradient[own].abs().amax(dim=1).min() > 0.0
        assert gradient[~own].abs().max() == 0.0


class _AtKeys(torch.nn.Module):
    """Displacements at keys as a forward pass, which torch calls with other parameters."""

    def __init__(self, motion):
        super().__init__()
        self.motion = motion

    def forward(self, binding, keys):
        return self.motion.at_keys(binding, keys).offset


def _named(parameters):
    return {f"motion.{name}": value for name, value in parameters.items()}


def test_gradients_of_velocities_through_a_rendering_are_the_oracles():
    """Kernels in float32 against the oracle in float64, of light and distance."""
    scene = labelled(60, seed=5)
    scene = replace(scene, log_scale=scene.log_scale.clamp_min(-1.8))
    motion, sensor = model(scene), Sensor(phase_offset=0.3)
    settings = RenderSettings(low_pass=0.1, near=0.2, far=20.0)
    generator = torch.Generator().manual_seed(0)
    cotangents = torch.randn(5, CAMERA.height, CAMERA.width, generator=generator)
    found = []
    for rasterize, dtype in ((api.rasterize, torch.float32), (reference.rasterize, torch.float64)):
        same = Windows.from_dict(motion.to_dict()).to(dtype)
        given = scene.map(lambda t, to=dtype: t.to(to) if t.is_floating_point() else t)
        moved = given.moved(*same.at(same.bind(given), 1.7 * PERIOD))
        image = rasterize(moved, CAMERA, sensor, settings)
        both = torch.cat([image.quads, image.distance[None]])
        loss = (both * cotangents.to(dtype)).sum()
        found.append(torch.autograd.grad(loss, same.velocity)[0].double())
    got, want = found
    assert want[motion.label == 2].abs().max() > 0.1
    torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-3 * float(want.abs().max()))


def run_of(scene, motion, tmp_path, *, camera=CAMERA, optimised=(20, 15)):
    """A finished run of these Gaussians."""
    render = {"near": 0.1, "far": 20.0, "low_pass": 0.1, "splat_distance": "plane"}
    return Run(
        path=tmp_path,
        config={"settings": {"render": render}, "size_optimised": [*optimised], "colour_scale": 1},
        camera=camera,
        sensor=Sensor(phase_offset=0.2, shifts=CANONICAL_SHIFTS),
        quad_scale=1.0,
        field=scene,
        motion=motion,
        binding=motion.bind(scene),
    )


def cameras():
    """Views from which something absent might be seen: the usual one; the opposite one; along each
    axis, and across the direction in which absent Gaussians are, so that their z-depth is a few
    metres; each as a pinhole and through a lens.
    """
    across = torch.linalg.qr(
        torch.tensor([[1.0, 1.0, 0.3], [-1.0, 1.0, 0.2], [0.0, 1.0, -0.9]]).double()
    ).Q.numpy()
    across *= np.sign(np.linalg.det(across))
    turns = [np.eye(3), np.diag([-1.0, 1.0, -1.0]), across]
    for axes in ((1, 2, 0), (2, 0, 1)):
        turns.append(np.eye(3)[list(axes)])
    # third row across (1, 1, 1)
    x, z = np.ones(3) / 3**0.5, np.array([1.0, -1.0, 0.0]) / 2**0.5
    turns.append(np.stack([x, np.cross(z, x), z]))
    turns.append(np.stack([np.cross(x, z), x, z]))
    for turn in turns:
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = turn, 2.0
        for lens in (Distortion(), LENS):
            yield replace(CAMERA, camera_from_world=pose, distortion=lens)


def test_absent_gaussians_leave_no_trace_in_any_image(tmp_path):
    """From any side and through a lens: every image is that of the present Gaussians alone."""
    scene = labelled(60, seed=5)
    scene = replace(scene, log_scale=scene.log_scale + 1.0)
    motion = model(scene)
    run, seen = run_of(scene, motion, tmp_path), 0
    render = run.renderer()
    for time in (0.3 * PERIOD, 1.9 * PERIOD):
        here = present(scene, time).nonzero()[:, 0]
        only = scene.map(lambda value, rows=here: value[rows])
        alone = replace(run, field=only, binding=motion.bind(only))
        for camera in cameras():
            want = alone.render(time, camera)
            seen += bool(want.opacity.max() > 0.5)
            for got in (run.render(time, camera), render(time, camera)):
                for name in ("quads", "phasor", "colour", "distance", "opacity", "distortion"):
                    image, other = getattr(got, name), getattr(want, name)
                    assert image.isfinite().all()
                    atol = 2e-5 * max(float(other.abs().max()), 1e-3)
                    torch.testing.assert_close(image, other, rtol=1e-4, atol=atol, msg=name)
    assert seen >= 8


def test_each_window_is_rendered_from_its_own_gaussians(tmp_path):
    """Images before the first window and after the last are those of its ends; ``renderer`` agrees
    with ``render`` in any order of times.
    """
    scene = labelled(60, seed=5)
    run = run_of(scene, model(scene), tmp_path, optimised=(40, 30))
    render, images = run.renderer(), {}
    for time in (*TIMES, *reversed(TIMES)):
        images[time] = run.render(time)
        for name in ("quads", "distance", "opacity"):
            want = getattr(images[time], name)
            got = getattr(render(time, CAMERA), name)
            torch.testing.assert_close(got, want, rtol=1e-4, atol=2e-5 * float(want.abs().max()))
    assert torch.equal(images[-0.5].quads, images[0.0].quads)
    assert torch.equal(run.render(9.0).quads, images[float(KEYS[-1])].quads)
    jump = (images[PERIOD].distance - images[PERIOD - 1e-9].distance).abs().max()
    assert jump > 0.1, "other Gaussians take over"


def test_split_and_cloned_gaussians_stay_in_their_window():
    """Windows that are ten metres apart: each new Gaussian is beside its parent and has its
    label, and so it is bound to the nodes of its window.
    """
    settings = presets.best()
    state = begin(observe(small(), settings, "cpu"), settings, seed=0, device="cpu")
    optimiser, motion = state.optimiser, state.motion
    labels = optimiser.layer
    assert labels.max() > 1
    with torch.no_grad():
        optimiser.tensors["mean"].copy_(0.1 * optimiser.tensors["mean"] + 10.0 * labels[:, None])
    count = len(labels)
    wanted = torch.arange(count) % 2
    statistics = replace(
        densify.start(optimiser.field), gradient=wanted.float(), pixels=torch.ones(count)
    )
    limit = float(optimiser.field.scale.detach().amax(dim=1).median())
    rules = DensifySettings(every=1, gradient_min=0.5, clone_scale_max=limit, opacity_min=0.01)
    counts, _ = densify.densify(
        optimiser, statistics, rules, torch.Generator().manual_seed(0), prunes_scale=False
    )
    assert min(counts["cloned"], counts["split"]) > 10
    grown = optimiser.field
    assert torch.equal((grown.mean[:, 0] / 10.0).round().long(), grown.layer)
    binding = motion.bind(grown)
    for time in (motion.times[0], motion.times[1]):
        window = motion.keys_at(time).index[0] // 2
        away = motion.at(binding, time).offset.abs().amax(dim=1) > 1e5
        assert torch.equal(away, (grown.layer != 0) & (grown.layer != 1 + window))


@pytest.mark.parametrize("batch", [Batch.QUARTET, Batch.FRAME])
def test_gaussians_of_other_windows_take_no_part_in_a_step(batch, monkeypatch):
    """Same bits as with all of them in every rendering, moments and statistics included, while
    fewer are rendered; with densification, which changes which rows they are.
    """
    settings = presets.best()
    settings = replace(
        settings,
        schedule=replace(settings.schedule, batch=batch),
        densify=DensifySettings(every=40, start=30, gradient_min=1e-5, opacity_min=0.01),
    )
    observations, ends, rendered = observe(small(), settings, "cpu"), [], []

    def counted(field, *given, **more):
        rendered[-1].append(len(field))
        return api.rasterize(field, *given, **more)

    monkeypatch.setattr(renderings, "rasterize", counted)
    for chooses in (Windows.present, Motion.present):
        monkeypatch.setattr(Windows, "present", chooses)
        state = begin(observations, settings, seed=0, device="cpu")
        rendered.append([])
        steps = Stepper(state, observations, settings)
        while state.images < 60:
            steps.step()
        steps.collect()
        ends.append(to_dict(state))
    one, other = (dict(leaves(end)) for end in ends)
    assert one.keys() == other.keys()
    unequal = [name for name in one if not torch.equal(one[name], other[name])]
    assert not unequal
    assert all(few < 0.8 * every for few, every in zip(*rendered, strict=True))
    assert len({*rendered[1]}) > 1, "densification changed their number"


def leaves(stored, name=""):
    """All tensors of a checkpoint by their path."""
    if isinstance(stored, torch.Tensor):
        yield name, stored
    elif isinstance(stored, dict):
        for key, value in stored.items():
            yield from leaves(value, f"{name}/{key}")
    elif isinstance(stored, list | tuple):
        for n, value in enumerate(stored):
            yield from leaves(value, f"{name}/{n}")


def test_a_state_with_windows_is_stored_and_continues():
    """Checkpoint and back: same binding, velocities and displacements."""
    settings = presets.best()
    state = begin(observe(small(), settings, "cpu"), settings, seed=0, device="cpu")
    again = from_dict(to_dict(state), "cpu")
    assert type(again.motion) is Windows
    assert torch.equal(again.binding, state.binding)
    assert torch.equal(again.motion.velocity, state.motion.velocity)
    one, other = (s.motion.at(s.binding, 0.05).offset for s in (state, again))
    assert torch.equal(one, other)
    assert len(state.motion.velocity) > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["motion.kind=nodes"], "init.kind quartets does not fit motion.kind nodes"),
        (["init.kind=phase"], "init.kind phase does not fit motion.kind windows"),
        (["init.kind=random"], "init.kind random does not fit motion.kind windows"),
        (["weights.flow=0.001"], "weights.flow does not fit"),
        (["weights.motion_size=0.1"], "weights.motion_size does not fit"),
    ],
)
def test_settings_that_contradict_windows_are_refused(changes, message):
    """By name, with what to set instead; both changes together are allowed."""

    def chosen(*more, preset="best"):
        return chosen_settings(small(), preset, None, "quads", None, None, more)

    with pytest.raises(UsageError, match=message) as error:
        chosen(*changes)
    assert "set" in error.value.fix
    assert chosen("init.kind=phase", "motion.kind=nodes").motion.kind == "nodes"
    assert (
        chosen("init.kind=quartets", "motion.kind=windows", preset="demo").init.kind == "quartets"
    )
    with pytest.raises(UsageError, match=r"init\.kind phase does not fit"):
        chosen("motion.kind=windows", preset="demo")


def test_preset_best_depends_on_whether_the_camera_moves():
    """Windows for a static camera; else nodes, and one radius of the low-pass filter each."""
    still, carried = presets.best(), presets.best(Recorded(camera_moves=True))
    assert (still.motion.kind, carried.motion.kind) == ("windows", "nodes")
    assert (still.init.kind, carried.init.kind) == ("quartets", "phase")
    assert still.render.splat_distance == SplatDistance.PLANE
    assert still.preset == carried.preset == "best"
    assert still.fallback
    assert carried.fallback
