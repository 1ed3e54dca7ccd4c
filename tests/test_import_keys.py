"""Keys that kinds of imports share: modulation, times, intrinsics."""

import numpy as np
import pytest

from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.importers import camera_keys, sensor_keys, timing
from gftorf_warp.importers.imported import Notes
from gftorf_warp.importers.keys import load

SENSOR = "f_mod_hz = 20e6\nshifts_deg = [0, 90, 180, 270]\n"


def given(tmp_path, keys, **tables):
    """Settings of a TOML file with these tables."""
    path = tmp_path / "keys.toml"
    path.write_text("".join(f"[{name}]\n{text}\n" for name, text in tables.items()))
    return load(path, keys)


def modulation(tmp_path, text):
    """The modulation of a table of this text."""
    return sensor_keys.modulation_of(given(tmp_path, sensor_keys.KEYS, sensor=text), Notes())


def times(tmp_path, text, frames=8, cycle=4, notes=None):
    """Times of a table of this text."""
    settings = given(tmp_path, timing.KEYS, time=text)
    return timing.times_of(settings, tmp_path, notes or Notes(), frames, cycle)


def test_a_cycle_of_two_frequencies(tmp_path):
    """Shifts in radians, a frequency for each, offsets, and the length of the cycle."""
    text = "f_mod_hz = [20e6, 20e6, 20e6, 60e6, 60e6, 60e6]\n"
    text += "shifts_deg = [0, 120, 240, 0, 120, 240]\nphase_offset_deg = 90\ndc_offset = 1\n"
    found = modulation(tmp_path, text)
    assert found.frequencies_hz.tolist() == [20e6] * 3 + [60e6] * 3
    np.testing.assert_allclose(found.shifts[4], 2 * np.pi / 3)
    assert found.calibration.cycle_length == 6
    assert found.calibration.phase_offset == pytest.approx(np.pi / 2)
    assert found.calibration.dc_offset == 1


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("f_mod_hz = 20\nshifts_deg = [0, 90, 180, 270]", "Hz: 20 MHz is 20e6"),
        ("f_mod_hz = 20e6\nshifts_deg = [0, 90]", "three or more"),
        ("f_mod_hz = 20e6\nshifts_deg = [0, 90, 90, 360]", "three or more"),
        ("f_mod_hz = [20e6, 60e6]\nshifts_deg = [0, 90, 180, 270]", "one for each of 4"),
        ("f_mod_hz = [20e6, 20e6, 60e6]\nshifts_deg = [0, 90, 180]", "at each frequency"),
        ("f_mod_hz = 20e6", "sensor.shifts_deg"),
    ],
)
def test_a_wrong_modulation_is_named(text, word, tmp_path):
    """Units, lengths, shifts that determine no phase, missing keys."""
    with pytest.raises(InputError) as error:
        modulation(tmp_path, text)
    assert word in str(error.value)


def test_times_by_rate_cycle_or_file(tmp_path):
    """Evenly, in bursts, of every raw frame, of every cycle; milliseconds, a heading."""
    np.testing.assert_allclose(times(tmp_path, "rate_hz = 10"), np.arange(8) / 10)
    burst = [0, 0.01, 0.02, 0.03, 0.5, 0.51, 0.52]
    text = "slot_period_s = 0.01\ncycle_rate_hz = 2"
    np.testing.assert_allclose(times(tmp_path, text, frames=7), burst)
    rows = "# made by hand\nt_ms;name\n" + "".join(f"{5 + 2 * n};x\n" for n in range(8))
    (tmp_path / "t.csv").write_text(rows)
    found = times(tmp_path, "file = 't.csv'\nunit = 'ms'")
    np.testing.assert_allclose(found, np.arange(8) * 0.002, atol=1e-15)
    (tmp_path / "t.csv").write_text("7\n7.5\n")
    found = times(tmp_path, "file = 't.csv'\nslot_period_s = 0.01", frames=7)
    np.testing.assert_allclose(found, burst)


def test_equal_times_are_uncertain(tmp_path):
    """One instant, or a counter of cycles in disguise."""
    (tmp_path / "t.csv").write_text("1\n1\n1\n2\n")
    notes = Notes()
    assert times(tmp_path, "file = 't.csv'", frames=4, notes=notes).tolist() == [0, 0, 0, 1]
    assert "equal times" in notes.uncertain[0]


@pytest.mark.parametrize(
    ("text", "rows", "word"),
    [
        ("rate_hz = 0", None, "above 0"),
        ("rate_hz = 3\nfile = 't.csv'", "1\n", "both state the times"),
        ("cycle_rate_hz = 3", None, "time.slot_period_s"),
        ("rate_hz = 30\nslot_period_s = 0.002", None, "time.cycle_rate_hz"),
        ("cycle_rate_hz = 3\nslot_period_s = 20", None, "longer than the shortest cycle"),
        ("file = 'none.csv'", "1\n", "none.csv"),
        ("file = 't.csv'", "1\n2\n", "time.slot_period_s"),
        ("file = 't.csv'", "1\n2\n3\n", "expected 8 times"),
        ("file = 't.csv'", "", "found none"),
        ("file = 't.csv'", "time\n", "found 0"),
        ("file = 't.csv'", "1\n2\n3\n4\n5\n4\n7\n8\n", "in line 6"),
        ("file = 't.csv'", "1\n2\nnan\n", "line 3"),
        ("file = 't.csv'", "1\n2\nx\n", "line 3"),
        ("unit = 'min'", None, "one of s, ms"),
    ],
)
def test_wrong_times_are_named(text, rows, word, tmp_path):
    """Rates, files, lengths, order."""
    if rows is not None:
        (tmp_path / "t.csv").write_text(rows)
    with pytest.raises(InputError) as error:
        times(tmp_path, text)
    assert word in str(error.value)


def test_intrinsics_state_the_pixel_centre(tmp_path):
    """Integer centres, OpenCV's, become half ones; a distortion has five numbers."""
    text = "fx = 20\nfy = 21\ncx = 7.5\ncy = 5.5\n"
    notes = Notes()
    for more, centre in (("", 8.0), ("pixel_centre = 'half'\n", 7.5)):
        settings = given(tmp_path, camera_keys.KEYS, camera=text + more)
        assert camera_keys.intrinsics_of(settings, notes, 16).cx == centre
    assert "+ 0.5" in notes.understood[0]
    assert "default" in notes.understood[0]
    settings = given(tmp_path, camera_keys.KEYS, camera=text + "distortion = [1, 2, 3, 4, 5]\n")
    assert camera_keys.intrinsics_of(settings, notes, 16).distortion == (1, 2, 3, 4, 5)
    with pytest.raises(InputError, match="pixels"):
        camera_keys.intrinsics_of(settings, notes, 640)
    with pytest.raises(UsageError, match=r"camera\.fx"):
        camera_keys.intrinsics_of(load(None, camera_keys.KEYS), notes, 16)
