"""The closed form behind the interface of a run: its own measurements, from its own camera,
without a checkpoint.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from moving_box import recording, with_colour

from gftorf_warp import Sequence
from gftorf_warp.data.decode import closed_form_distance, quartet_phasor
from gftorf_warp.data.temporal import nearest_quartet
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.evaluate.views import render_to_folder
from gftorf_warp.recon.closed_form import quads_of
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.runs.closed_form import ClosedForm
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.sensor import distance_from_phasor, phasor_from_quads

REAL_ORDER = (1, 2, 0, 3)  # the time order of real F-ToeRF files
ERRORS = ("d_mse_x100", "d_normalised_mse_x100", "d_tof_mse_x100")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The closed form of three quartets and two frames, with an offset,
    an offset phase and the order of real files.
    """
    folder = tmp_path_factory.mktemp("closed-form")
    sequence, truth = recording(frames=14, order=REAL_ORDER, phase_offset=0.5, dc_offset=0.2)
    write("ftorf", folder / "box", sequence, truth)
    return reconstruct(folder / "box", folder / "run", "ctof")


def test_it_is_a_run_without_gaussians_and_without_a_checkpoint(run):
    """Opened from its folder like any other."""
    assert isinstance(run, ClosedForm)
    assert isinstance(Run.open(run.path), ClosedForm)
    assert run.gaussians == 0
    assert not (run.path / "ckpt").exists()
    assert json.loads((run.path / "config.json").read_text())["settings"]["method"] == "ctof"


def test_during_a_quartet_it_shows_that_quartet(run):
    """Distance, phasor and quads in canonical order at each of its four frames;
    what it shows decodes to itself.
    """
    sequence = run.sequence()
    for n in range(12):
        rendering = run.render(float(sequence.times[n]), run.camera)
        want = closed_form_distance(sequence, n // 4)
        np.testing.assert_allclose(rendering.distance, want, rtol=1e-6)
        np.testing.assert_allclose(
            rendering.phasor[:2], quartet_phasor(sequence, n // 4), rtol=1e-5, atol=1e-7
        )
        canonical = [sequence.quads[4 * (n // 4) + REAL_ORDER.index(k)] for k in range(4)]
        np.testing.assert_array_equal(rendering.quads, np.stack(canonical))
        decoded = distance_from_phasor(
            *phasor_from_quads(rendering.quads, run.sensor.shifts), run.sensor
        )
        np.testing.assert_allclose(decoded, want, atol=1e-4)
        assert (rendering.opacity == 1).all()
        assert (rendering.distortion == 0).all()
        assert rendering.colour is None


def test_times_outside_go_to_the_nearest_complete_quartet(run):
    """Before the first, in a truncated one, and in one with a missing frame."""
    sequence = run.sequence()
    assert [nearest_quartet(sequence, t / 120) for t in (-5, 0, 3, 3.4, 3.6, 11, 13, 99)] == [
        0,
        0,
        0,
        0,
        1,
        2,
        2,
        2,
    ]
    measured = sequence.measured.copy()
    measured[6] = False
    holed = replace(sequence, measured=measured)
    assert [nearest_quartet(holed, t / 120) for t in (4, 5, 6, 7)] == [0, 0, 2, 2]


def test_a_shift_that_nobody_measured_is_computed(run):
    """The quads of a phasor at eighths of a turn lie between those of quarters,
    with the same constant part.
    """
    sequence = run.sequence()
    re, im = quartet_phasor(sequence, 1)
    between, zero = quads_of(sequence, 1, [np.pi / 4, 0.0])
    constant = 0.5 * 0.2 * np.hypot(re, im)
    np.testing.assert_allclose(between, (re + im) / np.sqrt(8) + constant, rtol=1e-6)
    np.testing.assert_allclose(zero, 0.5 * re + constant, rtol=1e-6)
    turned = quads_of(sequence, 1, [2 * np.pi, np.pi, np.pi / 2, -np.pi / 2])
    np.testing.assert_array_equal(turned[0], sequence.quads[4 + REAL_ORDER.index(0)])


def test_a_frequency_that_nobody_measured_is_refused(run):
    """By name, with those that were."""
    with pytest.raises(ValueError, match=r"f_mod_hz 10000000 must be one of .*, 19986163\.9"):
        run.render(0.0, f_mod_hz=10e6)


@pytest.mark.parametrize("change", ["pose", "size", "focal length", "lens"])
def test_another_view_is_refused(run, tmp_path, change):
    """A distance image has one place to look from."""
    pose = np.eye(4)
    pose[0, 3] = 0.01
    camera = {
        "pose": run.camera.at(pose),
        "size": run.camera.resized(24, 18),
        "focal length": replace(run.camera, fx=50.0),
        "lens": replace(run.camera, distortion=Distortion(k1=-0.2)),
    }[change]
    with pytest.raises(UsageError, match="one view"):
        run.render(0.0, camera)
    np.save(tmp_path / "poses.npy", pose[None])
    with pytest.raises(UsageError, match="one view"):
        render_to_folder(run, tmp_path / "out", poses=tmp_path / "poses.npy")
    assert not (tmp_path / "out").exists()


def test_a_moving_camera_is_its_own(run):
    """Every raw frame has its pose; that of another time is another view."""
    poses = np.tile(np.eye(4), (14, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(14)
    sequence = replace(run.sequence(), camera_from_world=poses)
    moving = replace(run)
    object.__setattr__(moving, "sequence", lambda: sequence)
    for n in range(14):
        moving.render(float(sequence.times[n]), run.camera.at(poses[n]))
    with pytest.raises(UsageError, match="one view"):
        moving.render(0.0, run.camera.at(poses[9]))


def test_compared_it_is_the_closed_form(run):
    """All columns agree; no Gaussians, no images, and a page that does not claim a
    reconstruction.
    """
    got = compare(run)
    assert got["method"] == "ctof"
    assert (got["gaussians"], got["images_optimised"], got["quad_psnr_db"]) == (0, 0, None)
    assert got["init"] is got["motion"] is got["diagnostics"] is got["colour_psnr_db"] is None
    for row in (got, got["moving"], got["static"]):
        for name in ERRORS:
            assert row[name] == pytest.approx(row["closed_form_mse_x100"], rel=1e-4, abs=1e-6), name
    assert got["moving"]["d_mse_x100"] > 10
    page = (run.path / "report.html").read_text()
    assert "This run is the closed form itself" in page
    assert "nothing was fitted" in page
    assert "--preset ctof" in page
    assert "Gaussians start" not in page


def test_what_cannot_be_shown_is_an_error(tmp_path):
    """A sequence that was never on disk, and one without a complete quartet."""
    run = reconstruct(recording(frames=8)[0], tmp_path / "memory", "ctof")
    with pytest.raises(InputError, match="not on disk"):
        run.render(0.0)
    measured = np.ones(8, dtype=bool)
    measured[[1, 6]] = False
    sequence = replace(run, config=run.config | {"sequence": "gone"})
    holed = recording(frames=8, measured=measured)[0]
    assert isinstance(holed, Sequence)
    object.__setattr__(sequence, "sequence", lambda: holed)
    with pytest.raises(InputError, match="no complete quartet"):
        sequence.render(0.0)


@pytest.mark.parametrize("form", ["torf", "ftorf"])
def test_a_recording_of_one_instant_has_a_closed_form(form, tmp_path):
    """A single phasor, or four quads that were taken at once."""
    sequence, truth = recording(frames=4)
    write(form, tmp_path / "one", replace(sequence, times=np.zeros(4)), truth)
    run = reconstruct(tmp_path / "one", tmp_path / "run", "ctof")
    expected = closed_form_distance(Sequence.open(tmp_path / "one"), 0)
    np.testing.assert_allclose(run.render(0.0).distance.numpy(), expected, rtol=1e-6)
    assert compare(run)["frames"] == (1 if form == "torf" else 4)


def test_a_recording_with_colour_is_compared(tmp_path):
    """A closed form has no colour and no other view, so nothing is asked of the colour camera."""
    path = write("capture", tmp_path / "seq", with_colour(recording(frames=8)[0], size=(12, 9)))
    run = reconstruct(path, tmp_path / "run", "ctof")
    assert compare(run)["method"] == "ctof"
    assert (run.path / "report.html").is_file()
