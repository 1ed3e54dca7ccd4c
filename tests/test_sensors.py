"""Sensors by name, sensors that cannot be, and what a cycle is made of."""

import math
from dataclasses import fields, replace

import pytest
import torch

from gftorf_warp import cli
from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.scene.pattern import Pattern
from gftorf_warp.scene.sensor import EFFECTS, Sensor
from gftorf_warp.sim.readout import why_impossible
from gftorf_warp.sim.scene import overridden
from gftorf_warp.sim.scene_file import read_scene
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.sensors import SENSORS, effect_rows
from gftorf_warp.sim.simulate import simulate

BALL = (
    '[[bodies]]\nshape = { kind = "sphere", radius = 0.4 }\ntexture = { low = 0.2, high = '
    "0.8, cell = 0.1 }\n"
)
BALL += 'path = { kind = "still", position = [0, 0, 3] }\n'


def test_names_are_the_five_of_the_notes():
    """With the values that tell them apart; every one of them could exist."""
    assert set(SENSORS) == {"ftorf_synthetic", "ftorf_real", "torf_real", "opt8241_cdk", "mlx75027"}
    degrees = {
        name: [round(math.degrees(shift)) for shift in sensor.shifts]
        for name, sensor in SENSORS.items()
    }
    assert degrees["ftorf_synthetic"] == [0, 180, 90, 270]
    assert degrees["ftorf_real"] == [180, 90, 0, 270]
    synthetic, real = SENSORS["ftorf_synthetic"], SENSORS["ftorf_real"]
    assert (synthetic.unipolar, synthetic.dc_offset, synthetic.noise, synthetic.exposure_s) == (
        True,
        1.0,
        False,
        0.0,
    )
    assert (real.unipolar, real.dc_offset, real.noise) == (False, 0.0, True)
    assert synthetic.unambiguous_range == pytest.approx(7.5)
    assert SENSORS["torf_real"].unambiguous_range == pytest.approx(5.0)
    assert SENSORS["opt8241_cdk"].pattern.phase == 1.0
    for sensor in SENSORS.values():
        assert why_impossible(sensor) is None
        assert 1 / sensor.frame_period_s == pytest.approx(120.0)


def test_an_override_takes_a_name_and_then_single_settings(tmp_path):
    """In the order given; the card says both, and the sequence has the sensor's shifts."""
    scene = overridden(SCENES["demo"], ["sensor=opt8241_cdk", "sensor.f_mod_hz=20e6"])
    assert scene.sensor == replace(SENSORS["opt8241_cdk"], f_mod_hz=20e6)
    with pytest.raises(UsageError, match="did you mean mlx75027"):
        overridden(SCENES["demo"], ["sensor=mlx7502"])
    with pytest.raises(UsageError, match="ftorf_synthetic, ftorf_real"):
        overridden(SCENES["demo"], ["sensor=5"])
    with pytest.raises(UsageError, match="single setting"):
        overridden(SCENES["demo"], ["lens=opt8241_cdk"])
    path = simulate(
        "demo", tmp_path / "out", overrides=["sensor=mlx75027"], frames=4, size=(24, 18)
    )
    card = (path / "README.md").read_text()
    assert "--override sensor=mlx75027 --frames 4" in card
    assert "| fixed pattern | phase 0 times" in card
    assert "| cutoff of the contrast | 303 MHz" in card
    assert "| shifts in time order | 0, 90, 180, 270 deg |" in card


def test_a_scene_file_takes_a_name_too(tmp_path):
    """As a text, or as the preset of a table whose other keys change it."""
    path = tmp_path / "mine.toml"
    path.write_text('sensor = "mlx75027"\n' + BALL)
    assert read_scene(path).sensor == SENSORS["mlx75027"]
    path.write_text(
        'sensor = { preset = "opt8241_cdk", exposure_s = 1e-3, pattern = { phase = 0.5 } }\n' + BALL
    )
    want = replace(SENSORS["opt8241_cdk"], exposure_s=1e-3, pattern=Pattern(phase=0.5))
    assert read_scene(path).sensor == want
    path.write_text("lens = { cosine_power = 4, distortion = { k1 = -0.2 } }\n" + BALL)
    assert read_scene(path).lens.distortion.k1 == -0.2
    for text in (
        'sensor = "kinect"\n',
        'sensor = { preset = "kinect" }\n',
        "sensor = { preset = 5 }\n",
        "sensor = { preset = [] }\n",
    ):
        path.write_text(text + BALL)
        with pytest.raises(InputError, match=r"there is no sensor.*\n.*ftorf_synthetic"):
            read_scene(path)


IMPOSSIBLE = [  # setting, what a person types, a word of the message
    ("f_mod_hz", "0", "f_mod_hz must be above 0"),
    ("f_mod_hz", "-2e7", "f_mod_hz must be above 0"),
    ("f_mod_hz", "inf", "f_mod_hz must be finite"),
    ("f_mod_hz", "nan", "expected a number"),
    ("further_hz", "4e7,0", "further_hz must be above 0"),
    ("shifts", "nan,1,2,3", "expected a number"),
    ("shifts", "inf,1,2,3", "shifts must be finite"),
    ("shifts", "", "expected NAME=VALUE"),
    ("shifts", "0", "four shifts"),
    ("exposure_s", "-1e-3", "exposure_s must be above 0"),
    ("exposure_s", "0", "exposure_s must be above 0"),
    ("exposure_s", "inf", "exposure_s must be finite"),
    ("frame_period_s", "0", "frame_period_s must be above 0"),
    ("row_time_s", "-1e-5", "row_time_s must be 0 or more"),
    ("phase_offset", "inf", "phase_offset must be finite"),
    ("dc_offset", "-inf", "dc_offset must be finite"),
    ("dc_offset", "1.5", "negative light"),
    ("source_intensity", "-1", "source_intensity must be 0 or more"),
    ("unipolar", "true", "dc_offset >= 1 needed"),
    ("contrast", "1.2", "contrast must be in (0, 1]"),
    ("contrast", "0", "contrast must be in (0, 1]"),
    ("contrast_cutoff_hz", "0", "contrast_cutoff_hz must be above 0"),
    ("harmonic_contrast", "0.9,0.9,0.9", "more than all light"),
    ("electrons_per_unit", "0", "electrons_per_unit must be above 0"),
    ("electrons_per_code", "0", "electrons_per_code must be above 0"),
    ("ambient_electrons", "-1", "ambient_electrons must be 0 or more"),
    ("dark_electrons_per_s", "inf", "dark_electrons_per_s must be finite"),
    ("read_noise_electrons", "-80", "read_noise_electrons must be 0 or more"),
    ("full_well_electrons", "0", "full_well_electrons must be above 0"),
    ("adc_bits", "0", "adc_bits must be in 1..24"),
    ("adc_bits", "99", "adc_bits must be in 1..24"),
    ("pattern.gain", "-0.1", "gain must be a number of at least 0"),
    ("pattern.seed", "-1", "seed must be 0 or more"),
    ("further_hz", "4e7", "one modulation frequency"),
]


@pytest.mark.parametrize(("name", "value", "says"), IMPOSSIBLE, ids=lambda text: text[:24])
def test_impossible_sensors_end_in_one_message(name, value, says, tmp_path, capsys):
    """From the command line: exit code 2, what is wrong and where, no traceback,
    nothing written.
    """
    out = tmp_path / "out"
    assert (
        cli.main(["simulate", "demo", "--out", str(out), "--override", f"sensor.{name}={value}"])
        == 2
    )
    text = capsys.readouterr().err
    assert says in text
    assert f"sensor.{name}" in text or name in ("further_hz", "shifts", "dc_offset")
    assert text.count("why:") == 1
    assert "Traceback" not in text
    assert not out.exists()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number_of_a_sensor_may_be_none(value):
    """NaN and infinity are refused in every field; only a well may be endless."""
    numbers = [f.name for f in fields(Sensor) if isinstance(getattr(Sensor(), f.name), float)]
    assert len(numbers) > 12
    for name in (*numbers, "contrast_cutoff_hz"):
        if name == "full_well_electrons" and value == math.inf:
            assert Sensor(full_well_electrons=value).full_well_electrons == math.inf
            continue
        with pytest.raises(ValueError, match=name):
            Sensor(**{name: value})
    for name in ("shifts", "further_hz", "harmonic_contrast"):
        with pytest.raises(ValueError, match=name):
            Sensor(**{name: (0.1, value)})
    with pytest.raises(ValueError, match="at least one phase shift"):
        Sensor(shifts=())


def test_taps_that_would_hold_negative_light_are_named():
    """Contrast, DC offset and harmonics together; the limit itself is allowed."""
    assert why_impossible(Sensor(contrast=0.5, dc_offset=1.0)) is None
    assert "not 0.6 (1 + 1)" in why_impossible(Sensor(contrast=0.6, dc_offset=1.0))
    assert why_impossible(Sensor(unipolar=True, dc_offset=1.0)) is None
    one_tap = Sensor(unipolar=True, dc_offset=1.0, harmonic_contrast=(0.2,))
    assert "peak 1.2 with its harmonics" in why_impossible(one_tap)
    assert why_impossible(replace(one_tap, dc_offset=1.2)) is None


def test_an_endless_exposure_is_none_and_an_instant_has_no_noise():
    """0 s is the exposure of an ideal sensor; noise needs electrons."""
    assert Sensor(exposure_s=0.0).exposure_s == 0.0
    with pytest.raises(ValueError, match="0 without noise"):
        Sensor(exposure_s=0.0, noise=True)
    with pytest.raises(ValueError, match="1 / dc_offset at all frequencies"):
        Sensor(unipolar=True, dc_offset=1.0, contrast_cutoff_hz=3e8)


def test_a_cycle_has_all_shifts_at_every_frequency():
    """In time order; tensors go through, so that gradients reach the first frequency."""
    f = torch.tensor(20e6, dtype=torch.float64, requires_grad=True)
    sensor = Sensor(f_mod_hz=f, shifts=(0.0, 2.0, 4.0), further_hz=(30e6, 50e6))
    assert [frame.shift for frame in sensor.cycle] == [0.0, 2.0, 4.0] * 3
    assert [frame.f_mod_hz for frame in sensor.cycle[3:]] == [30e6] * 3 + [50e6] * 3
    assert sensor.at_frame(10).f_mod_hz is f
    assert (sensor.at_frame(14).f_mod_hz, sensor.at_frame(14).shifts) == (30e6, (4.0,))
    sensor.at_frame(0).phase_slope.backward()
    assert f.grad.item() == pytest.approx(4 * math.pi / SPEED_OF_LIGHT)


def test_what_is_off_leaves_no_trace():
    """Neither in the text that data cards hash nor on the card; whatever is on is in both."""
    assert not any(name in repr(Sensor()) for name in EFFECTS)
    assert effect_rows(Sensor(noise=True)) == {}
    on = {
        "further_hz": (3e7,),
        "harmonic_contrast": (0.0, 0.1),
        "contrast_cutoff_hz": 3e8,
        "pattern": Pattern(gain=0.1),
        "adc_zero": 14.083,
    }
    for name, value in on.items():
        sensor = Sensor(**{name: value})
        assert repr(sensor) == repr(Sensor())[
            :-1
        ] + f", {name}={value!r})" or f" {name}={value!r}," in repr(sensor)
        assert len(effect_rows(sensor)) == 1
    assert repr(Sensor()).startswith("Sensor(f_mod_hz=")
