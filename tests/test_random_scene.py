"""Scenes drawn from a number: the number decides everything, and every number gives a scene
within the unambiguous range, with a body that moves.
"""

import numpy as np
import pytest

from gftorf_warp import Sequence, cli
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.truth import moving_and_static
from gftorf_warp.errors import UsageError
from gftorf_warp.sim.assembly import Assembly
from gftorf_warp.sim.checks import CLEARANCE, check_clearance, check_format
from gftorf_warp.sim.random_scene import FRAMES, TIMES, WALLS, random_scene
from gftorf_warp.sim.record import record
from gftorf_warp.sim.settings import SimSettings
from gftorf_warp.sim.simulate import scene_of, simulate
from gftorf_warp.sim.world import Sphere, first_hit

NUMBERS = (*range(32), 159, 174)  # the last two draw their room again
SMALL = (32, 24)


def files_of(folder):
    """Content of all files by relative path."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def inside(shape, point):
    """Whether a point in the axes of a shape [m] is inside of it."""
    if isinstance(shape, Assembly):
        return any(inside(part.shape, point - part.position) for part in shape.parts)
    if isinstance(shape, Sphere):
        return np.linalg.norm(point) < shape.radius
    return bool((np.abs(point) < np.asarray(shape.size) / 2).all())


def corner(scene):
    """The farthest corner of the room, mirrored into x, y, z >= 0 [m]."""
    back, floor, ceiling, left, right = (
        np.abs(wall.path.position) - np.asarray(wall.shape.size) / 2
        for wall in scene.bodies[:WALLS]
    )
    return max(left[0], right[0]), max(floor[1], ceiling[1]), back[2]


def test_a_number_decides_every_byte(tmp_path):
    """Two recordings of one seed are equal; another seed is another scene."""
    settings = {"engine": "mesh", "size": SMALL, "frames": 4, "seed": 5}
    first = simulate("random", tmp_path / "a", **settings)
    random_scene.cache_clear()
    assert files_of(simulate("random", tmp_path / "b", **settings)) == files_of(first)
    assert files_of(simulate("random-5", tmp_path / "c", **settings)) == files_of(first)
    other = Sequence.open(simulate("random", tmp_path / "d", **settings | {"seed": 6}))
    assert np.abs(other.quads - Sequence.open(first).quads).max() > 1e-3
    assert "gftorf simulate random-5 --out SEQ" in (first / "README.md").read_text()


@pytest.mark.parametrize("number", NUMBERS)
def test_every_number_gives_a_scene_that_can_be_recorded(number):
    """Ranges of what is drawn; no body contains the camera or comes near, none leaves the room."""
    scene = random_scene(number)
    moving = [body for body in scene.bodies if body.moves]
    assert 1 <= len(moving) <= 4
    assert 0 <= len(scene.bodies) - WALLS - len(moving) <= 5
    assert scene.subsamples >= 2
    check_format(scene, SimSettings(engine="mesh"))
    check_clearance(scene, TIMES)
    for body in scene.bodies:
        assert 0.01 <= body.texture.low <= body.texture.high <= 1
        for time in TIMES[:: FRAMES // 4].tolist():
            pose = np.linalg.inv(body.path.world_from_body(time))
            assert not inside(body.shape, pose[:3, 3])
            centre = np.linalg.inv(pose)[:3, 3]
            assert not any(
                inside(wall.shape, centre - wall.path.position)
                for wall in scene.bodies[:WALLS]
                if wall is not body
            )
    for time in TIMES[[0, -1]].tolist():
        distance = first_hit(scene.bodies, scene.camera(SMALL), time).distance
        assert CLEARANCE < distance.min(), "NaN, where a ray leaves the room, fails too"
        assert distance.max() < scene.sensor.unambiguous_range
    assert np.linalg.norm(corner(scene)) < 0.975 * scene.sensor.unambiguous_range, "noise wraps"


def test_the_scenes_are_different_in_all_that_is_drawn():
    """Both frequencies, all orders of shifts, all shapes, textured and plain; noise and speeds over
    more than a decade.
    """
    scenes = [random_scene(number) for number in NUMBERS]
    ranges = [scene.sensor.unambiguous_range for scene in scenes]
    assert {round(length, 3) for length in ranges} == {2.5, 7.5}
    assert 0.1 < np.mean(np.less(ranges, 5.0)) < 0.45
    assert len({scene.sensor.shifts for scene in scenes}) == 3
    text = " ".join(f"{scene.motion} {scene.description}" for scene in scenes)
    shapes = "box", "ball", "pole", "panel", "stick", "frame"
    for word in (*shapes, "sliding", "axial", "circling", "swinging", "oscillating", "turning"):
        assert word in text
    plain = [body.texture.low == body.texture.high for scene in scenes for body in scene.bodies]
    assert 0.2 < np.mean(plain) < 0.6
    light = [
        scene.sensor.electrons_per_unit / scene.sensor.unambiguous_range**2 for scene in scenes
    ]
    assert max(light) / min(light) > 20
    assert len({scene.sensor.ambient_electrons for scene in scenes}) > 10
    ways = [
        np.linalg.norm(np.ptp([body.path.world_from_body(t)[:3, 3] for t in TIMES], axis=0))
        for scene in scenes
        for body in scene.bodies
        if body.moves and not hasattr(body.path, "spin_deg_per_s")
    ]
    assert max(ways) / min(ways) > 10


def test_noise_varies_by_a_decade_and_all_scenes_move():
    """Standard deviation of the closed form over quartets where nothing moves [m], and the share of
    pixels that move, of a few recordings.
    """
    spreads = []
    for number in (0, 4, 11, 20):
        scene = random_scene(number)
        recording = record(scene, engine="mesh", size=SMALL, frames=24, seed=number)
        assert recording.saturated == 0
        moving, static = moving_and_static(
            recording.truth.distance, list(range(24)), from_phasors=False, cycle=4
        )
        assert moving.any()
        decoded = [closed_form_distance(recording.sequence, quartet) for quartet in range(6)]
        spreads.append(np.median(np.std(decoded, axis=0)[static.all(axis=0)]))
    assert max(spreads) / min(spreads) > 10
    assert max(spreads) < 0.2


def test_names_of_random_scenes(capsys):
    """``random`` needs a seed, ``random-N`` has it; a misspelt name is an error that says so."""
    assert scene_of("random", seed=7) == scene_of("random-7") == random_scene(7)
    changed = scene_of("random", ["sensor.noise=false"], 7)
    assert not changed.sensor.noise
    with pytest.raises(UsageError, match="no scene named 'random-x'"):
        scene_of("random-x")
    with pytest.raises(ValueError, match="0 or more, got -1"):
        random_scene(-1)
    small = [f"--override={value}" for value in ("width=32", "height=24", "frames=8")]
    assert cli.main(["simulate", "random", "--seed", "7", "--list", *small]) == 0
    assert random_scene(7).motion in capsys.readouterr().out
