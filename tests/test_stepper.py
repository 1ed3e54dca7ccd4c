"""Training steps: on a CPU eager, on a GPU as CUDA graphs,
both against plain torch (plain_step.py).
"""

import contextlib
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording, turned, with_colour
from plain_step import plain_step
from sequences import changed
from small_runs import demo, random, small

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.recon import presets, stepper
from gftorf_warp.recon.keys import GraphKey
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.settings import Batch, Input, Norm, Weights
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.step import Step
from gftorf_warp.recon.stepper import Stepper
from gftorf_warp.recon.terms import TERMS, Term, View
from gftorf_warp.render import fused
from gftorf_warp.render.api import rasterize
from gftorf_warp.render.cuda import CapturedGraph
from gftorf_warp.render.layers import Form
from gftorf_warp.render.tensor_cores import FusedLayers, fits
from gftorf_warp.scene.initialise import Init
from gftorf_warp.scene.motion import MotionSettings, Products

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]


def begun(settings, device="cpu", sequence=None):
    """A state of Gaussians that are not round, and what it is fitted to."""
    observations = observe(sequence or small(), settings, device)
    state = begin(observations, settings, seed=3, device=device)
    with torch.no_grad():
        scale = state.optimiser.tensors["log_scale"]
        scale += 0.5 * random(*scale.shape).to(device)
    return state, observations


def published(name="released", **changes):
    """A short run of a published preset: warm-up, small network, flow,
    densification and an opacity reset.
    """
    settings = presets.shortened(presets.preset(name), 60)
    motion = replace(
        settings.motion,
        layers=3,
        width=16,
        skip_after=1,
        position_frequencies=3,
        time_frequencies=2,
    )
    init = replace(settings.init, count=300)
    densify = replace(
        settings.densify, every=8, start=12, reset_every=20, gradient_min=1e-6, loses_step=False
    )
    schedule = {key: changes.pop(key) for key in ("batch", "colour_from") if key in changes}
    settings = replace(settings, **{"motion": motion, "init": init, "densify": densify} | changes)
    return replace(
        settings, schedule=replace(settings.schedule, warm_up=6, flow_from=8, **schedule)
    )


def alike(one, other, few=0.01, signs=0.0):
    """Two states after the same images: to rounding on a CPU, but for a share of ``few`` elements
    on a GPU.

    On a CPU a share of ``signs`` may differ alike: the gradient of an L1 term is the sign of a
    difference.

    Atomic additions of the backward pass happen there in any order, so gradients differ by a
    rounding, graph or not. Adam, whose epsilon is far below any gradient, makes whole steps of
    gradients that are nothing but rounding: a few elements may be a few steps apart, which is no
    error.
    """
    largest = 5e-2 if signs else 2e-2  # two steps of one element, measured on an H200
    few = few if one.optimiser.leaves[0].is_cuda else signs
    assert len(one.optimiser.field) == len(other.optimiser.field)
    for leaf, twin in zip(one.optimiser.leaves, other.optimiser.leaves, strict=True):
        apart = ~torch.isclose(leaf, twin, rtol=1e-3, atol=2e-5)
        assert apart.float().mean() <= few
        torch.testing.assert_close(leaf, twin, rtol=1e-3, atol=largest if few else 2e-5)
    assert one.sums.keys() == other.sums.keys()
    for name in one.sums:
        torch.testing.assert_close(one.sums[name], other.sums[name], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(
        one.statistics.pixels, other.statistics.pixels, rtol=1e-3 if few else 0, atol=4 * few
    )
    torch.testing.assert_close(
        one.statistics.gradient, other.statistics.gradient, rtol=1e-2, atol=1e-6 + 1e-2 * few
    )


@contextlib.contextmanager
def observed():
    """Lists that get the key of every step whose operations are called, not replayed,
    and every CUDA graph.
    """
    keys, graphs, run, made = [], [], Step.run, CapturedGraph.__init__
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Step, "run", lambda self, key, *given: keys.append(key) or run(self, key, *given)
        )
        patch.setattr(
            CapturedGraph,
            "__init__",
            lambda self, *given: graphs.append(self) or made(self, *given),
        )
        yield keys, graphs


def compared(settings, device, sequence=None, *, images=((20, 0.01),), signs=0.0):
    """The stepper and plain torch from one start, compared after so many images;
    returns the stepper's state.
    """
    plain, observations = begun(settings, device, sequence)
    state, _ = begun(settings, device, sequence)
    steps = Stepper(state, observations, settings)
    with observed() as (keys, graphs):
        for count, few in images:
            while plain.images < count:
                assert plain_step(plain, observations, settings)
                steps.step()
                assert plain.images == state.images
            assert steps.collect() == 0
            alike(plain, state, few, signs)
    assert keys
    assert bool(graphs) == (device != "cpu" and settings.graph)
    return state


SETTINGS = [published, lambda **changes: demo(images=60, **changes)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
@pytest.mark.parametrize("make", SETTINGS, ids=["published", "demo"])
def test_steps_are_those_of_plain_torch(make, batch, device):
    """Every tensor, sum and statistic after 20 images and after 40, with densification and an
    opacity reset.

    On a GPU rounding grows: whether a pixel still takes a splat is decided differently somewhere,
    and splats behind it differ by a part of a step. Measured on an H200 with quartets of ``demo``:
    2e-6 at most after 20 images, after 40 4.5 % of the quaternions and 2.2 % of the harmonics, a
    third of a step at most.
    """
    compared(make(batch=batch), device, images=((20, 0.01), (40, 0.06)))


@pytest.mark.parametrize("device", DEVICES)
def test_frozen_gaussians_may_still_be_densified(device):
    """The network is then evaluated where the new ones are."""
    settings = published(batch=Batch.FRAME)
    schedule = replace(settings.schedule, freeze_from=0.25)
    compared(replace(settings, schedule=schedule), device, images=((34, 0.01),))


INPUTS = {
    "phasors": {"input": Input.PHASOR},
    "phasors, flow and depth": {"input": Input.PHASOR, "weights": Weights(flow=0.01, depth=0.3)},
    "depth": {"weights": Weights(depth=0.3, distortion=0.1)},
    "length of displacements": {"weights": Weights(motion_size=0.5, flow=0.01)},
    "no similarity": {"weights": Weights(ssim=0.0, flow=0.01)},
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", INPUTS)
def test_steps_of_other_inputs_are_those_of_plain_torch(name, device):
    """Every term of the loss is part of one of these or of the presets.

    The similarity of distances is a difference of close numbers in float32, which grows faster.
    """
    weights = INPUTS[name].get("weights", demo().weights)
    images, signs = (((4, 0.05),), 0.02) if weights.depth else (((12, 0.01),), 0.0)
    state = compared(demo(images=60, **INPUTS[name]), device, images=images, signs=signs)
    assert {
        term
        for term in ("flow", "depth", "distortion", "motion_size")
        if getattr(weights, term) > 0
    } <= {*state.sums}


def moving(frames=12):
    """The recording of a camera that turns and moves."""
    sequence = recording(frames=frames)[0]
    poses = np.stack([turned(0.5 * n, (0.01 * n, 0.0, 0.0)) for n in range(frames)])
    return replace(sequence, camera_from_world=poses)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("case", ["quads and colour", "phasors and colour", "colour alone"])
def test_steps_of_a_moving_camera_with_colour_are_those_of_plain_torch(case, device):
    """A second camera of another size, another pose in every image; colour begins along the run."""
    weights = Weights(colour=0.5, flow=0.01, ssim=0.2, colour_norm=Norm.L1)
    changes = {"input": Input.PHASOR} if case == "phasors and colour" else {}
    if case == "colour alone":
        weights = replace(weights, quads=0.0, flow=0.0, depth=0.1)
    settings = published(
        weights=weights, colour_from=8 if "and" in case else 0, batch=Batch.QUARTET, **changes
    )
    settings = replace(settings, init=replace(settings.init, kind=Init.RANDOM, bounds=(2.0, 5.0)))
    state = compared(settings, device, with_colour(moving()), images=((16, 0.01),), signs=0.02)
    assert "colour" in state.sums
    assert state.optimiser.tensors["colour_constant"].abs().max() > 0


def cycled(shifts, frequencies=(20e6,), *, cycles=3):
    """A recording of some shifts at some frequencies, one after the other;
    its quads are of no matter.
    """
    count = cycles * len(shifts) * len(frequencies)
    base = recording(frames=count, with_flow=False)[0]
    hz = np.tile(np.repeat(frequencies, len(shifts)), cycles)
    return changed(
        base,
        shifts=np.tile(shifts, cycles * len(frequencies)),
        f_mod_hz=frequencies[0],
        frequencies_hz=hz if len(frequencies) > 1 else None,
        cycle_length=len(shifts) * len(frequencies),
    )


CYCLES = {
    "three": lambda: cycled(tuple(math.tau * k / 3 for k in range(3))),
    "five": lambda: cycled(tuple(math.tau * k / 5 for k in (3, 0, 4, 1, 2))),
    "two frequencies": lambda: cycled((0.0, 2.1, 4.2), (SPEED_OF_LIGHT / 5, SPEED_OF_LIGHT / 7.5)),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CYCLES)
def test_steps_of_other_cycles_are_those_of_plain_torch(name, device):
    """Batches of 3, 5 and 6 raw frames; more than four images need one more sum of gradients."""
    sequence = CYCLES[name]()
    settings = replace(demo(images=60), cycle=sequence.cycle)
    settings = replace(
        settings, init=replace(settings.init, kind=Init.RANDOM, count=200, bounds=(2.0, 5.0))
    )
    state = compared(settings, device, sequence, images=((2 * sequence.cycle, 0.01),))
    assert state.images == 2 * sequence.cycle


@pytest.mark.parametrize("device", DEVICES)
def test_one_graph_serves_every_frame(device):
    """Other raw frames, poses, shifts and frequencies have the same key:
    only control data differ.
    """
    sequence = CYCLES["two frequencies"]()
    poses = np.stack([turned(0.5 * n, (0.01 * n, 0.0, 0.0)) for n in range(sequence.frames)])
    settings = replace(demo(images=36, batch=Batch.FRAME, warm_up=0), cycle=sequence.cycle)
    settings = replace(
        settings, init=replace(settings.init, kind=Init.RANDOM, count=200, bounds=(2.0, 5.0))
    )
    state, observations = begun(settings, device, replace(sequence, camera_from_world=poses))
    steps = Stepper(state, observations, settings)
    with observed() as (keys, graphs):
        for _ in observations.batches:
            steps.step()
        assert steps.collect() == 0
    assert len({*keys}) == 1
    assert len(graphs) == (device != "cpu")


# -- terms from outside ----------------------------------------------------------------------------


def brightness(image, _out):
    """Mean absolute rendered quad, and the mean square of the displacements, in plain torch."""
    squared = image.displacement.square().sum(dim=1)
    return image.renderings[View.TOF].quads.abs().mean() + 0.1 * (squared * image.mean_weight).sum()


EXTRA = Term(
    name="brightness",
    loss=brightness,
    weight=lambda _settings, images: 0.5 if images >= 4 else 0.0,
    outputs=frozenset({"quads"}),
    needs_motion=True,
)


@pytest.mark.parametrize("device", DEVICES)
def test_a_term_from_outside_is_trained_and_logged(device):
    """Plain torch operations: its gradient arrives in the parameters,
    its weighted sum in the log.
    """
    only = replace(EXTRA, weight=lambda *_: 0.5)
    settings = demo(images=60, warm_up=0, background=0.0)
    state, observations = begun(settings, device)
    frames = observations.batches[0]
    field, motion, total, values = state.optimiser.field, state.motion, 0.0, []
    for frame in frames:
        displacement = motion.at(state.binding, observations.time_at(frame))
        camera, sensor = observations.cameras[frame], observations.sensor_at(frame)
        quads = rasterize(field.moved(*displacement), camera, sensor, settings.render).quads
        values.append(
            0.5 * (quads.abs().mean() + 0.1 * displacement.offset.square().sum(dim=1).mean())
        )
        total = total + values[-1] / len(frames)
    wanted = torch.autograd.grad(total, state.optimiser.leaves, allow_unused=True)
    state.queue = [0]
    steps = Stepper(state, observations, settings, terms=(only,))
    steps.step()
    assert steps.collect() == 0
    assert float(state.sums["brightness"]) == pytest.approx(float(sum(values).detach()), rel=1e-4)
    assert float(state.sums["loss"]) == pytest.approx(float(state.sums["brightness"]), rel=1e-5)
    for name in ("mean", "opacity_logit", "reflectivity_sh"):
        tensor = state.optimiser.tensors[name]
        _, first, _ = state.optimiser.moments_of(tensor)
        gradient = wanted[[*state.optimiser.tensors].index(name)]
        assert gradient.abs().max() > 0
        share = 1 - state.optimiser.betas[0]
        torch.testing.assert_close(
            first, share * gradient, rtol=1e-2, atol=1e-3 * share * float(gradient.abs().max())
        )


@pytest.mark.parametrize("device", DEVICES)
def test_a_term_from_outside_beside_the_others(device):
    """It begins along the run; the others are logged as before,
    and several steps and graphs are valid.
    """
    settings = demo(images=60, warm_up=0)
    state, observations = begun(settings, device)
    steps = Stepper(state, observations, settings, terms=(*TERMS, EXTRA))
    steps.step()
    assert steps.collect() == 0
    assert "brightness" not in state.sums
    assert "quads" in state.sums
    before = float(state.sums["loss"])
    while state.images < 16:
        steps.step()
    assert steps.collect() == 0
    assert state.skipped == 0
    terms = sum(float(state.sums[term.name]) for term in (*TERMS, EXTRA) if term.name in state.sums)
    assert float(state.sums["loss"]) == pytest.approx(terms, rel=1e-5)
    assert 0 < float(state.sums["brightness"]) < float(state.sums["loss"]) - before


@pytest.mark.parametrize("device", DEVICES)
def test_a_term_that_never_applies_changes_nothing(device):
    """Neither one of weight zero nor one of no image: not a bit on a CPU, and no sum."""

    def wrong(*_):
        raise AssertionError("it is not computed")

    absent = (
        replace(EXTRA, name="weightless", loss=wrong, weight=lambda *_: 0.0),
        replace(EXTRA, name="nowhere", loss=wrong, applies=lambda *_: False, weight=lambda *_: 1.0),
    )
    settings, states = demo(images=60, warm_up=4), []
    for terms in (TERMS, (*TERMS, *absent)):
        state, observations = begun(settings, device)
        steps = Stepper(state, observations, settings, terms=terms)
        while state.images < 12:
            steps.step()
        assert steps.collect() == 0
        states.append(state)
    one, other = states
    assert one.sums.keys() == other.sums.keys()
    if device != "cpu":
        alike(one, other)
        return
    for leaf, twin in zip(one.optimiser.leaves, other.optimiser.leaves, strict=True):
        assert torch.equal(leaf, twin)


# -- graphs, padding, validity ---------------------------------------------------------------------


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
def test_a_graph_is_the_same_work_as_eager_steps(batch, device):
    """The same kernels in the same order; what differs on a GPU is the order of atomic additions,
    see ``alike``.
    """
    states = []
    for graph in (False, True):
        settings = replace(published(batch=batch), graph=graph)
        state, observations = begun(settings, device)
        steps = Stepper(state, observations, settings)
        with observed() as (_, graphs):
            while state.images < 40:
                steps.step()
            assert steps.collect() == 0
        assert bool(graphs) == (graph and device != "cpu")
        states.append(state)
    alike(*states)


@pytest.mark.parametrize("make", SETTINGS, ids=["network", "nodes"])
def test_padding_rows_change_nothing(make, monkeypatch):
    """As on a GPU, but on a CPU: in ``published`` ten times as many rows as Gaussians,
    also after densification.
    """
    whole = stepper.PaddedParameters
    monkeypatch.setattr(stepper, "PaddedParameters", lambda *, pads: whole(pads=not pads))
    settings = replace(make(batch=Batch.QUARTET), graph=False)
    settings = replace(settings, weights=replace(settings.weights, motion_size=0.5))
    # where little moves, directions are rounding
    state = compared(settings, "cpu", images=((20, 0.01),), signs=0.01)
    mean = state.optimiser.tensors["mean"]
    assert mean.untyped_storage().nbytes() > mean.nbytes


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("make", SETTINGS, ids=["network", "nodes"])
def test_padding_rows_are_in_no_mean(make, device):
    """On a GPU there are ten times as many rows as Gaussians in ``published``,
    displaced like others.
    """
    settings = make(batch=Batch.QUARTET)
    settings = replace(settings, weights=replace(settings.weights, motion_size=0.5))
    plain, observations = begun(settings, device)
    state, _ = begun(settings, device)
    steps = Stepper(state, observations, settings)
    while plain.images < 20:
        assert plain_step(plain, observations, settings)
        steps.step()
    assert steps.collect() == 0
    assert plain.sums["motion_size"] > 0.01
    # no more: where little moves, the direction of its gradient is rounding
    for name, value in plain.sums.items():
        torch.testing.assert_close(state.sums[name], value, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_a_step_that_is_not_finite_is_counted_and_changes_nothing(device):
    """One quad of one frame is not a number: its steps change nothing, the others continue."""
    settings = published(batch=Batch.FRAME)
    state, observations = begun(settings, device)
    observations.quads[observations.batches[0][0]] = float("nan")
    steps = Stepper(state, observations, settings)
    for _ in observations.batches:
        before = [leaf.detach().clone() for leaf in state.optimiser.leaves]
        skipped = state.skipped
        steps.step()
        in_a_row = steps.collect()
        assert in_a_row == state.skipped - skipped
        if in_a_row:
            pairs = zip(before, state.optimiser.leaves, strict=True)
            assert all(old.shape != new.shape or torch.equal(old, new) for old, new in pairs)
    assert state.skipped == 1
    assert int(state.sums["count"]) == len(observations.batches) - 1
    assert all(leaf.isfinite().all() for leaf in state.optimiser.leaves)


def test_every_image_has_its_own_background(monkeypatch):
    """Four images per step, and the next step continues counting."""
    origins, whole = [], fused.uniform

    def watched(shape, origin, amplitude, **stream):
        origins.append(tuple(origin.tolist()))
        return whole(shape, origin, amplitude, **stream)

    monkeypatch.setattr(fused, "uniform", watched)
    settings = demo(images=48)
    state, observations = begun(settings)
    steps = Stepper(state, observations, settings)
    for _ in range(3):
        steps.step()
    assert origins == [(3, n) for n in range(12)]


def test_a_new_stage_releases_graphs():
    """Keys that alternate share a stage; one that begins to move does not."""
    image = {"images": (), "frozen": False, "sh_degree": 3}
    assert GraphKey(keys=2, **image).stage == GraphKey(keys=3, **image).stage
    assert GraphKey(keys=0, **image).stage != GraphKey(keys=2, **image).stage


# -- imports

SHORT_RUN = """
import sys
import torch
by_torch = {*sys.modules}  # whatever it imports itself
from small_runs import demo, small
from gftorf_warp.recon.train import reconstruct
settings = demo(images=12, warm_up=0, log_every=4)
reconstruct(small(), sys.argv[1], settings, device=sys.argv[2])
heavy = "torch._dynamo", "torch._inductor.compile_fx", "triton", "sympy", "jax"
print("imported:", *(name for name in heavy if name in sys.modules.keys() - by_torch))
"""


@pytest.mark.parametrize("device", DEVICES)
def test_a_run_does_not_import_the_compiler_of_torch(tmp_path, device):
    """It takes a second or three, and compiles nothing here; in a process of its own,
    since others may have it.
    """
    command = [sys.executable, "-c", SHORT_RUN, str(tmp_path / "run"), device]
    done = subprocess.run(
        command, cwd=__file__.rpartition("/")[0], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "imported:"


# -- tensor cores ----------------------------------------------------------------------------------


def of_full_size(**changes):
    """A short run with the published network, in half precision."""
    full, settings = MotionSettings(), published(**changes)
    sizes = {"layers": full.layers, "width": full.width, "skip_after": full.skip_after}
    frequencies = {
        "position_frequencies": full.position_frequencies,
        "time_frequencies": full.time_frequencies,
    }
    return replace(
        settings, motion=replace(settings.motion, products=Products.HALF, **sizes, **frequencies)
    )


@pytest.mark.parametrize("device", DEVICES)
def test_the_network_runs_on_tensor_cores_where_they_fit(device, monkeypatch):
    """On Hopper those of the published network; other sizes never, nor on a CPU;
    a network in float32 has none.
    """
    for settings, size in ((of_full_size(), True), (published(), False)):
        state, observations = begun(settings, device)
        if state.motion.settings.products != Products.HALF:
            assert state.motion.backend is None
            continue
        fitting = size and fits(Form.of(state.motion), observations.quads.device)
        assert isinstance(state.motion.backend.layers, FusedLayers) == fitting
    assert device != "cpu" or not fitting
    monkeypatch.setattr("gftorf_warp.render.network.fits", lambda *_: True)
    state, _ = begun(of_full_size(), device)
    assert isinstance(state.motion.backend.layers, FusedLayers), "it is what decides"


@pytest.mark.skipif(
    not torch.cuda.is_available() or torch.cuda.get_device_capability() != (9, 0),
    reason="needs CUDA with sm_90",
)
@pytest.mark.parametrize("batch", [Batch.FRAME, Batch.QUARTET])
def test_steps_learn_by_tensor_cores(batch):
    """In graphs: every step is valid, and every tensor of the network learns."""
    settings = of_full_size(batch=batch)
    state, observations = begun(settings, "cuda")
    before = [value.detach().clone() for value in state.motion.parameters()]
    steps = Stepper(state, observations, settings)
    assert isinstance(state.motion.backend.layers, FusedLayers)
    while state.images < 40:
        steps.step()
    assert steps.collect() == 0
    assert state.skipped == 0
    for old, new in zip(before, state.motion.parameters(), strict=True):
        assert new.isfinite().all()
        assert not torch.equal(old, new)
