"""``gftorf check``: prints what is there and where it is from, and notices what is wrong."""

import dataclasses
import shutil

import numpy as np
import pytest
from ftorf_folder import REAL_ORDER, SAMPLE, fingerprint, scene

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data import decode, estimates, ftorf
from gftorf_warp.data.check import check
from gftorf_warp.data.sequence import Sequence
from gftorf_warp.errors import InputError

HEIGHT, WIDTH = 24, 32


def recording(frames=8, **changes):
    """A static scene large enough to estimate from, and its truth."""
    wall = np.linspace(1.5, 3.5, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    sequence, truth = scene(frames, HEIGHT, WIDTH, distance=wall)
    return dataclasses.replace(sequence, **changes), truth


def written(tmp_path, sequence, truth=None):
    """The report on a sequence that was written to disk."""
    return check(ftorf.write(tmp_path / "seq", sequence, truth))


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
        ("dc estimate", "-0.002"),
        ("order", "(q0,q1)(q2,q3) on 98%"),
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
    folder = ftorf.write(tmp_path / "seq", recording()[0])
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
    folder = ftorf.write(tmp_path / "seq", recording(16)[0])
    (folder / "tofType1/0005.npy").unlink()
    assert said(check(folder).lines, "tofType1/{id}.npy", "3 from 1 to 13", "4 (1x)", "8 (1x)")


def test_defaults_and_ignored_files_are_warned_of(tmp_path):
    """Frequency, warped copies, poses that do not count, amplitude posing as colour."""
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.arange(8)
    colour = {0: np.ones((HEIGHT, WIDTH, 3), np.float32)}
    folder = ftorf.write(tmp_path / "seq", recording(camera_from_world=poses, colour=colour)[0])
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
        ({"shifts": np.tile(np.pi * np.array([0, 0.5, 1, 1.5]), 2)}, ("quad order doubtful", "(q0,q2)(q1,q3)")),
        ({"forward_flow": {0: np.full((2, HEIGHT, WIDTH), 3.0)}}, ("forward flow does not explain",)),
    ],
)
def test_a_wrong_value_is_noticed(tmp_path, changes, words):
    """The recording is sound; what is said about it is not."""
    sequence, truth = recording()
    sequence = dataclasses.replace(sequence, **changes)
    if "shifts" in changes:  # the scene is in the real order, where the pairs are two steps apart
        order = np.argsort(REAL_ORDER)
        quads = sequence.quads.reshape(2, 4, HEIGHT, WIDTH)[:, np.argsort(order)].reshape(8, HEIGHT, WIDTH)
        sequence = dataclasses.replace(sequence, quads=quads)
    assert said(written(tmp_path, sequence, truth).warnings, *words)


def test_saturation_is_noticed(tmp_path):
    """Quads cut off at a value that many pixels share."""
    sequence, _ = recording()
    limit = float(np.quantile(np.abs(sequence.quads), 0.5))
    clipped = dataclasses.replace(sequence, quads=np.clip(sequence.quads, -limit, limit))
    assert said(written(tmp_path, clipped).warnings, "saturation", "8 raw frames")


def test_a_swapped_phase_disagrees_with_the_stored_phasor(tmp_path):
    """Order and sign that the pairing cannot see: sine and cosine swapped, or the phase mirrored."""
    sequence, _ = recording()
    folder = ftorf.write(tmp_path / "seq", sequence)
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
    assert not said(written(tmp_path / "true", sequence, truth).warnings, "no truth")
    for i in range(2):
        truth.distance[4 * i : 4 * i + 4] = decode.closed_form_distance(sequence, i)
    assert said(written(tmp_path, sequence, truth).warnings, "no truth")


def test_wrapped_and_unreadable_truth_are_warned_of(tmp_path):
    """Beyond c/2f, and not an array at all."""
    sequence, truth = scene(8, HEIGHT, WIDTH, distance=np.linspace(2.0, 9.0, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH))
    folder = ftorf.write(tmp_path / "seq", sequence, truth)
    warnings = check(folder).warnings
    assert said(warnings, "range wraps", "9 m", "7.5 m")
    assert not said(warnings, "truth implies")
    (folder / "synthetic_depth/0003.npy").write_text("text")
    assert said(check(folder).warnings, "synthetic_depth cannot be read", "0003.npy")


def test_estimates_of_a_noisy_recording_are_close():
    """Constant part, range and offset within noise, on the sample with a known change of each."""
    sequence = Sequence.open(SAMPLE)
    amplitude = np.repeat([np.hypot(*decode.quartet_phasor(sequence, i)) / 2 for i in range(8)], 4, axis=0)
    shifted = dataclasses.replace(sequence, quads=(sequence.quads + 0.5 * amplitude).astype(np.float32))
    assert estimates.dc_offset(shifted) - estimates.dc_offset(sequence) == pytest.approx(0.5, abs=0.02)
    rotated = dataclasses.replace(sequence, shifts=sequence.shifts + 1.0)
    before, after = (estimates.phase_fit(s, sequence.truth()) for s in (sequence, rotated))
    assert after.phase_offset - before.phase_offset == pytest.approx(1.0, abs=1e-3)
    assert after.depth_range == pytest.approx(15.0, rel=2e-3)
    assert before.rms_m < 0.02


def test_flow_of_the_sample_beats_its_mistakes():
    """Sign, channels and no flow at all are told from the right flow; without motion there is nothing to tell."""
    sequence = Sequence.open(SAMPLE)
    unwarped, warped, flipped, swapped = estimates.flow_match(sequence, sequence.forward_flow, 4)
    assert warped < 0.3 * min(unwarped, flipped, swapped)
    assert estimates.flow_match(sequence, {0: np.zeros((2, 120, 160), np.float32)}, 4) is None
    assert estimates.flow_match(sequence, {28: np.ones((2, 120, 160), np.float32)}, 4) is None
