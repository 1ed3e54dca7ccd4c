"""A rolling shutter: every row of an image is that of a global one taken when the row is
exposed.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.sim.ladder import NAMES, resolved
from gftorf_warp.sim.mesh_engine import MeshEngine
from gftorf_warp.sim.record import record
from gftorf_warp.sim.rolling import rolling_hits, row_delays
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.settings import SimSettings
from gftorf_warp.sim.world import first_hit

SIZE = (32, 24)
ROW_TIME = 1e-3  # [s] slow, so that the box moves pixels from the first row to the last


def scene(name="sliding", row_time=ROW_TIME):
    """A box that moves sideways, before a sensor whose rows follow each other."""
    whole = SCENES[name]
    return replace(whole, sensor=replace(whole.sensor, row_time_s=row_time, noise=False))


@pytest.mark.parametrize("distortion", [Distortion(), Distortion(k1=-0.15, p1=0.01)])
def test_a_row_is_seen_as_in_the_whole_image(distortion):
    """The same rays, whatever the lens."""
    camera = replace(Camera.from_fov(*SIZE, 60.0), distortion=distortion, cy=11.3)
    rays = camera.rays(dtype=torch.float64)
    for row in (0, 7, 23):
        torch.testing.assert_close(
            camera.row(row).rays(dtype=torch.float64)[0], rays[row], rtol=0, atol=1e-9
        )


@pytest.mark.parametrize("bounces", [0, 1])
def test_each_row_has_its_own_time(bounces):
    """Light, amplitude, and truth of row n are those of a global shutter at that moment;
    no two rows share paths.
    """
    options = {"frames": 2, "size": SIZE, "engine": "mesh", "bounces": bounces, "paths": 64}
    found = record(scene(), **options)
    times, delays = found.sequence.times, row_delays(scene().sensor, SIZE[1])
    camera_at = partial(scene().camera, SIZE)
    traced = MeshEngine(scene(row_time=0.0), camera_at)
    for n in range(2):
        for row in (0, 9, 23):
            time = float(times[n] + delays[row])
            hits = first_hit(scene().bodies, camera_at(time), time)
            np.testing.assert_allclose(found.truth.distance[n, row], hits.distance[row], rtol=1e-6)
            np.testing.assert_array_equal(found.truth.body[n, row], hits.body[row])
            direct = traced.light([time], float(scene().sensor.f_mod_hz)).amplitude[row]
            if bounces:
                assert (found.truth.amplitude[n, row] >= 0.999 * direct).all()
                assert found.truth.amplitude[n, row].sum() > 1.01 * direct.sum()
            else:
                np.testing.assert_allclose(
                    found.truth.amplitude[n, row], direct, rtol=1e-4, atol=1e-6
                )


def test_a_still_scene_looks_as_ever():
    """Nothing moves, so it does not matter when a row is taken."""
    still = replace(scene(), bodies=tuple(body for body in scene().bodies if not body.moves))
    rolling = record(still, frames=1, size=SIZE, engine="mesh")
    whole = record(
        replace(still, sensor=scene(row_time=0.0).sensor), frames=1, size=SIZE, engine="mesh"
    )
    np.testing.assert_allclose(rolling.sequence.quads, whole.sequence.quads, rtol=1e-4, atol=1e-6)
    assert np.abs(whole.sequence.quads).max() > 0.01


def test_an_upright_edge_leans():
    """It moves on by v / z f per second of delay, row by row, which global shutters do not show."""
    wide = (320, 240)
    rolling = scene(row_time=2e-4)
    camera_at = partial(rolling.camera, wide)
    moving = next(n for n, body in enumerate(rolling.bodies) if body.moves)
    path = rolling.bodies[moving].path
    velocity = (path.world_from_body(0.05)[0, 3] - path.world_from_body(0.0)[0, 3]) / 0.05
    hits = rolling_hits(rolling.bodies, camera_at, 0.0, rolling.sensor, wide[1])
    upright = first_hit(rolling.bodies, camera_at(0.0), 0.0)
    seen = (hits.body == moving) & (upright.body == moving)
    rows = np.flatnonzero(seen.sum(1) > 8)[4:-4]
    edge, before = (
        np.array([np.flatnonzero(h.body[row] == moving)[-1] for row in rows])
        for h in (hits, upright)
    )
    z = upright.point[rows, before, 2]
    want = velocity / z * camera_at(0.0).fx * row_delays(rolling.sensor, wide[1])[rows]
    assert abs(want).max() > 2, "pixels"
    assert np.abs((edge - before) - want).max() < 1.5


def test_a_capture_says_so_and_reconstruction_warns(tmp_path, capsys):
    """What was set is in the file, and nobody fits rows without a word."""
    override = ["--override", "sensor.row_time_s=1e-4", "--size", "24x18", "--frames", "8"]
    assert (
        main(
            [
                "simulate",
                "demo",
                "--engine",
                "mesh",
                "--format",
                "capture",
                *override,
                "--out",
                f"{tmp_path}/seq",
            ]
        )
        == 0
    )
    assert Sequence.open(tmp_path / "seq").calibration.settings["row_time_s"] == 1e-4
    assert (
        main(["reconstruct", f"{tmp_path}/seq", "--images", "4", "--out", f"{tmp_path}/run"]) == 0
    )
    assert "a rolling shutter: the last row is 1.7 ms later" in capsys.readouterr().err


def test_rows_roll_on_the_ladder_as_soon_as_time_passes():
    """All quads at one instant means all rows, too; from then on a sensor has its own rows."""
    rows = {name: resolved(scene(), SimSettings(level=name))[0].sensor.row_time_s for name in NAMES}
    assert rows == {"sync": 0.0} | dict.fromkeys(NAMES[1:], ROW_TIME)


def test_splats_have_one_time():
    """The other engine refuses."""
    with pytest.raises(UsageError, match="--engine mesh"):
        record(scene(), frames=1, size=SIZE)
