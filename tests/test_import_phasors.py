"""``gftorf import arrays`` of recordings of phasors: I and Q, or amplitude and phase."""

import numpy as np
import pytest
from foreign import keys, recording

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.decode import closed_form_distance, quartet_phasor
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.importers.command import read_recording

RATE = 30.0
TURN = 4096


def phasors():
    """[2, 12, 16] I and Q of the two quartets of a simulated recording, in whole codes."""
    codes = recording()[1][:8].astype(int).reshape(2, 4, 12, 16)
    return codes[:, 0] - codes[:, 1], codes[:, 2] - codes[:, 3]


def polar():
    """The same as amplitude and phase, whose codes are 4096 to a turn."""
    re, im = phasors()
    phase = np.rint(np.arctan2(im, re) * TURN / (2 * np.pi)).astype(int) % TURN
    return np.hypot(re, im), phase


def keys_of(taps, **changes):
    """Text of a TOML file without shifts."""
    usual = {"values__zero": 0, "sensor__taps": taps, "sensor__shifts_deg": None}
    return keys(**usual | {"time__rate_hz": RATE, "source__files": None} | changes)


def imported(tmp_path, taps, images, **changes):
    """The import of stacks of two images for each instant, in the order of their taps."""
    np.save(tmp_path / "a.npy", np.stack(images, axis=1))
    (tmp_path / "keys.toml").write_text(
        keys_of(taps, source__axes="frames taps rows columns", **changes)
    )
    return read_recording("arrays", tmp_path / "a.npy", tmp_path / "keys.toml")


def test_i_and_q_are_equal_to_the_bit(tmp_path):
    """In every order; four raw frames of each phasor at its time; the closed form is that of the
    quads.
    """
    re, im = phasors()
    cases = ((["I", "Q"], (re, im)), (["Q", "I"], (im, re)), (["-Q", "I"], (-im, re)))
    for taps, images in cases:
        found = imported(tmp_path, taps, images).sequence
        assert found.from_phasors
        assert (found.frames, found.cycle) == (8, 4)
        np.testing.assert_array_equal(found.quads[::4], re / 2)
        np.testing.assert_array_equal(found.quads[3::4], -im / 2)
        np.testing.assert_allclose(found.times * RATE, np.repeat([0, 1], 4))
        np.testing.assert_allclose(quartet_phasor(found, 1), [re[1], im[1]], atol=1e-9)


def test_the_closed_form_is_that_of_the_quads(tmp_path):
    """Of both forms of phasors."""
    original, codes = recording()
    quads = Sequence(
        quads=codes.astype(np.float32),
        **{name: getattr(original, name) for name in ("measured", "shifts", "times")},
        camera_from_world=original.camera_from_world,
        intrinsics=original.intrinsics,
        calibration=original.calibration,
    )
    for taps, images, changes, near in (
        (["I", "Q"], phasors(), {}, 1e-6),
        (["amplitude", "phase"], polar(), {"values__turn": TURN}, 2e-3),
        (["phase", "amplitude"], polar()[::-1], {"values__turn": float(TURN)}, 2e-3),
    ):
        found = imported(tmp_path, taps, images, **changes).sequence
        for quartet in range(2):
            expected = closed_form_distance(quads, quartet)
            got = closed_form_distance(found, quartet)
            away = np.abs((got - expected + 3.75) % 7.5 - 3.75)
            assert away.max() < near


def test_degrees_that_shrink(tmp_path):
    """A phase of the opposite sign in degrees, as a file for each."""
    amplitude, phase = polar()
    root = tmp_path / "files"
    for name, images in (("amplitude", amplitude), ("phase", -phase * (360 / TURN))):
        (root / name).mkdir(parents=True)
        for n, image in enumerate(images):
            np.save(root / name / f"{n}.npy", image)
    files = ["amplitude/*.npy", "phase/*.npy"]
    text = keys_of(["amplitude", "-phase"], source__files=files, values__turn=360)
    (tmp_path / "keys.toml").write_text(text)
    found = read_recording("arrays", root, tmp_path / "keys.toml").sequence
    re, im = phasors()
    step = 2 * np.pi / TURN * amplitude.max()
    np.testing.assert_allclose(found.quads[::4], re / 2, atol=step)
    np.testing.assert_allclose(found.quads[2::4], im / 2, atol=step)


def test_a_capture_of_phasors_is_written_and_fitted_as_phasors(tmp_path):
    """Poses and exposures of each phasor are those of its raw frames; `auto` compares phasors."""
    np.save(tmp_path / "a.npy", np.stack(phasors(), axis=1))
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[1, 0, 3] = 0.25
    np.save(tmp_path / "poses.npy", matrices)
    more = {"poses__file": "poses.npy", "poses__form": "matrices"}
    more |= {"poses__direction": "world_to_camera", "time__exposure_s": 0.01}
    axes = "frames taps rows columns"
    (tmp_path / "keys.toml").write_text(keys_of(["I", "Q"], source__axes=axes, **more))
    line = f"import arrays {tmp_path / 'a.npy'} --config {tmp_path / 'keys.toml'} --out "
    assert main(f"{line}{tmp_path / 'seq'}".split()) == 0
    found = Sequence.open(tmp_path / "seq")
    assert found.from_phasors
    np.testing.assert_array_equal(found.camera_from_world[:, 0, 3], np.repeat([0, 0.25], 4))
    assert found.exposures.tolist() == [0.01] * 8
    assert main(["check", str(tmp_path / "seq")]) == 0


def test_a_pixel_that_was_not_measured_takes_the_nearest_phasor(tmp_path):
    """Both of its images."""
    re, im = (image.astype(float) for image in phasors())
    im[0, 3, 4] = np.nan
    found = imported(tmp_path, ["I", "Q"], (re, im)).sequence
    assert found.quads[0, 3, 4] == re[1, 3, 4] / 2
    assert found.quads[2, 3, 4] == im[1, 3, 4] / 2


@pytest.mark.parametrize(
    ("taps", "changes", "word"),
    [
        (["I", "Q"], {"sensor__shifts_deg": [0, 90]}, "phasors have no shifts"),
        (["I", "Q"], {"sensor__f_mod_hz": [20e6, 50e6]}, "has one frequency"),
        (["I", "Q"], {"sensor__dc_offset": 1.0}, "no constant part"),
        (["amplitude", "phase"], {}, "values.turn"),
        (["amplitude", "phase"], {"values__turn": 0}, "above 0"),
        (["amplitude", "phase"], {"values__turn": "rad"}, "a number"),
        (["I", "phase"], {}, "sensor.taps"),
        (["I"], {}, "sensor.taps"),
        (["I", "I"], {}, "sensor.taps"),
        (["amplitude", "Q"], {}, "sensor.taps"),
        (["-I", "Q"], {}, "one of A-B, A"),
        (["I", "Q"], {"time__rate_hz": None}, "time.rate_hz"),
        (["I", "Q"], {"source__axes": "frames slots rows columns"}, "1 slots"),
        (["I", "Q"], {"source__axes": "taps frames rows rows"}, "a name for each axis"),
    ],
)
def test_what_does_not_fit_is_a_named_error(taps, changes, word, tmp_path):
    """Keys of quads, missing and impossible ones."""
    np.save(tmp_path / "a.npy", np.stack(phasors(), axis=1))
    usual = {"source__axes": "frames taps rows columns"}
    (tmp_path / "keys.toml").write_text(keys_of(taps, **usual | changes))
    with pytest.raises((InputError, UsageError)) as error:
        read_recording("arrays", tmp_path / "a.npy", tmp_path / "keys.toml")
    assert word in str(error.value)


def test_an_odd_image_is_named(tmp_path):
    """I without its Q."""
    np.save(tmp_path / "a.npy", np.stack(phasors(), axis=1).reshape(4, 12, 16)[:3])
    (tmp_path / "keys.toml").write_text(keys_of(["I", "Q"]))
    with pytest.raises(InputError, match="end within a raw frame of 2 taps"):
        read_recording("arrays", tmp_path / "a.npy", tmp_path / "keys.toml")
