"""``gftorf check``: prints what is there and where it is from, and notices what is wrong."""

import dataclasses
import shutil

import numpy as np
import pytest
import torf_folder
from ftorf_folder import REAL_ORDER, SAMPLE, fingerprint, scene
from sequences import changed

from gftorf_warp import Sequence
from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data import decode, estimates
from gftorf_warp.data.check import check
from gftorf_warp.data.constant import constant_part
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError

HEIGHT, WIDTH = 24, 32


def recording(frames=8, **changes):
    """A static scene large enough to estimate from, and its truth."""
    wall = np.linspace(1.5, 3.5, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    sequence, truth = scene(frames, HEIGHT, WIDTH, distance=wall)
    return changed(sequence, **changes), truth


def written(tmp_path, sequence, truth=None):
    """The report on a sequence that was written to disk."""
    return check(write("ftorf", tmp_path / "seq", sequence, truth))


def said(lines, *words):
    """Whether one line has all the words."""
    return any(all(word in line for word in words) for line in lines)


def test_the_sample_is_fine_apart_from_what_it_does_not_state():
    """Two assumptions are warned of; the estimates agree with the description of the sample."""
    before = fingerprint(SAMPLE)
    report = check(SAMPLE)
    assert fingerprint(SAMPLE) == before
    assert len(report.warnings) == 2
    assert said(report.warnings, "120 Hz")
    assert said(report.warnings, "pixel centres", "half")
    for words in (
        ("raw frames", "32 of 32", "8 complete", "160x120"),
        ("shifts", "0, 180, 90, 270", "default"),
        ("f_mod_hz", "19.9862 MHz", "7.5 m", "file cams/depth_range.npy"),
        ("dc_offset", "default"),
        ("tofType1/{id}.npy", "8 from 1 to 29", "4 (7x)"),
        ("constant part", "of the amplitude", "dc_offset -0.00"),
        ("order", "0, 180, 90, 270 degrees as stated", "0% unexplained"),
        ("phasors", "synthetic_tof: correlation 0.999"),
        ("truth", "32 frames"),
        ("phase fit", "depth_range 14.998 m", "phase_offset -0.000"),
        ("forward flow", "unwarped"),
        ("backward flow", "warped"),
    ):
        assert said(report.lines, *words), words
    assert all(line in str(report) for line in report.lines + report.warnings)


def test_a_sound_recording_has_no_warnings(tmp_path):
    """Everything is stated by our writer, so nothing is assumed."""
    report = written(tmp_path, *recording())
    assert report.warnings == []
    assert "no warnings" in str(report)


def test_an_unreadable_sequence_is_an_input_error(tmp_path):
    """Check does not survive what the reader refuses."""
    folder = write("ftorf", tmp_path / "seq", recording()[0])
    (folder / "tofType0/0000.npy").write_text("text")
    with pytest.raises(InputError, match="0000"):
        check(folder)


def test_what_is_missing_is_listed(tmp_path):
    """Missing frames by number, a truncated quartet, and that nothing complete is left."""
    measured = np.ones(6, dtype=bool)
    measured[2] = False
    report = written(tmp_path, recording(6, measured=measured)[0])
    assert said(report.warnings, "1 raw frames were not measured: 2")
    assert said(report.warnings, "truncated after 2 frames")
    assert said(report.warnings, "no complete quartet")
    assert said(report.lines, "tofType2", "0 from") is False
    assert said(report.lines, "truth") is False


def test_gaps_in_the_ids_are_listed(tmp_path):
    """Ids of a folder: how many, from where to where, in which steps."""
    folder = write("ftorf", tmp_path / "seq", recording(16)[0])
    (folder / "tofType1/0005.npy").unlink()
    assert said(check(folder).lines, "tofType1/{id}.npy", "3 from 1 to 13", "4 (1x)", "8 (1x)")


def test_defaults_and_ignored_files_are_warned_of(tmp_path):
    """Frequency, warped copies, poses that do not count, amplitude posing as colour."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.arange(8)
    colour = {0: np.ones((HEIGHT, WIDTH, 3), np.float32)}
    folder = write("ftorf", tmp_path / "seq", recording(camera_from_world=poses, colour=colour)[0])
    (folder / "cams/poses.json").unlink()
    (folder / "cams/depth_range.npy").unlink()
    shutil.copy(folder / "tofType0/0000.npy", folder / "tofType1/0000.npy")
    warnings = check(folder).warnings
    assert said(warnings, "modulation frequency assumed")
    assert said(warnings, "poses", "cams/poses.json")
    assert said(warnings, "1 files of another slot")
    assert said(warnings, "amplitude, not colour")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 1000.0}, ("fx 1000", "view of", "millimetres")),
        ({"cx": -3.0}, ("principal point", "outside")),
        ({"dc_offset": 0.0}, ("dc_offset 0", "0.2")),
        ({"phase_offset": 0.0}, ("truth implies", "+0.3")),
        ({"f_mod_hz": SPEED_OF_LIGHT / 14.0}, ("truth implies depth_range 15 m",)),
        (
            {"shifts": np.tile(np.pi * np.array([0, 0.5, 1, 1.5]), 2)},
            ("quad order doubtful", "0, 90, 180, 270 degrees", "tof_permutation.npy"),
        ),
        (
            {"forward_flow": {0: np.full((2, HEIGHT, WIDTH), 3.0)}},
            ("forward flow does not explain",),
        ),
    ],
)
def test_a_wrong_value_is_noticed(tmp_path, changes, words):
    """The recording is sound; what is said about it is not."""
    sequence, truth = recording()
    sequence = changed(sequence, **changes)
    if "shifts" in changes:  # the scene is in the real order, where the pairs are two steps apart
        order = np.argsort(REAL_ORDER)
        quads = sequence.quads.reshape(2, 4, HEIGHT, WIDTH)[:, np.argsort(order)].reshape(
            8, HEIGHT, WIDTH
        )
        sequence = dataclasses.replace(sequence, quads=quads)
    assert said(written(tmp_path, sequence, truth).warnings, *words)


def test_saturation_is_noticed(tmp_path):
    """Quads cut off at a value that many pixels share."""
    sequence, _ = recording()
    limit = float(np.quantile(np.abs(sequence.quads), 0.5))
    clipped = dataclasses.replace(sequence, quads=np.clip(sequence.quads, -limit, limit))
    assert said(written(tmp_path, clipped).warnings, "saturation", "8 raw frames")


def test_a_swapped_phase_disagrees_with_the_stored_phasor(tmp_path):
    """Order and sign that the pairing cannot see: sine and cosine swapped,
    or the phase mirrored.
    """
    sequence, _ = recording()
    folder = write("ftorf", tmp_path / "seq", sequence)
    (folder / "synthetic_tof").mkdir()
    re, im = decode.quartet_phasor(sequence, 0)
    for stored, words in (
        ((3 * re, 3 * im), None),
        ((im, re), ("disagree",)),
        ((re, -im), ("disagree", "mirrored")),
        ((-re, -im), ("disagree",)),
        ((0 * re, 0 * im), ("disagree",)),
    ):
        np.save(folder / "synthetic_tof/0000.npy", np.stack([*stored, np.hypot(re, im)], axis=-1))
        report = check(folder)
        assert said(report.lines, "phasors", "synthetic_tof")
        assert said(report.warnings, *words) if words else not report.warnings
    assert said(report.lines, "0 times their length")


def test_a_decoded_distance_is_no_truth(tmp_path):
    """Real recordings store the distance of the quads where synthetic ones store truth."""
    sequence, truth = recording()
    noise = np.random.default_rng(0).normal(scale=0.01, size=sequence.quads.shape)
    sequence = dataclasses.replace(sequence, quads=(sequence.quads + noise).astype(np.float32))
    assert not said(written(tmp_path / "true", sequence, truth).warnings, "not ground truth")
    for i in range(2):
        truth.distance[4 * i : 4 * i + 4] = decode.closed_form_distance(sequence, i)
    assert said(written(tmp_path, sequence, truth).warnings, "not ground truth")


def test_wrapped_and_unreadable_truth_are_warned_of(tmp_path):
    """Beyond c/2f, and not an array at all."""
    sequence, truth = scene(
        8, HEIGHT, WIDTH, distance=np.linspace(2.0, 9.0, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    )
    folder = write("ftorf", tmp_path / "seq", sequence, truth)
    warnings = check(folder).warnings
    assert said(warnings, "range wraps", "9 m", "7.5 m")
    assert not said(warnings, "truth implies")
    (folder / "synthetic_depth/0003.npy").write_text("text")
    assert said(check(folder).warnings, "synthetic_depth cannot be read", "0003.npy")


def torf(tmp_path, count=3, **how):
    """A TöRF folder large enough to estimate from, with some noise, that states everything."""
    folder = torf_folder.build(
        tmp_path / "torf", count, height=HEIGHT, width=WIDTH, **{"noise": 2e-4} | how
    )
    np.save(folder / "cams/frame_times.npy", np.arange(count) / 30)
    (folder / "cams/pixel_centre.json").write_text('{"pixel_centre": "integer"}')
    return folder


def test_a_sound_phasor_folder_has_no_warnings(tmp_path):
    """Numbers, sources and fits of a moving camera with colour, and nothing written."""
    folder = torf(tmp_path, phase_offset=0.3)
    before = fingerprint(folder)
    report = check(folder)
    assert fingerprint(folder) == before
    assert report.warnings == []
    assert str(report).startswith(f"{folder}: ToeRF sequence")
    for words in (
        ("raw frames", "12 of 12", "3 complete", "3 of 3 phasors, ids from 0000"),
        ("times", "0.03333 to 0.03333 s apart", "file cams/frame_times.npy"),
        ("f_mod_hz", "29.9792 MHz", "5 m", "depth_range 10 m"),
        ("poses", "file cams/tof_extrinsics.npy"),
        ("colour", "file color, 3 images, 16x12 pixels"),
        ("colour camera", "file cams/color_intrinsics.npy", "file cams/relative_pose.npy"),
        ("ids tof/{id}.npy", "3 from 0 to 2"),
        ("third channel", "1 times", "correlation 1.0000"),
        ("baseline", "0.05099 m"),
        ("truth", "3 frames in distance"),
        ("phase fit", "static pixels"),
    ):
        assert said(report.lines, *words), words
    fit = next(line for line in report.lines if "phase fit" in line)
    fitted = [
        float(fit.partition(f"{name} ")[2].split()[0]) for name in ("depth_range", "phase_offset")
    ]
    assert fitted == pytest.approx([10.0, 0.3], rel=0.01)


def test_assumptions_of_a_phasor_folder_are_warned_of(tmp_path):
    """Ids from 1 with a gap, default range and rate, identity poses while the picture moves,
    inferred colour camera.
    """
    folder = torf(tmp_path, 4, first_id=1, speed=0.5)
    (folder / "tof/0002.npy").unlink()
    for path in (folder / "cams").iterdir():
        if path.name != "tof_intrinsics.npy":
            path.unlink()
    report = check(folder)
    assert said(report.warnings, "1 phasors were not measured: 1")
    assert said(report.warnings, "frame rate assumed: 30 Hz")
    assert said(report.warnings, "modulation frequency assumed")
    assert said(report.warnings, "poses: all are identity", "camera moved")
    assert said(report.warnings, "colour_intrinsics: inferred")
    assert said(report.warnings, "colour_from_world: inferred")
    assert said(report.lines, "ids tof/{id}.npy", "3 from 1 to 4", "1 (1x)", "2 (1x)")


def test_identity_poses_of_a_resting_camera_are_fine(tmp_path):
    """Nothing changes, so nothing speaks against them."""
    folder = torf(tmp_path, speed=0.0)
    assert not said(check(folder).warnings, "poses")


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        (
            "cams/phase_offset.npy",
            np.float64(1.0),
            ("truth implies", "phase_offset", "in use are 10 m and +1.000"),
        ),
        ("cams/depth_range.npy", np.float64(9.0), ("truth implies depth_range", "in use are 9 m")),
        (
            "cams/relative_pose.npy",
            np.diag([1.0, 1, 1, 1]) + 35.0 * np.eye(4, k=3),
            ("35 m away", "millimetres"),
        ),
        ("cams/color_extrinsics.npy", torf_folder.poses(3), ("colour_from_world", "replaces")),
        (
            "tof/0001.npy",
            np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)),
            ("third channel",),
        ),
    ],
)
def test_a_wrong_file_of_a_phasor_folder_is_noticed(tmp_path, name, array, words):
    """The recording is sound but for one file."""
    folder = torf(tmp_path)
    np.save(folder / name, array)
    assert said(check(folder).warnings, *words)


@pytest.mark.parametrize("form", ["torf", "ftorf"])
def test_z_depth_in_place_of_distance_is_noticed(tmp_path, form):
    """The phase tells which of the two fits, in either format."""
    matrix = torf_folder.intrinsics(HEIGHT, WIDTH)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    cosine = 1 / np.hypot(
        1, np.hypot((x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1])
    )
    folder = torf(tmp_path, truth="depth", speed=0.1)
    if form == "ftorf":
        sequence, truth = recording(fx=matrix[0, 0], fy=matrix[1, 1])
        folder = write("ftorf", tmp_path / "seq", sequence, truth)
    assert not said(check(folder).warnings, "z-depth")
    for path in folder.glob("*depth/*.npy"):
        np.save(path, np.load(path) * cosine)
    assert said(check(folder).warnings, "depth fits the phase better as z-depth")


def test_a_moving_camera_leaves_raw_quads_unfitted(tmp_path):
    """Their four instants saw different places; phasors have one instant."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(8)
    report = written(
        tmp_path, *[dataclasses.replace(recording()[0], camera_from_world=poses), recording()[1]]
    )
    assert said(report.lines, "phase fit", "camera moves")


def test_distances_that_are_the_decoded_phasors_are_doubtful(tmp_path):
    """Without noise that is what truth looks like; with noise it was decoded."""
    assert said(check(torf(tmp_path, noise=0.0)).warnings, "distance was decoded", "without noise")


def test_estimates_of_a_noisy_recording_are_close():
    """Constant part, range and offset within noise, on the sample with a known change of each."""
    sequence = Sequence.open(SAMPLE)
    amplitude = np.repeat(
        [np.hypot(*decode.quartet_phasor(sequence, i)) / 2 for i in range(8)], 4, axis=0
    )
    shifted = dataclasses.replace(
        sequence, quads=(sequence.quads + 0.5 * amplitude).astype(np.float32)
    )
    assert constant_part(shifted).dc_offset - constant_part(sequence).dc_offset == pytest.approx(
        0.5, abs=0.02
    )
    rotated = dataclasses.replace(sequence, shifts=sequence.shifts + 1.0)
    before, after = (estimates.phase_fit(s, sequence.truth()) for s in (sequence, rotated))
    assert after.phase_offset - before.phase_offset == pytest.approx(1.0, abs=1e-3)
    assert after.depth_range == pytest.approx(15.0, rel=2e-3)
    assert before.rms_m < 0.02


def test_flow_of_the_sample_beats_its_mistakes():
    """Sign, channels and no flow at all are told from the right flow;
    without motion there is nothing to tell.
    """
    sequence = Sequence.open(SAMPLE)
    unwarped, warped, flipped, swapped = estimates.flow_match(sequence, sequence.flow.forward, 4)
    assert warped < 0.3 * min(unwarped, flipped, swapped)
    assert estimates.flow_match(sequence, {0: np.zeros((2, 120, 160), np.float32)}, 4) is None
    assert estimates.flow_match(sequence, {28: np.ones((2, 120, 160), np.float32)}, 4) is None
