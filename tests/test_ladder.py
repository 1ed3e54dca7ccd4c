"""The ladder of levels: each adds what it says, and an error can be attributed to it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from gftorf_warp import Sequence, Truth
from gftorf_warp.cli import main
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.sim.closed_form_errors import closed_form_errors, ladder_table
from gftorf_warp.sim.ladder import LEVELS, NAMES, resolved
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.settings import SimSettings
from gftorf_warp.sim.simulate import simulate, simulate_ladder

SETTINGS = SimSettings(paths=9)
SMALL = {"size": (24, 18), "frames": 16}


def test_each_level_is_the_one_before_and_more():
    """Settings change where the level says so, and stay at all later ones but for what is the
    scene's own again.
    """
    demo = SCENES["demo"]
    at = {name: resolved(demo, replace(SETTINGS, level=name)) for name in NAMES}
    assert [level.name for level in LEVELS] == ["sync", "L0", "L1", "L2", "L3", "L4"]
    assert [at[name][1].sync for name in NAMES] == [True, False, False, False, False, False]
    assert [at[name][1].noise and at[name][0].sensor.noise for name in NAMES] == [
        False,
        False,
        True,
        True,
        True,
        True,
    ]
    assert [at[name][1].exposure_samples > 1 for name in NAMES] == [
        False,
        False,
        False,
        True,
        True,
        True,
    ]
    assert [any(at[name][0].emitter) for name in NAMES] == [False, False, False, True, True, True]
    assert [at[name][0].subsamples for name in NAMES] == [
        1,
        1,
        1,
        demo.subsamples,
        demo.subsamples,
        demo.subsamples,
    ]
    assert [at[name][1].bounces > 0 for name in NAMES] == [False, False, False, False, True, True]
    assert [at[name][0].beam_deg is not None for name in NAMES] == [
        False,
        False,
        False,
        False,
        True,
        True,
    ]
    assert [
        at[name][0].sensor.full_well_electrons == demo.sensor.full_well_electrons for name in NAMES
    ][-2:] == [
        False,
        True,
    ]
    assert [bool(at[name][0].sensor.harmonic_contrast) for name in NAMES][-2:] == [False, True]
    assert {at[name][1].engine for name in NAMES} == {"mesh"}
    assert resolved(demo, replace(SETTINGS, level="L2", sync=True))[1].sync, (
        "--sync counts at every level"
    )


def test_what_is_given_holds_at_every_level(tmp_path):
    """A level decides about what no option names, and the card says what was named."""
    options = ["--no-noise", "--exposure-samples", "3", "--bounces", "0"]
    words = ["simulate", "demo", "--level", "L4", "--size", "12x9", "--frames", "4"]
    assert main([*words, *options, "--out", str(tmp_path / "seq"), "-q"]) == 0
    card = (tmp_path / "seq" / "README.md").read_text()
    assert "noise | none" in card
    assert "mean of 3 instants" in card
    assert "direct light only" in card
    assert "--bounces 0 --paths 64 --exposure-samples 3 --seed 0 --level L4 --no-noise" in card
    demo = SCENES["demo"]
    engine = resolved(demo, SimSettings(level="L1", engine="gaussian"))[1].engine
    assert engine == "gaussian"
    assert resolved(demo, SimSettings(level="L3", paths=5))[1].paths == 5
    with pytest.raises(UsageError, match="--engine"):
        record(demo, SimSettings(level="L3", engine="gaussian", size=(8, 6), frames=4))


def test_what_a_scene_has_of_its_own_stays():
    """Its own place of the light, and a tap that cannot hold negative light."""
    own = replace(SCENES["demo"], emitter=(0.0, 0.1, 0.0), beam_deg=(50.0, 40.0))
    assert resolved(own, SimSettings(level="L4"))[0].emitter == (0.0, 0.1, 0.0)
    assert resolved(own, SimSettings(level="L4"))[0].beam_deg == (50.0, 40.0)
    assert not any(resolved(own, SimSettings(level="L1"))[0].emitter)
    unipolar = SCENES["sliding_cube"]
    assert unipolar.sensor.unipolar or float(unipolar.sensor.dc_offset) == 1.0


@pytest.mark.parametrize("name", ["demo", "sliding_cube", "pillow", "photocopier"])
def test_every_scene_can_be_recorded_at_the_last_level(name):
    """Differential or unipolar, still or carried: no level makes an impossible sensor."""
    scene, settings = resolved(SCENES[name], SimSettings(level="L4"))
    recording = record(scene, settings, paths=2, size=(16, 12), frames=4)
    assert np.isfinite(recording.sequence.quads).all()


def test_the_ladder_attributes_an_error(tmp_path, capsys):
    """Nothing is wrong at one instant; asynchrony, noise and bounces each cost what they must,
    where they must.
    """
    rows = simulate_ladder("demo", tmp_path / "ladder", SimSettings(**SMALL, paths=32))
    assert [*rows] == [*NAMES]
    assert rows["sync"].all < 1e-6
    assert rows["L0"].moving > 20
    assert rows["L0"].static < 1e-6
    assert rows["L0"].static_phasor == pytest.approx(rows["L0"].all, rel=1e-3)
    assert 0.05 < rows["L1"].static < 2
    assert rows["L3"].static > 5 * rows["L2"].static, "light that bounces changes nothing"
    assert rows["L3"].all - rows["L3"].static_phasor > 2, (
        "the static phasor knows the light that bounces"
    )
    assert rows["L4"].all != pytest.approx(rows["L3"].all, rel=0.05)
    text = (tmp_path / "ladder" / "ladder.md").read_text()
    for line in ladder_table(rows):
        assert line in text
    assert f"{rows['L3'].all - rows['L2'].all:.4g}" in text
    card = (tmp_path / "ladder" / "L2" / "README.md").read_text()
    assert "gftorf simulate demo --out SEQ --frames 16 --size 24x18 --seed 0 --level L2" in card
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "ladder").rglob("*.npy")}
    simulate("demo", tmp_path / "ladder" / "L2", **SMALL, level="L2")
    code = main(
        [
            "simulate",
            "demo",
            "--ladder",
            "--size",
            "24x18",
            "--frames",
            "16",
            "--paths",
            "32",
            "-q",
            "--out",
            str(tmp_path / "ladder"),
        ]
    )
    assert code == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == [*NAMES]
    assert before == {
        path: path.stat().st_mtime_ns for path in (tmp_path / "ladder").rglob("*.npy")
    }


def test_the_ladder_stores_all_truth(tmp_path):
    """All its levels have the engine that computes it."""
    words = "simulate demo --ladder --truth all --format capture --size 8x6 --frames 4 --paths 1"
    assert main([*words.split(), "-q", "--out", str(tmp_path / "ladder")]) == 0
    assert "normal" in Sequence.open(tmp_path / "ladder" / "L2").truth().layers


def test_wrong_levels_are_refused(tmp_path, capsys):
    """By name, before anything is made; a ladder has no level of its own,
    and too few frames have no error.
    """
    with pytest.raises(UsageError, match="--level") as caught:
        simulate("demo", tmp_path / "seq", **SMALL, level="L5")
    assert "sync, L0, L1, L2, L3, L4" in str(caught.value)
    arguments = ["simulate", "demo", "--out", str(tmp_path / "seq"), "--ladder", "--level", "L1"]
    assert main(arguments) == 2
    assert "one level or all" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
    recording = record(SCENES["demo"], size=(8, 6), frames=3)
    with pytest.raises(InputError, match="nothing to compare"):
        closed_form_errors(recording.sequence, recording.truth)


def test_errors_are_means_of_squares():
    """A decoded distance that is 10 cm long everywhere: 1 in square decimetres,
    against either truth.
    """
    recording = record(SCENES["demo"], size=(16, 12), frames=8, sync=True, noise=False)
    sequence, truth = recording.sequence, recording.truth
    shifted = Truth(
        distance=truth.phasor_distance - 0.1,
        known=truth.known,
        phasor_distance=truth.phasor_distance + 0.2,
    )
    errors = closed_form_errors(sequence, shifted)
    assert errors.all == pytest.approx(1.0, rel=1e-3)
    assert errors.static_phasor == pytest.approx(4.0, rel=1e-3)
    assert errors.static == pytest.approx(1.0, rel=1e-3)
    assert errors.moving is None or math.isclose(errors.moving, 1.0, rel_tol=1e-3)
    without = Truth(distance=truth.distance, known=truth.known)
    assert closed_form_errors(sequence, without).static_phasor is None
    assert isinstance(sequence, Sequence)


@pytest.mark.parametrize(
    ("level", "override", "word"),
    [("L1", "sensor=ftorf_synthetic", "exposure_s"), ("L4", "sensor.contrast=0.95", "contrast")],
)
def test_a_sensor_that_a_level_does_not_fit_is_named(level, override, word, tmp_path):
    """Noise in an exposure of no length; a wave of more than all light with its harmonics."""
    with pytest.raises(UsageError, match=word) as error:
        simulate("demo", tmp_path / "out", level=level, overrides=[override], frames=4)
    assert error.value.where == "--level"
    assert list(tmp_path.iterdir()) == []
