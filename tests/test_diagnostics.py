"""Diagnostics of an optimisation: rows worked out by hand, when they are due,
and no byte of the run changes.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording
from small_runs import advance, demo, same
from waits import WAITS, Operations, Reads

from gftorf_warp import Truth
from gftorf_warp.data.truth import moving_and_static, nearest
from gftorf_warp.recon import diagnostics
from gftorf_warp.recon.diagnostics import PAIRS, Diagnostics, diagnostic_frames, measured_static
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.state import begin, to_dict
from gftorf_warp.render.api import Rendering, rasterize
from gftorf_warp.render.buffers import Distortion
from gftorf_warp.scene.motion import Displacement, MotionSettings

SETTINGS = demo(images=64)
TRUTH = recording()[1]
DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]


@pytest.fixture(scope="module")
def observations():
    """Sixteen frames of a 48x36 recording."""
    return observe(recording()[0], SETTINGS, "cpu")


def at_start(observations, settings=SETTINGS):
    """A state before its first step."""
    return begin(observations, settings, seed=0, device="cpu")


def test_a_run_is_the_same_with_and_without_diagnostics(observations, tmp_path):
    """Generators, moments, sums and Gaussians after some steps, to the bit: with truth, without,
    and unobserved.
    """
    results = []
    for truth in (None, TRUTH, "none"):
        state = at_start(observations)
        diagnosed = Diagnostics(
            observations, None if truth == "none" else truth, tmp_path / f"{id(truth)}.jsonl"
        )
        for _ in range(4):
            before = to_dict(state)
            torch.manual_seed(1)
            chance = torch.get_rng_state()
            if truth != "none":
                diagnosed.add(state, SETTINGS)
            assert same(to_dict(state), before)
            assert torch.equal(torch.get_rng_state(), chance)
            assert all(leaf.grad is None for leaf in state.optimiser.leaves)
            advance(state, observations, SETTINGS)
        results.append(to_dict(state))
    assert same(results[0], results[2])
    assert same(results[1], results[2])


@pytest.mark.parametrize("device", DEVICES)
def test_a_row_reads_once_and_at_its_end(device, tmp_path):
    """What a GPU renders is not waited for before; if there were more pairs than fit,
    they are counted after all.
    """
    observations = observe(recording()[0], SETTINGS, device)
    state = begin(observations, SETTINGS, seed=0, device=device)
    diagnosed = Diagnostics(observations, TRUTH, tmp_path / "a")
    row = diagnosed.add(state, SETTINGS)
    with Operations() as operations, Reads() as reads:
        seen = diagnosed.render(state, SETTINGS)
    assert reads.found == 0
    assert not WAITS & set(operations.found)
    assert seen.counted == (device == "cpu")
    with Reads() as reads:
        assert diagnosed.write(seen, state, SETTINGS) == pytest.approx(row, rel=1e-5)
    assert reads.found == 1 + (device != "cpu")
    few = replace(
        seen,
        sums=dict.fromkeys(seen.sums),
        pairs=torch.full_like(seen.pairs, PAIRS + 1),
        counted=False,
    )
    assert diagnosed.write(few, state, SETTINGS) == pytest.approx(row, rel=1e-5)


def test_a_row_by_hand(observations, tmp_path):
    """Every number of a row, from the renderings of the four frames, pixel by pixel in numpy."""
    state = at_start(observations)
    advance(state, observations, SETTINGS, 3)
    with torch.no_grad():
        state.optimiser.field.opacity_logit.sub_(1.5)  # some light comes through
    path = tmp_path / "diagnostics.jsonl"
    row = Diagnostics(observations, TRUTH, path).add(state, SETTINGS)
    frames, field, sensor = [4, 8], state.optimiser.field, observations.sensor
    want, pixels = {}, {"": [], "moving.": [], "static.": []}
    moving, static = moving_and_static(TRUTH.distance, frames)
    for s, n in enumerate(frames):
        with torch.no_grad():
            delta = state.motion.at(state.binding, n / 120).offset
            seen = rasterize(
                field.moved(delta),
                observations.cameras[n],
                sensor,
                SETTINGS.render,
                extra=delta.norm(dim=1)[:, None],
            )
        d, q = seen.distance.numpy().astype(float), seen.quads.numpy().astype(float)
        d_tof = np.angle((q[0] - q[1]) + 1j * (q[2] - q[3])) % (2 * math.pi) * 15 / (4 * math.pi)
        table = {
            "d": (d - TRUTH.distance[n]) ** 2,
            "d_tof": (d_tof - TRUTH.distance[n]) ** 2,
            "left": 1.0 - seen.opacity.numpy(),
            "distortion": seen.distortion.numpy(),
            "offset": seen.extra[0].numpy() / seen.opacity.numpy(),
            "apart": np.abs(d - d_tof),
        }
        for name, mask in (
            ("", np.ones_like(moving[s])),
            ("moving.", moving[s]),
            ("static.", static[s]),
        ):
            pixels[name].append({key: image[mask] for key, image in table.items()})

    def mean(group, key):
        return np.concatenate([part[key] for part in pixels[group]]).mean()

    for group in pixels:
        want |= {f"{group}{name}_mse_x100": 100 * mean(group, name) for name in ("d", "d_tof")}
    want |= {"transmittance": mean("", "left"), "distortion": mean("", "distortion")}
    want |= {
        "offset_static_m": mean("static.", "offset"),
        "d_minus_dtof_static_m": mean("static.", "apart"),
    }
    assert row == {
        "images": 12,
        "gaussians": len(field),
        **{k: pytest.approx(v, rel=1e-3) for k, v in want.items()},
    }
    assert all(value > 0 for value in row.values()), "zeros would agree with anything"
    assert row["transmittance"] > 0.02
    assert row["moving.d_mse_x100"] > 2 * row["static.d_mse_x100"]
    assert [json.loads(line) for line in path.read_text().splitlines()] == [row]


def test_without_truth_the_errors_are_unknown_and_the_rest_is_there(observations, tmp_path):
    """Static pixels are then those that were measured to rest; where the camera moves,
    there are none.
    """
    state = at_start(observations)
    row = Diagnostics(observations, None, tmp_path / "a").add(state, SETTINGS)
    assert {name for name, value in row.items() if value is None} == {
        name for name in row if "mse" in name
    }
    static = measured_static(observations.sequence)
    box = np.any([image > 0.05 for image in np.abs(np.diff(TRUTH.distance, axis=0))], axis=0)
    assert 0.2 < static.mean() <= 0.5
    assert not (static & box).any()
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(16)
    assert measured_static(replace(observations.sequence, camera_from_world=poses)) is None
    moving = replace(observations, sequence=replace(observations.sequence, camera_from_world=poses))
    row = Diagnostics(moving, None, tmp_path / "b").add(state, SETTINGS)
    assert row["offset_static_m"] is row["d_minus_dtof_static_m"] is None
    assert row["transmittance"] > 0


def test_static_matter_that_was_pushed_is_seen(observations, tmp_path):
    """The composited displacement of static pixels; nothing moves during the warm-up."""
    diagnosed = Diagnostics(observations, TRUTH, tmp_path / "a")
    state = at_start(observations)
    calm = diagnosed.add(state, SETTINGS)["offset_static_m"]
    pushed = torch.full((len(state.binding), 3), 0.3 / math.sqrt(3.0))
    state.motion.at_times = lambda _, times: [Displacement(pushed, None)] * len(times)
    assert calm < 0.05
    assert diagnosed.add(state, SETTINGS)["offset_static_m"] == pytest.approx(0.3, rel=1e-4)
    schedule = replace(SETTINGS.schedule, warm_up=1)
    assert diagnosed.add(state, replace(SETTINGS, schedule=schedule))["offset_static_m"] == 0.0


def test_d_and_dtof_may_differ_by_a_whole_range(observations, tmp_path, monkeypatch):
    """Only what is left of a whole unambiguous range is a disagreement; errors do not wrap."""
    diagnosed = Diagnostics(observations, TRUTH, tmp_path / "a")
    state = at_start(observations)

    def far(*arguments, **options) -> Rendering:
        rendering = rasterize(*arguments, **options)
        return replace(
            rendering, distance=rendering.distance + observations.sensor.unambiguous_range
        )

    near = diagnosed.add(state, SETTINGS)
    monkeypatch.setattr(diagnostics, "rasterize", far)
    row = diagnosed.add(state, SETTINGS)
    assert row["d_minus_dtof_static_m"] == pytest.approx(near["d_minus_dtof_static_m"], rel=1e-3)
    assert row["d_mse_x100"] > 1000 > near["d_mse_x100"]


def test_distortion_is_in_square_metres_whatever_is_optimised(observations, tmp_path):
    """The released form is on another scale."""
    state, diagnosed = at_start(observations), Diagnostics(observations, TRUTH, tmp_path / "a")
    rows = [
        diagnosed.add(state, replace(SETTINGS, render=replace(SETTINGS.render, distortion=kind)))
        for kind in Distortion
    ]
    assert rows[0]["distortion"] == rows[1]["distortion"] > 0


def test_numbers_that_are_not_finite_are_unknown(observations, tmp_path, monkeypatch):
    """A diverging run is a matter of the training loop; diagnostics must not end it."""

    def broken(*arguments, **options) -> Rendering:
        rendering = rasterize(*arguments, **options)
        return replace(rendering, distance=rendering.distance * float("nan"))

    monkeypatch.setattr(diagnostics, "rasterize", broken)
    row = Diagnostics(observations, TRUTH, tmp_path / "a").add(at_start(observations), SETTINGS)
    assert row["d_mse_x100"] is row["static.d_mse_x100"] is row["d_minus_dtof_static_m"] is None
    assert row["d_tof_mse_x100"] > 0


@pytest.mark.parametrize("total", [8, 100, 4000, 60_000])
@pytest.mark.parametrize("batch", [1, 4])
def test_rows_are_few_dense_at_the_start_and_there_at_the_end(observations, tmp_path, total, batch):
    """By images only; a run that is cut anywhere has rows in the same places."""
    diagnosed = Diagnostics(observations, None, tmp_path / "a")
    places = [n for n in range(batch, total + 1, batch) if diagnosed.due(n - batch, n, total)]
    assert places[-1] == total
    assert diagnosed.due(-1, 0, total)
    assert len(places) == (40 if total >= 4000 else min(len(places), 40))
    if total >= 4000:
        assert sum(n <= total / 4 for n in places) == 20
        assert 0 < places[0] <= total / 1600 + batch


def test_rewinding_drops_later_rows(observations, tmp_path):
    """What was seen after the checkpoint is seen again."""
    state, diagnosed = (
        at_start(observations),
        Diagnostics(observations, TRUTH, tmp_path / "rows.jsonl"),
    )
    for images in (0, 8, 16):
        state.images = images
        diagnosed.add(state, SETTINGS)
    diagnosed.rewind(8)
    assert [
        json.loads(line)["images"] for line in (tmp_path / "rows.jsonl").read_text().splitlines()
    ] == [0, 8]


def test_the_frames_of_diagnostics():
    """Starts of inner quartets that the truth knows, at most four of them, spread."""
    sequence = recording(frames=15)[0]  # three quartets and a truncated one
    assert diagnostic_frames(sequence, None) == [4, 8]
    assert diagnostic_frames(recording(frames=8, with_flow=False)[0], None) == [0, 4]
    long = replace(sequence, measured=np.ones(120, dtype=bool))
    assert diagnostic_frames(long, None) == [4, 40, 76, 112]
    known = np.zeros(15, dtype=bool)
    known[[0, 8, 9]] = True
    assert diagnostic_frames(sequence, Truth(distance=TRUTH.distance[:15], known=known)) == [0, 8]


def test_truth_is_reduced_without_inventing_distances(tmp_path):
    """Half the size: every value is one of the four that it stands for;
    an error is measured against it.
    """
    image = np.arange(2 * 6 * 8, dtype=float).reshape(2, 6, 8)
    small = nearest(image, 3, 4)
    assert small.shape == (2, 3, 4)
    for y in range(3):
        for x in range(4):
            assert small[1, y, x] in image[1, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
    np.testing.assert_array_equal(nearest(image, 6, 8), image)
    settings = demo(images=64, width_max=24)
    half = observe(recording()[0], settings, "cpu")
    row = Diagnostics(half, TRUTH, tmp_path / "a").add(at_start(half, settings), settings)
    assert 0 < row["static.d_mse_x100"] < 10.0, "box and wall are 1.2 m apart"
    with pytest.raises(ValueError, match="15"):
        Diagnostics(
            half, Truth(distance=TRUTH.distance[:15], known=TRUTH.known[:15]), tmp_path / "a"
        )


def test_a_still_motion_has_rows_too(observations, tmp_path):
    """Nothing moves, so nothing was pushed."""
    settings = replace(SETTINGS, motion=MotionSettings(kind="still"))
    row = Diagnostics(observations, TRUTH, tmp_path / "a").add(
        at_start(observations, settings), settings
    )
    assert row["offset_static_m"] == 0.0
