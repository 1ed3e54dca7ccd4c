"""The additive zero of an ADC: stored in files, subtracted on reading, told from a DC offset."""

import dataclasses
import json

import numpy as np
import pytest
from ftorf_folder import scene
from sequences import changed

from gftorf_warp import Sequence
from gftorf_warp.data.check import check
from gftorf_warp.data.constant import constant_part
from gftorf_warp.data.decode import quartet_phasor
from gftorf_warp.data.write import write
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.sensor import quad_from_phasor
from gftorf_warp.sim.simulate import simulate

HEIGHT, WIDTH = 24, 32


def wall(**changes):
    """A noise-free slanted wall with texture, without a constant part."""
    distance = np.linspace(1.5, 3.5, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    return scene(8, HEIGHT, WIDTH, distance=distance, dc_offset=0.0, **changes)[0]


def pedestal(sequence, amplitudes):
    """The sequence as stored by an ADC whose zero is so many mean amplitudes, and that zero."""
    zero = amplitudes * float(np.hypot(*quartet_phasor(sequence, 0)).mean()) / 2
    return dataclasses.replace(sequence, quads=sequence.quads + np.float32(zero)), zero


def misfit(sequence):
    """Root mean square of what the sensor equation leaves of the quads, over the amplitude."""
    re, im = quartet_phasor(sequence, 0)
    amplitude = np.hypot(re, im)
    constant = sequence.calibration.dc_offset * amplitude
    model = [quad_from_phasor(re, im, constant, shift) for shift in sequence.shifts[:4]]
    return float(np.sqrt(np.square(model - sequence.quads[:4]).mean()) / (amplitude.mean() / 2))


def constant_warnings(folder):
    """What check says about the constant part."""
    return [f.text for f in check(folder).findings if f.name == "constant part"]


def test_a_zero_stated_as_a_dc_offset_is_told_apart(tmp_path):
    """The mean ratio 14.083 that check once suggested explains nothing, and is not accepted; the
    zero that it suggests now leaves the quads as if there were none.
    """
    ideal = wall()
    stored, zero = pedestal(ideal, 14.083)
    plain = write("ftorf", tmp_path / "plain", stored)
    (said,) = constant_warnings(plain)
    assert "cams/adc_zero.npy" in said
    assert float(said.partition("adc_zero.npy = ")[2].split()[0]) == pytest.approx(zero, rel=1e-4)

    as_dc = changed(stored, dc_offset=14.083)
    assert misfit(as_dc) > 5.0  # amplitudes: nothing can be fitted to such quads
    assert constant_warnings(write("ftorf", tmp_path / "dc", as_dc))

    np.save(plain / "cams/adc_zero.npy", np.float64(zero))
    mended = Sequence.open(plain)
    assert check(plain).findings == []
    assert mended.sources["adc_zero"] == "file cams/adc_zero.npy"
    assert misfit(mended) < 1e-4
    np.testing.assert_allclose(mended.quads, ideal.quads, atol=1e-6 * zero)


def test_a_dc_offset_is_told_from_a_zero(tmp_path):
    """The other hypothesis, in the other format."""
    folder = write("capture", tmp_path / "seq", changed(scene(8, HEIGHT, WIDTH)[0], dc_offset=0.0))
    (said,) = constant_warnings(folder)
    assert "sensor.dc_offset in capture.json = 0.2" in said


def test_equal_amplitudes_leave_both_open():
    """A zero and a multiple are the same where all amplitudes are."""
    ideal = wall()
    even = np.ones((HEIGHT, WIDTH)) * np.cos(1.0 - ideal.shifts[:, None, None]) + 0.5
    found = constant_part(dataclasses.replace(ideal, quads=even.astype(np.float32)))
    assert not found.is_explained
    assert found.is_zero is None
    text = found.advice(ideal, "ftorf")
    assert "adc_zero" in text
    assert "dc_offset.npy" in text


@pytest.mark.parametrize("form", ["ftorf", "capture"])
def test_codes_survive_a_round_bit_by_bit(tmp_path, form):
    """Whole codes with a pedestal: the file holds the codes, memory the codes without it."""
    codes = np.random.default_rng(0).integers(0, 4096, (8, HEIGHT, WIDTH))
    quads = (codes - 2048).astype(np.float32)
    measured = np.arange(8) != 5
    quads[5] = 0.0
    sequence = changed(wall(), quads=quads, adc_zero=2048.0, measured=measured)
    folder = write(form, tmp_path / "seq", sequence)
    got = Sequence.open(folder)
    assert got.calibration.adc_zero == 2048.0
    np.testing.assert_array_equal(got.quads, quads)
    if form == "ftorf":
        np.testing.assert_array_equal(np.load(folder / "tofType1/0001.npy"), codes[1])
    else:
        assert json.loads((folder / "capture.json").read_text())["sensor"]["adc_zero"] == 2048.0


def test_without_a_zero_nothing_is_written(tmp_path):
    """Old folders and new ones are the same, and read as zero."""
    folder = write("ftorf", tmp_path / "seq", wall())
    assert not (folder / "cams/adc_zero.npy").exists()
    assert Sequence.open(folder).sources["adc_zero"].startswith("default 0")
    capture = write("capture", tmp_path / "capture", wall())
    assert "adc_zero" not in json.loads((capture / "capture.json").read_text())["sensor"]


def test_a_zero_that_is_no_number_is_refused(tmp_path):
    """Nothing is half-written."""
    with pytest.raises(UsageError, match="calibration"):
        write("ftorf", tmp_path / "seq", changed(wall(), adc_zero=float("nan")))
    assert list(tmp_path.iterdir()) == []


def test_a_recording_with_a_zero_is_simulated(tmp_path):
    """It is in the files, on the card and in the settings, and not in the quads that are read."""
    small = {"frames": 4, "size": (16, 12), "format": "capture", "noise": False, "engine": "mesh"}
    without = Sequence.open(simulate("axial", tmp_path / "without", **small))
    folder = simulate("axial", tmp_path / "with", **small, overrides=("sensor.adc_zero=14.083",))
    got = Sequence.open(folder)
    assert got.calibration.adc_zero == 14.083
    assert "zero of the ADC" in (folder / "README.md").read_text()
    np.testing.assert_allclose(got.quads, without.quads, atol=1e-6)


def test_a_full_well_without_limit_is_stored(tmp_path):
    """Random scenes have one, and JSON has no number for it."""
    folder = simulate("random-0", tmp_path / "seq", frames=4, size=(8, 6), format="capture")
    assert Sequence.open(folder).calibration.settings["full_well_electrons"] == "inf"
