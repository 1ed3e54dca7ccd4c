"""Single settings of a scene changed by name: what they reach, what the data card says,
what is refused.
"""

import numpy as np
import pytest

from gftorf_warp import Sequence
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.changes import changed, names
from gftorf_warp.sim.scene import OVERRIDES, overridden
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate

SMALL = {"frames": 4, "size": (24, 18)}


def test_sensor_camera_and_bodies_are_reached():
    """By dots, members of tuples by number; the rest stays,
    and the error of the closed form is no longer known.
    """
    scene = SCENES["sliding_cube"]
    texts = [
        "sensor.f_mod_hz=30e6",
        "frames=12",
        "bodies.2.path.velocity=5,0,-1",
        "bodies.2.shape.size=0.3,0.3,0.3",
    ]
    other = overridden(
        scene,
        [*texts, "bodies.0.texture.high=0.6", "sensor.shifts=3.14159265,0,1.57079633,4.71238898"],
    )
    assert other.sensor.f_mod_hz == 30e6
    assert other.frames == 12
    assert other.bodies[2].path.velocity == (5.0, 0.0, -1.0)
    assert other.bodies[2].shape.size == (0.3, 0.3, 0.3)
    assert other.bodies[0].texture.high == 0.6
    assert len(other.sensor.shifts) == 4
    assert other.bodies[1] == scene.bodies[1]
    assert (scene.closed_form, other.closed_form) == (0.105, None)
    assert overridden(scene, []) is scene
    chair = overridden(SCENES["speed_test_chair"], ["bodies.2.shape.parts.0.position=0,0.1,0"])
    assert chair.bodies[2].shape.parts[0].position == (0.0, 0.1, 0.0)
    camera = overridden(SCENES["cupboard"], ["camera_path.turns.0.angle.rate=9", "colour.noise=0"])
    assert camera.camera_path.turns[0].angle.rate == 9.0
    assert camera.colour.noise == 0.0


@pytest.mark.parametrize("name", ["demo", "jacks", "deskbox", "speed_test_chair"])
def test_every_setting_of_a_scene_has_a_name_and_can_be_set_to_what_it_is(name):
    """Whatever kind it has, as far as a text can say it."""
    scene = SCENES[name]
    found = [n for n in names(scene) if n not in OVERRIDES.fixed]
    assert len(found) > 40
    for setting in found:
        value = scene
        for part in setting.split("."):
            value = value[int(part)] if isinstance(value, tuple) else getattr(value, part)
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        if value != ():
            assert changed(scene, [f"{setting}={text}"], OVERRIDES) == scene, setting


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("sensor.f_mod=1", "did you mean sensor.f_mod_hz?"),
        ("sensor.f_mod_hz=0", "f_mod_hz must be above 0"),
        ("sensor.f_mod_hz=nan", "a number"),
        ("emitter=inf,0,0", "emitter must be finite"),
        ("beam_deg=60,180", "beam_deg must be between 0 and 180"),
        ("sensor.exposure_s=-1", "exposure_s must be above 0"),
        ("sensor.shifts=0", "four shifts"),
        ("frames=0", "frames must be at least 1"),
        ("horizontal_fov_deg=180", "between 0 and 180"),
        ("bodies.9.path.velocity=1,0,0", "no such setting"),
        ("bodies.2.shape.size=1,0,1", "lengths must be above 0"),
        ("bodies.2.texture.low=0.9", "low <= high"),
        ("bodies.2.path=5", "single setting"),
        ("colour=5", "a text cannot express"),
        ("name=other", "no such setting"),
        ("sensor", "NAME=VALUE"),
    ],
)
def test_what_cannot_be_meant_is_named_and_nothing_is_written(text, hint, tmp_path):
    """Before anything is rendered."""
    with pytest.raises(UsageError) as caught:
        simulate("sliding_cube", tmp_path / "out", overrides=[text], **SMALL)
    assert hint in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_the_data_card_says_how_to_make_it_again(tmp_path):
    """With the overrides in the command; another override is another sequence."""
    text = "sensor.f_mod_hz=30e6"
    path = simulate("sliding_cube", tmp_path / "out", overrides=[text], **SMALL)
    card = (path / "README.md").read_text()
    assert f"gftorf simulate sliding_cube --out SEQ --override {text} --frames 4" in card
    assert Sequence.open(path).calibration.f_mod_hz == pytest.approx(30e6)
    assert simulate("sliding_cube", path, overrides=[text], **SMALL) == path
    with pytest.raises(UsageError, match="not empty"):
        simulate("sliding_cube", path, **SMALL)
    plain = simulate("sliding_cube", tmp_path / "plain", **SMALL)
    assert "--override" not in (plain / "README.md").read_text()
    assert not np.array_equal(Sequence.open(plain).quads, Sequence.open(path).quads)


def test_an_infinite_number_is_refused_but_for_a_full_well(tmp_path):
    """No body is nowhere; a tap may hold any number of electrons."""
    for name in ("bodies.1.path.passing_s", "bodies.1.path.velocity"):
        values = "0,0,inf" if name.endswith("velocity") else "inf"
        with pytest.raises(UsageError, match=name):
            simulate("demo", tmp_path / "no", overrides=[f"{name}={values}"], **SMALL)
    simulate("demo", tmp_path / "yes", overrides=["sensor.full_well_electrons=inf"], **SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["yes"]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("camera_path.target=0,5,0", ("camera_path", "from [0.0, 0.0, 0.0] to [0.0, 5.0, 0.0]")),
        ("novel_views.2.target=0,5,0", ("novel_views.2", "straight up or down")),
        ("camera_path.period_s=0", ("period_s", "must not be 0")),
        ("colour.horizontal_fov_deg=190", ("horizontal_fov_deg", "between 0 and 180")),
        ("colour.width=0", ("width", "at least 1")),
    ],
)
def test_cameras_that_cannot_be_are_named(override, words, tmp_path):
    """Before anything is recorded."""
    overrides = ["camera_path.sweep_deg=0", "novel_views.2.position=0,0,0", override]
    with pytest.raises(UsageError) as error:
        simulate("tour", tmp_path / "no", overrides=overrides, **SMALL)
    assert all(word in str(error.value) for word in words)
    assert list(tmp_path.iterdir()) == []
