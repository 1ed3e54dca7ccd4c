"""Scenes out of TOML files: the same as in Python, and every mistake named with its table and
key.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from gftorf_warp import Sequence, cli
from gftorf_warp.errors import InputError
from gftorf_warp.sim.assembly import Assembly, Level, Part
from gftorf_warp.sim.curves import Curve, Guided, Turn
from gftorf_warp.sim.paths import Line, Still, Sweep
from gftorf_warp.sim.scene import ColourCamera
from gftorf_warp.sim.scene_file import read_scene
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Box, Sphere, Texture

EXAMPLE = Path(__file__).parents[1] / "examples" / "scene.toml"
SHORT = """
[[bodies]]
shape = { kind = "sphere", radius = 0.4 }
texture = { low = 0.2, high = 0.8 }
path = { kind = "line", position = [0, 0, 3], velocity = [1, 0, -0.5] }
"""


def written(tmp_path, text, name="mine.toml"):
    """A file with this text."""
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_full_well_may_be_without_limit(tmp_path):
    """As by an override; other numbers are finite."""
    sensor = "sensor = {{ noise = true, {} = inf }}\n"
    scene = read_scene(written(tmp_path, sensor.format("full_well_electrons") + SHORT))
    assert scene.sensor.full_well_electrons == math.inf
    with pytest.raises(InputError, match="read_noise_electrons"):
        read_scene(written(tmp_path, sensor.format("read_noise_electrons") + SHORT))


def test_the_example_is_what_it_says():
    """Every body of the example as it would be written in Python."""
    scene = read_scene(EXAMPLE)
    assert (scene.name, scene.frames, scene.width, scene.height) == ("pendulum", 48, 160, 120)
    assert (scene.sensor.f_mod_hz, scene.sensor.noise, scene.camera_path) == (20e6, True, Still())
    parts = (
        Part(shape=Box(size=(0.4, 0.3, 0.02)), position=(0.0, -0.15, 0.0)),
        Part(shape=Sphere(radius=0.12), position=(0.0, 0.1, 0.0)),
    )
    swing = Turn(axis="z", angle=Curve(swing=25.0, swing_hz=0.9))
    assert scene.bodies == (
        Body(
            shape=Level(axis=2, value=3.6),
            texture=Texture(low=0.3, high=0.7, cell=0.3),
            path=Still(),
        ),
        Body(
            shape=Level(axis=1, value=1.0),
            texture=Texture(low=0.3, high=0.5, cell=0.3),
            path=Still(),
        ),
        Body(
            shape=Box(size=(0.2, 2.0, 0.2)),
            texture=Texture(low=0.5, high=0.5),
            path=Still(position=(0.8, 0.0, 2.8), turn_deg=(0.0, 30.0, 0.0)),
        ),
        Body(
            shape=Assembly(parts=parts),
            texture=Texture(low=0.4, high=0.9, cell=0.1),
            path=Guided(y=-0.9, z=2.2, turns=(swing,), arm=(0.0, 0.9, 0.0)),
        ),
    )


def test_what_is_left_out_has_its_default(tmp_path):
    """One body suffices; the name is the file's; colour,
    moving cameras and integers for lengths are understood.
    """
    scene = read_scene(written(tmp_path, SHORT))
    assert (scene.name, scene.frames, scene.colour) == ("mine", 48, None)
    assert scene.bodies[0].path == Line(position=(0.0, 0.0, 3.0), velocity=(1.0, 0.0, -0.5))
    more = """
    camera_path = { kind = "sweep", middle = [0, 0, 0], target = [0, 0, 3], sweep_deg = 8,\
 period_s = 2 }
    colour = { width = 40, height = 30, noise = 0 }
    novel_views = [{ kind = "viewpoint", position = [0.1, 0, 0], target = [0, 0, 3] }]
    """
    scene = read_scene(written(tmp_path, more + SHORT))
    assert scene.camera_path == Sweep(middle=(0, 0, 0), target=(0, 0, 3), sweep_deg=8, period_s=2)
    assert scene.colour == ColourCamera(width=40, height=30)
    assert len(scene.novel_views) == 1


def test_a_file_is_simulated_like_a_name(tmp_path, capsys):
    """From the command line and from Python, overrides included."""
    path, out = written(tmp_path, SHORT), tmp_path / "out"
    arguments = [
        "simulate",
        str(path),
        "--out",
        str(out),
        "--frames",
        "4",
        "--size",
        "24x18",
        "--override",
        "width=80",
    ]
    assert cli.main([*arguments, "--no-noise"]) == 0
    capsys.readouterr()
    other = simulate(str(path), tmp_path / "other", frames=4, size=(24, 18), noise=False)
    np.testing.assert_array_equal(Sequence.open(out).quads, Sequence.open(other).quads)
    assert Sequence.open(out).quads.max() > 0


@pytest.mark.parametrize(
    ("text", "where", "hint"),
    [
        ("", "bodies", "needs it"),
        ("bodies = []", "scene", "at least one body"),
        ("bodies = 5", "bodies", "expected a list"),
        ("bodies = [5]", "bodies[0]", "expected a table"),
        ("frames = 0" + SHORT, "scene", "frames must be at least 1"),
        ("frames = 4.5" + SHORT, "frames", "a whole number"),
        ("frames = true" + SHORT, "frames", "a whole number"),
        ("frame = 4" + SHORT, "frame", "did you mean frames?"),
        ("closed_form = 1.0" + SHORT, "closed_form", "leave it out"),
        ("sensor = { f_mod_hz = 0 }" + SHORT, "sensor", "f_mod_hz must be above 0"),
        ("sensor = { f_mod_hz = nan }" + SHORT, "sensor.f_mod_hz", "a finite number"),
        ("sensor = { exposure_s = -1 }" + SHORT, "sensor", "exposure_s must be above 0"),
        ("beam_deg = [60, 0]" + SHORT, "scene", "beam_deg must be between 0 and 180"),
        ("sensor = { noise = 1 }" + SHORT, "sensor.noise", "true or false"),
        (SHORT.replace("sphere", "sphre"), "bodies[0].shape.kind", "found 'sphre'"),
        (SHORT.replace('kind = "line", ', ""), "bodies[0].path.kind", "found None"),
        (
            SHORT.replace('kind = "sphere"', 'kind = ["sphere"]'),
            "bodies[0].shape.kind",
            "found ['sphere']",
        ),
        (SHORT.replace("0.4", "-0.4"), "bodies[0].shape", "above 0"),
        (SHORT.replace("0.4", '"big"'), "bodies[0].shape.radius", "found 'big'"),
        (
            SHORT.replace("[1, 0, -0.5]", "[1, 0]"),
            "bodies[0].path.velocity",
            "expected 3 values, found 2",
        ),
        (SHORT.replace("low = 0.2, ", ""), "bodies[0].texture.low", "needs it"),
        (
            SHORT.replace('"sphere", radius = 0.4', '"level", axis = 2, value = 3'),
            "bodies[0]",
            "cannot move",
        ),
        (
            SHORT.replace('"sphere", radius = 0.4', '"assembly", parts = []'),
            "bodies[0].shape",
            "at least one part",
        ),
        (
            'camera_path = { kind = "viewpoint", position = [0, 0, 0], target = [0, 1, 0] }'
            + SHORT,
            "camera",
            "straight",
        ),
        ("frames = = 4", "mine.toml", "line 1"),
    ],
)
def test_mistakes_are_named(tmp_path, text, where, hint):
    """File, table, key, what was expected; nothing is written."""
    with pytest.raises(InputError) as caught:
        simulate(str(written(tmp_path, text)), tmp_path / "out")
    assert where in caught.value.where
    assert "mine.toml" in caught.value.where
    assert hint in f"{caught.value.why} {caught.value.fix}"
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_not_there_is_named(tmp_path, capsys):
    """With the exit code of bad input, and no traceback."""
    assert cli.main(["simulate", str(tmp_path / "none.toml"), "--out", str(tmp_path / "out")]) == 3
    assert "none.toml" in capsys.readouterr().err
