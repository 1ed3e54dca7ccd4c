"""Raw frames brought to one time by optical flow, and the preset that decodes them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from analytic_run import as_phasors
from moving_box import recording, seen, turned
from sequences import changed

from gftorf_warp import Sequence
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.flow import compute_flow
from gftorf_warp.data.synchronised import splatted, synchronised, unfilled_share
from gftorf_warp.data.truth import moving_and_static
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon.observations import data_hash
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.runs.closed_form import Flow2D
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.settings import SimSettings
from gftorf_warp.sim.simulate import simulate

FRAMES = 24


@pytest.fixture(scope="module")
def box():
    """A box that slides and comes nearer in front of a wall, with its truth."""
    return recording(frames=FRAMES)


def test_splatting_keeps_the_sum_and_shares_it_by_area():
    """A pixel moved by (0.25, 0.5) goes to four; what leaves the image is lost."""
    image = np.zeros((1, 5, 6))
    image[0, 2, 3] = 8.0
    moved = splatted(image, np.broadcast_to([[[0.25]], [[0.5]]], (2, 5, 6)))[0]
    assert moved.sum() == pytest.approx(8.0)
    np.testing.assert_allclose(moved[2:4, 3:5], [[3.0, 1.0], [3.0, 1.0]])
    away = splatted(np.ones((1, 5, 6)), np.broadcast_to([[[-2.0]], [[0.0]]], (2, 5, 6)))[0]
    np.testing.assert_array_equal(away, np.repeat([[1.0, 1.0, 1.0, 1.0, 0.0, 0.0]], 5, axis=0))


def test_flow_of_every_frame_agrees_with_that_of_quartet_starts(box):
    """The starts are some of all frames; each has the flow of its own time."""
    starts, every = compute_flow(box[0]), compute_flow(box[0], every=1)
    assert set(every.forward) == set(range(FRAMES - 4))
    assert set(every.backward) == set(range(4, FRAMES))
    for n, flow in starts.forward.items():
        np.testing.assert_array_equal(every.forward[n], flow)


def test_a_raw_frame_is_itself_at_its_own_time(box):
    """No flow is applied to the slot that was measured then, and the others are near the truth."""
    for n in (0, 6, FRAMES - 1):
        found = synchronised(box[0], float(box[0].times[n]))
        np.testing.assert_array_equal(found.sequence.quads[n % 4], box[0].quads[n])
        assert (found.sequence.times == box[0].times[n]).all()


def test_moving_pixels_are_better_than_in_the_closed_form(box):
    """At every raw frame: a third of the squared error where something moves, half over all.
    Beyond the first and last measurement of a slot its motion is continued.
    """
    sequence, truth = box
    frames = list(range(FRAMES))
    moving, _ = moving_and_static(truth.distance, frames, from_phasors=False, cycle=4)
    assert moving.mean() > 0.02
    naive = np.stack([closed_form_distance(sequence, n // 4) for n in frames]) - truth.distance
    ours = np.stack(
        [
            closed_form_distance(synchronised(sequence, float(sequence.times[n])).sequence, 0)
            for n in frames
        ]
    )
    ours -= truth.distance
    assert np.square(ours[moving]).mean() < 0.35 * np.square(naive[moving]).mean()
    assert np.square(ours).mean() < 0.5 * np.square(naive).mean()
    ends = np.isin(frames, (0, 1, FRAMES - 2, FRAMES - 1))
    at_ends = moving & ends[:, None, None]
    assert np.square(ours[at_ends]).mean() < 0.5 * np.square(naive[at_ends]).mean()


def test_what_is_hidden_is_not_filled(box):
    """A moving box hides and shows some of the wall; a recording at rest hides nothing."""
    share = unfilled_share(box[0])
    assert 0.0 < share < 0.05
    still = changed(box[0], quads=np.tile(box[0].quads[:4], (FRAMES // 4, 1, 1)))
    assert unfilled_share(still) == 0.0


def test_a_slot_that_was_measured_once_keeps_its_image(box):
    """Frame 5 alone of its slot: its image is shown at all times, and counts as not filled."""
    measured = box[0].measured.copy()
    measured[1::4] = False
    measured[5] = True
    found = synchronised(replace(box[0], measured=measured), 0.07)
    np.testing.assert_array_equal(found.sequence.quads[1], box[0].quads[5])
    assert not found.filled[1].any()
    assert found.filled[0].mean() > 0.9


def test_the_preset_is_a_run_without_gaussians(box, tmp_path):
    """It is opened like any other, renders at any time from its own camera, and is compared."""
    write("ftorf", tmp_path / "box", *box)
    run = reconstruct(tmp_path / "box", tmp_path / "run", "flow2d")
    assert isinstance(run, Flow2D)
    assert isinstance(Run.open(run.path), Flow2D)
    between = run.render(0.5 * float(run.sequence().times[6] + run.sequence().times[7]))
    assert between.distance.isfinite().all()
    with pytest.raises(UsageError, match="one view"):
        run.render(0.0, run.camera.at(turned(1.0)))
    got = compare(run)
    assert (got["method"], got["gaussians"], got["images_optimised"]) == ("flow2d", 0, 0)
    assert got["moving"]["d_mse_x100"] < 0.35 * got["moving"]["closed_form_mse_x100"]
    assert got["d_tof_mse_x100"] == pytest.approx(got["d_mse_x100"], rel=1e-3)
    config = json.loads((run.path / "config.json").read_text())
    assert config["unfilled_share"] == got["unfilled_share"] == unfilled_share(run.sequence())
    assert config["flow_source"] == "computed"
    assert "optical flow brought nothing to" in (run.path / "run.log").read_text()
    assert "optical flow brought to one time" in (run.path / "report.html").read_text()


def test_the_matcher_is_a_setting(box, tmp_path):
    """DeepFlow finds another flow; a source without flow of every frame is refused."""
    runs = [
        reconstruct(box[0], tmp_path / name, "flow2d", flow=name) for name in ("dis", "deepflow")
    ]
    assert runs[0].config["unfilled_share"] != runs[1].config["unfilled_share"]
    for name in ("file", "none"):
        with pytest.raises(UsageError, match="does not fit preset flow2d"):
            reconstruct(box[0], tmp_path / "refused", "flow2d", flow=name)
    assert not (tmp_path / "refused").exists()


THREE_FREQUENCIES = ("shifts=0,2.0944,4.1888", "f_mod_hz=80e6", "further_hz=16e6,120e6")


def test_several_frequencies_do_not_lose_what_rests():
    """Where slots see different surfaces their phases disagree, and would decode to a distance some
    metres away: such pixels are as in the closed form.
    """
    overrides = tuple(f"sensor.{one}" for one in THREE_FREQUENCIES)
    settings = SimSettings(format="capture", size=(48, 36), frames=36, overrides=overrides)
    made = record(SCENES["demo"], settings)
    sequence, frames = made.sequence, [*range(0, 36, 3)]
    assert (sequence.cycle, len(sequence.frequencies)) == (9, 3)
    truth = made.truth.distance[frames]
    moving, static = moving_and_static(made.truth.distance, frames, from_phasors=False, cycle=9)
    naive = np.stack([closed_form_distance(sequence, n // 9) for n in frames]) - truth
    times = [float(sequence.times[n]) for n in frames]
    ours = np.stack([closed_form_distance(synchronised(sequence, t).sequence, 0) for t in times])
    ours -= truth
    assert np.square(ours[moving]).mean() < 0.8 * np.square(naive[moving]).mean()
    assert np.square(ours[static]).mean() < 1.2 * np.square(naive[static]).mean()


def unfit(kind):
    """Recordings that have nothing to synchronise."""
    sequence, _ = recording(frames=8)
    measured = sequence.measured.copy()
    if kind == "phasors":
        return as_phasors(sequence)
    if kind == "one quartet":
        return recording(frames=4)[0]
    if kind == "incomplete":
        measured[[1, 6]] = False
        return replace(sequence, measured=measured)
    return replace(sequence, quads=sequence.quads[:, :8, :8])


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        ("phasors", "no raw frames"),
        ("one quartet", "no optical flow"),
        ("incomplete", "no complete quartet"),
        ("small", "too small for optical flow"),
    ],
)
def test_what_cannot_be_synchronised_is_refused(tmp_path, kind, what):
    """By name and with a way out, before anything is written."""
    with pytest.raises(InputError, match=what) as error:
        reconstruct(unfit(kind), tmp_path / "run", "flow2d")
    assert error.value.fix
    assert not (tmp_path / "run" / "config.json").exists()


def with_tap_sums(sequence):
    """The box with an image of all its light for every raw frame: reflectivity over d^2."""
    images = [seen(n) for n in range(sequence.frames)]
    return replace(
        sequence,
        tap_sums={n: (r / d**2).astype(np.float32) for n, (d, r, _) in enumerate(images)},
    )


TWO_TAPS = ("sensor.unipolar=false", "sensor.dc_offset=0")


def test_tap_sums_leave_less_unfilled_and_less_error():
    """Flow between neighbouring raw frames, where things are fast: less is hidden, paths may be
    curved.
    """
    scene, options = SCENES["speed_test_texture"], {"size": (64, 48), "frames": 12, "taps": True}
    made = record(scene, SimSettings(format="capture", overrides=TWO_TAPS, **options))
    sequence, distance = made.sequence, made.truth.distance
    without = replace(sequence, tap_sums={})
    assert unfilled_share(sequence) < 0.5 * unfilled_share(without)
    moving, _ = moving_and_static(distance, [*range(12)], from_phasors=False, cycle=4)

    def error(measured):
        frames = [synchronised(measured, float(t)).sequence for t in measured.times]
        found = np.stack([closed_form_distance(one, 0) for one in frames])
        return np.square(found - distance)[moving].mean()

    assert error(sequence) < 0.95 * error(without)


def test_a_single_quartet_with_tap_sums_is_enough():
    """Raw frames one cycle apart are not needed; a slot is what was measured at its own time."""
    sequence, _ = recording(frames=4)
    with pytest.raises(InputError, match="no optical flow"):
        synchronised(sequence, 0.0)
    found = synchronised(with_tap_sums(sequence), float(sequence.times[2]))
    np.testing.assert_array_equal(found.sequence.quads[2], sequence.quads[2])
    assert found.filled.mean() > 0.95
    assert not found.sequence.tap_sums


def test_tap_sums_are_a_sequence_of_a_capture(tmp_path):
    """Simulated, stored and read; their noise is that of the quads' taps, without phase."""
    options = {"size": (24, 18), "frames": 8, "format": "capture", "taps": True}
    path = simulate("sliding_cube", tmp_path / "seq", SimSettings(**options, overrides=TWO_TAPS))
    sequence = Sequence.open(path)
    sums = np.stack([sequence.tap_sums[n] for n in range(8)])
    assert (sums > np.abs(sequence.quads)).all()
    swing, phases = np.ptp(sums, axis=0), np.ptp(sequence.quads, axis=0)
    assert np.median(swing) < 0.01 * np.median(phases)
    write("capture", tmp_path / "again", sequence)
    for n, image in Sequence.open(tmp_path / "again").tap_sums.items():
        np.testing.assert_array_equal(image, sequence.tap_sums[n])
    assert "--taps" in (path / "README.md").read_text()
    run = reconstruct(path, tmp_path / "run", "flow2d")
    assert run.config["flow_source"] == "tap sums"
    assert data_hash(sequence) != data_hash(replace(sequence, tap_sums={}))


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"format": "ftorf"}, "cannot store the sum of taps"),
        ({"format": "capture"}, "there is no sum of taps"),
    ],
)
def test_tap_sums_that_cannot_be_are_refused(tmp_path, given, what):
    """Another layout; a sensor with one tap, as the scene has it."""
    with pytest.raises(UsageError, match=what):
        simulate("sliding_cube", tmp_path / "seq", SimSettings(taps=True, frames=4, **given))
    assert not (tmp_path / "seq").exists()
