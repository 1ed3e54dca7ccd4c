"""Engine mesh on every named scene; assemblies and walls without end as rays see them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_trace import AHEAD, CAMERA, F_MOD_HZ, GREY, expected, light, plane, scene_of

from gftorf_warp import Sequence, cli
from gftorf_warp.render.trace import Bounces
from gftorf_warp.scene.camera import Camera
from gftorf_warp.sim.assembly import Assembly, Level, Part
from gftorf_warp.sim.bodies import chair
from gftorf_warp.sim.ideal_sensor import light_of
from gftorf_warp.sim.mesh_engine import MeshEngine, rigid_bodies
from gftorf_warp.sim.paths import Line, Still
from gftorf_warp.sim.scene_file import read_scene
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.world import Body, Box, Plane, Sphere, Texture, first_hit

EXAMPLE = Path(__file__).parents[1] / "examples" / "scene.toml"
MIXED = (
    Part(shape=Box(size=(0.5, 0.1, 0.3)), position=(0.0, 0.2, 0.0)),
    Part(shape=Sphere(radius=0.2), position=(-0.3, -0.2, 0.0)),
    Part(shape=Plane(size=(0.3, 0.3)), position=(0.2, -0.2, 0.1)),
    Part(shape=Sphere(radius=0.1), position=(0.3, -0.1, -0.1)),
)
PATTERN = Texture(low=0.1, high=0.9, cell=0.07)


def level(axis, value, texture=GREY, turn=(0.0, 0.0, 0.0)):
    """A wall without end."""
    return Body(shape=Level(axis=axis, value=value), texture=texture, path=Still(turn_deg=turn))


def bounced(*bodies, camera=CAMERA, paths=64):
    """Amplitude of the light that met more than one surface, and of direct light."""
    direct, total = (
        MeshEngine(
            scene_of(*bodies), lambda _: camera, bounces=Bounces(count=count, paths=paths)
        ).light((0.0,), F_MOD_HZ)
        for count in (0, 3)
    )
    return total.amplitude.astype(np.float64) - direct.amplitude, direct.amplitude


# -- every scene -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*SCENES, str(EXAMPLE)], ids=lambda name: Path(name).stem)
def test_every_scene_can_be_traced(name, tmp_path, capsys):
    """From the command line: quads are those of the analytic light of the same rays,
    and truth is the analytic one.
    """
    scene = SCENES[name] if name in SCENES else read_scene(name)
    small = ["--frames", "2", "--size", "32x24", "--engine", "mesh", "--no-noise", "-q"]
    assert cli.main(["simulate", name, "--out", str(tmp_path / "out"), *small]) == 0, (
        capsys.readouterr().err
    )
    assert "Engine mesh" in (tmp_path / "out" / "README.md").read_text()
    sequence = Sequence.open(tmp_path / "out")
    assert sequence.quads.shape == (2, 24, 32)
    assert (sequence.colour.camera_from_world is not None) == (scene.colour is not None)
    for n in range(2):
        rays = light_of(
            replace(scene, width=32, height=24), float(sequence.times[n]), rays=scene.subsamples
        )
        turned = rays.phasor * np.exp(1j * (scene.sensor.phase_offset - scene.sensor.shifts[n]))
        want = scene.sensor.source_intensity * (
            turned.real + scene.sensor.dc_offset * rays.amplitude
        )
        off = (
            np.abs(sequence.quads[n] - want) > 1e-4 * scene.sensor.source_intensity * rays.amplitude
        )
        assert off.mean() < 0.01  # a ray on an outline or on a border of two cells


# -- assemblies ------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [chair(), Assembly(parts=MIXED), Assembly(parts=MIXED[1::2])])
def test_an_assembly_is_met_where_its_parts_are(shape):
    """Turned and on its way: distance within 2e-5 m, normal and body are analytic,
    reflectance is of the whole.
    """
    path = Line(position=(-0.2, 0.1, 1.6), velocity=(1.0, 0.0, -0.5), turn_deg=(15.0, 40.0, -10.0))
    bodies = (
        level(2, 3.0),
        Body(shape=shape, texture=PATTERN, path=path),
        plane(2.5, size=(0.5, 0.5), x=-0.6),
    )
    camera = Camera.from_fov(96, 72, 60.0)
    traced = MeshEngine(scene_of(*bodies), lambda _: camera)
    for time in (0.0, 0.3):
        got, want = traced.first_hits(time), first_hit(bodies, camera, time)
        same = got.body == want.body
        assert (~same).sum() <= 1
        assert (want.body == 1).sum() > 150
        np.testing.assert_allclose(got.distance[same], want.distance[same], atol=2e-5)
        assert (np.abs(got.normal - want.normal)[same].max(-1) > 2e-5).sum() <= 1
        amplitude = light(*bodies, camera=camera, times=(time,)).amplitude
        off = np.abs(amplitude / expected(bodies, camera, time)[1] - 1) > 1e-4
        assert off[want.body == 1].mean() < 0.02  # rays on a border of cells


def test_pieces_of_an_assembly_are_as_few_as_can_be():
    """All flat sides together, each ball alone; a single shape is one piece."""
    assert [
        len(rigid_bodies(Body(shape=s, texture=GREY, path=Still())))
        for s in (chair(), Assembly(parts=MIXED))
    ] == [
        1,
        3,
    ]
    boxes = rigid_bodies(Body(shape=chair(), texture=GREY, path=Still()))[0]
    assert len(boxes.triangles) == 9 * 12
    assert len(np.unique(boxes.triangles)) == len(boxes.points) == 9 * 8


# -- walls without end -----------------------------------------------------------------------------


def test_a_wall_without_end_is_seen_from_both_sides():
    """Distance to the horizon and beyond what a rectangle covers; the normal points to the camera;
    texture is right.
    """
    for axis, value in ((1, 0.9), (1, -0.7), (2, 3.3), (0, 0.4)):
        for turn in ((0.0, 0.0, 0.0), (5.0, -20.0, 8.0)):
            bodies = (level(axis, value, Texture(low=0.1, high=0.9, cell=0.4), turn),)
            got, want = (
                MeshEngine(scene_of(*bodies), lambda _: CAMERA).first_hits(0.0),
                first_hit(bodies, CAMERA, 0.0),
            )
            np.testing.assert_array_equal(got.body, want.body)
            met = want.body == 0
            assert met.any()
            # 700 m at one ray
            np.testing.assert_allclose(1 / got.distance[met], 1 / want.distance[met], atol=1e-6)
            assert np.isnan(got.distance[~met]).all()
            np.testing.assert_allclose(got.normal[met], want.normal[met], atol=1e-6)
            near = met & (np.nan_to_num(want.distance) < 20)
            amplitude = light(*bodies).amplitude
            assert (np.abs(amplitude / np.where(near, want.amplitude, 1.0) - 1) > 1e-4)[
                near
            ].mean() < 5e-3
            assert (amplitude[~met] == 0).all()


def test_what_starts_on_a_wall_without_end_leaves_it():
    """A lone wall gets no light from itself, near or far, head-on or turned;
    two walls light each other.
    """
    for axis, value, turn in (
        (2, 2.0, (0.0, 0.0, 0.0)),
        (1, 1.1, (0.0, 0.0, 0.0)),
        (2, 7.3, (20.0, -30.0, 5.0)),
    ):
        indirect, direct = bounced(level(axis, value, turn=turn))
        assert (direct > 0).any()
        assert (indirect == 0).all()
    walls = bounced(level(0, 1.0), level(2, 2.0))
    rectangles = bounced(plane(2.0), plane(0.0, x=1.0, turn=90.0))
    np.testing.assert_allclose(walls[1], rectangles[1], rtol=1e-4)
    assert walls[0].mean() > 0.01 * walls[1].mean()
    assert walls[0].mean() == pytest.approx(rectangles[0].mean(), rel=0.02)


def test_a_wall_without_end_is_in_the_way_from_both_sides():
    """Of light that stands behind it; and dark itself, since the light meets its other side."""
    card = plane(3.0)
    between = level(0, -0.5)  # beside the camera, which sees the card in front
    for place, lit in (((-0.3, 0.0, 0.0), True), ((-0.8, 0.0, 0.0), False)):
        for texture in (GREY, PATTERN):
            screen = replace(between, texture=texture)
            got = light(screen, card, camera=AHEAD, emitter=place).amplitude
            assert (got > 0).all() == lit
    hit = first_hit((between, card), CAMERA, 0.0)
    seen = light(between, card, emitter=(-0.8, 0.0, 0.0)).amplitude
    assert (hit.body == 0).any()
    assert (seen == 0).all()
    assert (light(between, card, emitter=(-0.3, 0.0, 0.0)).amplitude[hit.body == 0] > 0).all()
