"""Known mistakes of reconstructions (method, section 10): starts, checkpoints, pruning, steps,
gaps, colour, scores.

Each test is named after the number of the mistake it would fail at; design/mistakes.md lists all of
them.
"""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import pose
from mistakes import dots, ramp, surface, wall
from sequences import changed
from small_runs import FLOW, OneStep, advance, demo, same, small

from gftorf_warp.constants import CANONICAL_SHIFTS, SH_Y0
from gftorf_warp.data.write import write
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.evaluate.metrics import scored_frames
from gftorf_warp.recon import checkpoint, densify, renderings
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.optimiser import Optimiser
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Batch, DensifySettings, FlowSource, Input, Weights
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render import reference
from gftorf_warp.render.api import rasterize
from gftorf_warp.scene.initialise import Init, InitSettings, from_random
from gftorf_warp.scene.measured import camera_of, sensor_of
from gftorf_warp.scene.motion import MotionSettings, Still

RANDOM = InitSettings(kind=Init.RANDOM, count=300, opacity=0.3, bounds=(0.5, 4.0))
NETWORK = MotionSettings(kind="network", width=16, layers=3, skip_after=1)


def started(settings, sequence=None):
    """Observations and the first state of a recording of a moving box, or of another one."""
    observations = observe(sequence or small(), settings, "cpu")
    return observations, begin(observations, settings, seed=0, device="cpu")


@pytest.mark.parametrize(("height", "width"), [(24, 32), (32, 24), (8, 64), (64, 8)])
def test_mistake_01_random_centres_fill_the_frustum_at_any_aspect_ratio(height, width):
    """All of them project into the image, evenly over its rows and columns,
    for a camera that is off its middle.
    """
    sequence = changed(wall(ramp(height, width)), fx=40.0, fy=30.0, cx=0.4 * width, cy=0.6 * height)
    field = from_random(
        sequence, replace(RANDOM, count=2000), torch.Generator().manual_seed(0)
    ).field
    x, y = camera_of(sequence, 0).project(field.mean).unbind(dim=1)
    inside = (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    assert inside.float().mean() > 0.99
    for place, size in ((x, width), (y, height)):
        shares = torch.histc(place / size, bins=4, min=0.0, max=1.0) / len(place)
        assert (shares - 0.25).abs().max() < 0.05
    z = field.mean[:, 2]
    assert 0.5 <= z.min() < z.max() <= 4.0


def test_mistake_01_random_centres_fill_what_any_pose_sees():
    """Two cameras side by side, turned: every centre is seen, and the overlap is no denser."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[4:] = pose((0, 1, 0), -0.5, (0.3, 0.0, 0.2)) @ poses[4:]
    sequence = replace(wall(ramp(24, 32)), camera_from_world=poses)

    def seen(of):
        mean = from_random(
            of, replace(RANDOM, count=4000), torch.Generator().manual_seed(0)
        ).field.mean
        for frame in (0, 7):
            x, y = camera_of(sequence, frame).project(mean).unbind(dim=1)
            z = mean @ torch.tensor(poses[frame, 2, :3]).float() + float(poses[frame, 2, 3])
            yield (z > 0.49) & (z < 4.01) & (x > -0.1) & (x < 32.1) & (y > -0.1) & (y < 24.1)

    first, second = seen(sequence)
    assert (first | second).all()
    _, shared = seen(wall(ramp(24, 32)))
    overlap = float(shared.float().mean())  # of the first frustum alone
    assert 0.2 < overlap < 0.8
    assert float((first & second).float().mean()) == pytest.approx(
        overlap / (2.0 - overlap), abs=0.03
    )
    assert float(first.float().mean()) == pytest.approx(1.0 / (2.0 - overlap), abs=0.03), (
        "equal frusta, equally full"
    )


def test_mistake_02_a_checkpoint_holds_the_network_and_its_moments(tmp_path):
    """What is loaded moves as before, and the next step is the same to the bit;
    without motion neither would be.
    """
    settings = demo(images=400, motion=NETWORK, init=RANDOM, batch=Batch.FRAME)
    observations, state = started(settings)
    advance(state, observations, settings, 12)
    again = from_dict(checkpoint.load(checkpoint.save(tmp_path, to_dict(state))), "cpu")
    assert same(to_dict(again), to_dict(state))
    weights = dict(state.motion.named_parameters())
    assert len(weights) >= 8
    for name, value in again.motion.named_parameters():
        assert torch.equal(value, weights[name]), name
        _, first, second = again.optimiser.moments_of(value)
        assert min(first.abs().max(), second.abs().max()) > 0, name
    moved = [s.motion.at(s.motion.bind(s.optimiser.field), 0.05).offset for s in (state, again)]
    assert moved[0].abs().max() > 1e-4
    assert torch.equal(*moved)
    for s in (state, again):
        advance(s, observations, settings)
    assert same(to_dict(again), to_dict(state))


def test_mistake_10_phasors_and_quads_of_one_light_have_one_fit():
    """The field that made the quads of a phasor camera fits them both ways:
    half a phasor is a quad, and no other.
    """
    sequence = wall(ramp(12, 16), phase_offset=0.0, dc_offset=0.0, quad_scale=1.0)
    camera, sensor = camera_of(sequence, 0), sensor_of(sequence)
    field = surface(camera, ramp(12, 16), reflectivity=0.8)
    re, im = rasterize(field, camera, sensor).phasor[:2].numpy()
    quads = np.tile(np.stack([re, -re, im, -im]) / 2, (2, 1, 1))
    sequence = replace(
        sequence,
        quads=quads.astype(np.float32),
        shifts=np.tile(CANONICAL_SHIFTS, 2),
        times=np.repeat([0.0, 0.1], 4),
        from_phasors=True,
    )
    still = Still(torch.tensor([0.0, 0.1]))
    for kind in (Input.PHASOR, Input.QUADS):
        settings = demo(input=kind, flow=FlowSource.NONE, weights=Weights(ssim=0.0), background=0.0)
        observations = observe(sequence, settings, "cpu")
        assert bool(observations.phasors) == (kind == Input.PHASOR)
        state = begin(observations, settings, seed=0, device="cpu")
        loss = []
        for more in (0.0, 1.0):
            brighter = replace(field, reflectivity_sh=field.reflectivity_sh + SH_OFFSET * more)
            bound = {
                "motion": still,
                "binding": still.bind(field),
                "statistics": densify.start(field),
            }
            given = replace(state, optimiser=Optimiser(brighter, still), **bound)
            loss.append(OneStep(given, observations, settings, 4).terms["quads"])
        assert loss[0] < 1e-10
        assert loss[1] > 1e4 * loss[0]


SH_OFFSET = torch.zeros(16)
SH_OFFSET[0] = 0.1 / SH_Y0  # a tenth more reflectivity, in every direction


def test_mistake_11_whatever_is_said_to_prune_does_so_in_a_round_that_also_adds():
    """No criterion looks at a record that cloning clears: faint,
    too large and too small ones go in the same round.
    """
    field = dots(
        np.random.default_rng(0).random((40, 3)) + np.array([0, 0, 2]), scale=0.05, opacity=0.5
    )
    field.opacity_logit[0], field.log_scale[1], field.log_scale[2] = (
        -9.0,
        math.log(3.0),
        math.log(1e-4),
    )
    settings = DensifySettings(every=100, gradient_min=1.0, scale_range=(1e-3, 0.5))
    seen = replace(densify.start(field), pixels=torch.ones(40))
    seen.gradient[10:14] = 2.0
    adam = Optimiser(field, Still(torch.tensor([0.0, 1.0])))
    done, _ = densify.densify(
        adam, seen, settings, torch.Generator().manual_seed(0), prunes_scale=True
    )
    assert done == {"cloned": 4, "split": 0, "pruned": 3}
    left = adam.field
    assert left.opacity.min() > 0.4
    assert left.scale.max() < 0.06
    assert left.scale.min() > 0.04


def test_mistake_11_nothing_claims_to_prune_by_size_on_the_screen():
    """A Gaussian that fills the image stays as long as its size in metres is allowed,
    and no setting says otherwise.
    """
    field = dots([[0.0, 0.0, 0.5], *([[0.0, 0.0, 2.0]] * 20)], scale=[0.4] + [0.05] * 20)
    adam = Optimiser(field, Still(torch.tensor([0.0, 1.0])))
    settings = DensifySettings(every=100, gradient_min=None, scale_range=(1e-3, 0.5))
    seen = replace(densify.start(field), pixels=torch.full((21,), 1e5))
    densify.densify(adam, seen, settings, torch.Generator().manual_seed(0), prunes_scale=True)
    assert len(adam.field) == 21
    names = {f.name for f in dataclasses.fields(DensifySettings)}
    assert not [
        name for name in names if "screen" in name or "radius" in name or "footprint" in name
    ]


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A recording of a moving box in a folder, and a few steps of a reconstruction that adds
    Gaussians.
    """
    root = tmp_path_factory.mktemp("box")
    folder = write("ftorf", root / "seq", small())
    grow = DensifySettings(every=8, start=4, stop_share=0.9, gradient_min=1e-6)
    return reconstruct(folder, root / "run", demo(images=20, densify=grow))


def test_mistake_13_a_finished_run_is_rendered_before_black(box):
    """It was trained before a random background; where nothing is hit there is nothing,
    and twice is the same.
    """
    assert box.config["settings"]["background"] > 0
    faint = replace(
        box, field=replace(box.field, opacity_logit=torch.full_like(box.field.opacity_logit, -9.0))
    )
    for name in ("quads", "phasor", "distance", "opacity"):
        assert getattr(faint.render(0.0), name).abs().max() == 0.0, name
        assert torch.equal(getattr(box.render(0.03), name), getattr(box.render(0.03), name))
    first, second = (compare(box, report=False) for _ in range(2))
    assert first == second


def test_mistake_13_the_published_frames_are_thirteen_of_sixty():
    """Quartet starts without the first and the last, and the protocol is named beside the
    numbers.
    """
    assert scored_frames(wall(ramp(2, 3), frames=60), "ftorf13") == list(range(4, 53, 4))


def test_mistake_13_a_comparison_names_its_frames(box):
    """How many, by which rule."""
    found = compare(box, frames="ftorf13", report=False)
    assert (found["frames"], found["protocol"]) == (1, "ftorf13")
    assert compare(box, report=False)["frames"] == 12


def reflectivity_steps(settings):
    """Change of the harmonics of the reflectivity [N, 16] in the first step,
    and the field before it.
    """
    observations, state = started(settings)
    before = state.optimiser.field.map(lambda value: value.detach().clone())
    advance(state, observations, settings)
    return state.optimiser.field.reflectivity_sh.detach() - before.reflectivity_sh, before


@pytest.mark.parametrize("factor", [1e-3, 30.0])
def test_mistake_14_scaling_the_loss_changes_no_step(factor):
    """Under Adam a rate is a step size: only the rate implements H1."""
    settings = demo(init=RANDOM, weights=Weights(quads=1.0), motion=MotionSettings(kind="still"))
    plain, _ = reflectivity_steps(settings)
    scaled, _ = reflectivity_steps(replace(settings, weights=Weights(quads=factor)))
    slower, _ = reflectivity_steps(
        replace(settings, rates=replace(settings.rates, reflectivity_sh=1e-3))
    )
    rate = settings.rates.reflectivity_sh
    moved = torch.minimum(plain.abs(), scaled.abs()) > 0.99 * rate
    assert moved.float().mean() > 0.3, (
        "all that is seen, but for gradients as small as Adam's epsilon"
    )
    torch.testing.assert_close(scaled[moved], plain[moved], rtol=1e-2, atol=0)
    torch.testing.assert_close(slower[moved], plain[moved] * (1e-3 / rate), rtol=1e-2, atol=0)


def test_mistake_14_all_harmonics_step_with_a_camera_at_rest():
    """Seen from one side they act as one number, whose step is 8 to 14 times that of the constant
    harmonic alone.
    """
    settings = demo(init=RANDOM, motion=MotionSettings(kind="still"))
    steps, field = reflectivity_steps(settings)
    seen = steps.abs().amin(dim=1) > 0.5 * settings.rates.reflectivity_sh
    assert seen.float().mean() > 0.3
    basis = reference.spherical_harmonics(torch.nn.functional.normalize(field.mean), 3)
    apparent = (basis * steps).sum(dim=1).abs()[seen] / (settings.rates.reflectivity_sh * SH_Y0)
    assert apparent.min() > 7.0
    assert apparent.max() < 15.0
    assert 9.0 < apparent.mean() < 14.0


def test_mistake_15_unknown_flow_and_untaken_frames_leave_a_run_finite(tmp_path):
    """NaN in one pixel of every flow, the loss of flow included;
    a frame that was not taken is dark, and no data.
    """
    sequence = small()
    for flow in (*sequence.flow.forward.values(), *sequence.flow.backward.values()):
        flow[:, 5, 7] = np.nan
    taken, quads = sequence.measured.copy(), sequence.quads.copy()
    taken[6], quads[6] = False, 0.0
    sequence = replace(sequence, quads=quads, measured=taken)
    run = reconstruct(sequence, tmp_path / "run", demo(images=12, weights=Weights(flow=1e-3)))
    assert run.config["skipped"] == 0
    assert all(
        value.isfinite().all()
        for value in (*run.field.parameters().values(), *run.motion.parameters())
    )


def test_mistake_15_one_unknown_pixel_is_left_out_of_the_flow_loss():
    """It weighs as zero, and the others as before."""
    settings = demo(weights=Weights(flow=1.0))
    sequence = small()
    observations, state = started(settings, sequence)
    whole = OneStep(state, observations, settings, 4, terms=(FLOW,)).terms["flow"]
    holed = observations.flow.images.clone()
    holed[:, :, 0, 18, 20] = torch.nan
    holed = replace(observations, flow=replace(observations.flow, images=holed))
    partly = OneStep(state, holed, settings, 4, terms=(FLOW,))
    assert 0 < partly.terms["flow"] < whole
    assert partly.terms["flow"] > 0.8 * whole
    assert partly.gradients["motion"].isfinite().all()


def test_mistake_16_renders_are_in_the_units_of_the_file(tmp_path):
    """The same recording in other units is fitted in the same way, and rendered in its own."""
    once = small()
    scaled = replace(once, quads=np.float32(8.0) * once.quads)
    a, b = (
        reconstruct(sequence, tmp_path / str(n), demo(images=4)).render(0.02)
        for n, sequence in enumerate((once, scaled))
    )
    assert a.quads.abs().max() > 0.01
    torch.testing.assert_close(b.quads, 8.0 * a.quads, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(b.phasor, 8.0 * a.phasor, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(b.distance, a.distance, rtol=1e-4, atol=1e-4)


def coloured():
    """The moving box with a colour image per quartet, from a camera of another size."""
    sequence = small()
    rng = np.random.default_rng(0)
    return changed(
        sequence,
        colour={4 * i: rng.random((18, 30, 3)).astype(np.float32) for i in range(3)},
        colour_intrinsics=(25.0, 25.0, 15.0, 9.0),
        colour_from_world=np.tile(pose((0, 1, 0), 0.05, (0.02, 0, 0)), (sequence.frames, 1, 1)),
    )


@pytest.mark.parametrize(("weight", "begins"), [(0.0, 0), (1.0, 8)])
def test_mistake_22_colour_is_rendered_only_while_it_counts(monkeypatch, weight, begins):
    """With weight 0, or before it begins, no rendering sees a colour and no image of it is
    uploaded.
    """
    settings = demo(images=24, weights=Weights(colour=weight), init=RANDOM)
    settings = replace(settings, schedule=replace(settings.schedule, colour_from=begins))
    seen = []

    def spy(field, camera, *args, **options):
        seen[-1].append((field.colour_sh is not None, camera.width))
        return rasterize(field, camera, *args, **options)

    monkeypatch.setattr(renderings, "rasterize", spy)
    observations, state = started(settings, coloured())
    assert bool(observations.colour) == (weight > 0)
    tof = observations.sequence
    assert (tof.width, tof.intrinsics.fx) == (48, 42.0), "ToF images keep their size"
    while state.images < 24:
        seen.append([])
        assert advance(state, observations, settings) == 0
    counts = [sum(colour for colour, _ in renderings) for renderings in seen]
    widths = {width for renderings in seen for colour, width in renderings if colour}
    assert counts == ([0] * 6 if weight == 0 else [0, 0, 1, 1, 1, 1])
    assert widths == ({30} if weight else set())


def test_mistake_23_a_comparison_says_images_and_gaussians_of_the_end(box):
    """Not those of the beginning, nor those that were asked for."""
    stored = checkpoint.last(box.path)
    found = compare(Run.open(box.path), report=False)
    settings = demo(densify=DensifySettings(every=8))
    at_first = len(started(settings)[1].optimiser.field)
    assert found["images_optimised"] == stored["images"] == 20
    assert found["gaussians"] == len(stored["field"]["mean"]) > at_first
