"""Two engines for one scene: what mesh records, how far it is from gaussian away from edges,
what is refused.
"""

import dataclasses
import math

import numpy as np
import pytest
from test_simulate import SMALL, closed_form, contents, inside, slider

from gftorf_warp import Sequence, cli
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.paths import Still
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES, Scene
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Plane, Texture, first_hit


def phasors(recording):
    """Complex a exp(i psi) of each complete quartet in the canonical order of shifts."""
    quads = recording.sequence.quads
    quads = quads[: len(quads) // 4 * 4].reshape(-1, 4, *quads.shape[1:]).astype(np.float64)
    return (quads[:, 0] - quads[:, 1] + 1j * (quads[:, 2] - quads[:, 3])) / 2


def apart(gaussian, mesh, sensor):
    """Difference of phase as a distance [m], and relative difference of amplitude,
    of every pixel.
    """
    ratio = gaussian / mesh
    return np.angle(ratio) / sensor.phase_slope, np.abs(ratio) - 1


# -- what mesh records -----------------------------------------------------------------------------


def test_quads_are_those_of_the_analytic_hits():
    """Frame n is s (a cos(psi + offset - shift_n) + b a) of the first hits at its time,
    rays averaged, within 1e-4.
    """
    shifts = (math.pi, math.pi / 2, 0.0, 3 * math.pi / 2)
    sensor = Sensor(shifts=shifts, phase_offset=0.4, dc_offset=0.2, source_intensity=1.7)
    scene = slider(sensor=sensor)
    recording = record(scene, frames=6, engine="mesh")
    for n, time in enumerate(recording.sequence.times):
        camera = scene.camera()
        hit = first_hit(
            scene.bodies, camera.resized(2 * camera.width, 2 * camera.height), float(time)
        )
        fine = (
            1.7
            * hit.amplitude
            * (np.cos(hit.distance * sensor.phase_slope + 0.4 - shifts[n % 4]) + 0.2)
        )
        want = fine.reshape(36, 2, 48, 2).mean((1, 3))
        off = np.abs(recording.sequence.quads[n] - want) > 1e-4 * np.abs(want).mean()
        assert off.mean() < 5e-3  # a ray on a border of two cells
    assert recording.gap.max < 2e-5
    np.testing.assert_array_equal(recording.truth.distance, record(scene, frames=6).truth.distance)


def test_simultaneous_quads_decode_to_the_truth_inside_surfaces():
    """Ideal, synchronous and away from edges the closed form is the first hit within what a pixel
    covers; else not.
    """
    scene = SCENES["demo"]
    single = dataclasses.replace(scene, subsamples=1)
    recording = record(single, frames=4, sync=True, noise=False, engine="mesh")
    np.testing.assert_allclose(
        closed_form(recording.sequence)[0], recording.truth.distance[0], atol=2e-5
    )
    moving = record(single, frames=4, noise=False, engine="mesh")
    assert np.abs(closed_form(moving.sequence)[0] - moving.truth.distance[0]).max() > 0.5


def test_colour_is_the_albedo_of_the_rays():
    """Inside one cell of a still body it is the analytic albedo, as the splats have it;
    at edges it is a mean.
    """
    scene = SCENES["tour"]
    gaussian, mesh = (
        record(scene, frames=1, size=(80, 60), noise=False, engine=e).sequence.colour.images[0]
        for e in ("gaussian", "mesh")
    )
    assert mesh.shape == gaussian.shape == (120, 160, 3)
    hit = first_hit(scene.bodies, scene.colour_camera((80, 60)), 0.0)
    mask = inside(hit, 0, pixels=1)
    assert mask.sum() > 1000
    assert np.quantile(np.abs(mesh - gaussian)[mask], 0.98) < 1e-5
    assert np.abs(mesh - gaussian)[mask].max() < 2e-3
    assert len(np.unique(mesh[..., 0])) > len(np.unique(mesh[mask][:, 0]))


def test_exposure_is_an_average_over_its_instants():
    """Two instants: the mean of recordings a quarter of the exposure earlier and later, exactly."""
    scene = slider(sensor=Sensor(exposure_s=6e-3), frames=4)
    blurred = record(scene, exposure_samples=2, engine="mesh").sequence.quads
    shifted = []
    for offset in (-1.5e-3, 1.5e-3):
        path = dataclasses.replace(scene.bodies[1].path, passing_s=-offset)
        moved = dataclasses.replace(scene.bodies[1], path=path)
        shifted.append(
            record(
                dataclasses.replace(scene, bodies=(scene.bodies[0], moved)), engine="mesh"
            ).sequence
        )
    want = np.mean([sequence.quads for sequence in shifted], axis=0)
    off = np.abs(blurred - want) > 1e-5 * np.abs(want).max()
    assert off.mean() < 1e-3
    assert (
        np.abs(blurred - record(scene, engine="mesh").sequence.quads).max()
        > 0.05 * np.abs(want).max()
    )


def test_frames_do_not_depend_on_their_number_and_noise_belongs_to_the_seed():
    """T33: frame n of a shorter recording is that of a longer; a seed gives its noise again,
    another seed another.
    """
    scene = slider()
    clean = [record(scene, frames=n, noise=False, engine="mesh").sequence.quads for n in (3, 8)]
    np.testing.assert_array_equal(clean[0], clean[1][:3])
    first, longer, other = (
        record(scene, frames=n, seed=s, engine="mesh").sequence.quads
        for n, s in [(3, 1), (8, 1), (3, 2)]
    )
    np.testing.assert_array_equal(first, longer[:3])
    assert (first != other).mean() > 0.9
    assert 1e-4 < (first - clean[0]).std()
    assert np.corrcoef((first - clean[0]).ravel(), (other - clean[0]).ravel())[0, 1] < 0.05


def test_bounces_add_light_that_belongs_to_the_seed_and_the_frame():
    """More light than direct light, with a grain of its own in every raw frame and for every seed,
    whatever F is.
    """
    scene = slider(sensor=Sensor(dc_offset=1.0))
    direct = record(scene, frames=3, engine="mesh").sequence.quads
    settings = {"engine": "mesh", "bounces": 2, "paths": 16}
    first, longer, other = (
        record(scene, frames=n, seed=s, **settings).sequence.quads
        for n, s in [(3, 1), (5, 1), (3, 2)]
    )
    np.testing.assert_array_equal(first, longer[:3])
    assert (first >= direct - 1e-6).all()  # with this offset every path adds at least nothing
    assert 1.05 < first.mean() / direct.mean() < 3
    assert (first != other).mean() > 0.9
    assert first.mean() == pytest.approx(other.mean(), rel=0.02)
    grain = first - other
    assert abs(np.corrcoef(grain[0].ravel(), grain[1].ravel())[0, 1]) < 0.1


# -- against gaussian ------------------------------------------------------------------------------


@pytest.mark.parametrize("field_of_view", [20.0, 60.0])
def test_engines_agree_on_a_wall(field_of_view):
    """T31: in a narrow view a wall of splats has the phase of the wall within 1 mm and its
    amplitude within 1 %.

    Towards the corners of a wide one it has them within 4 % and within half the difference of
    distance from ray to ray: the splats of a frontal wall are equally deep, so those with a smaller
    index come first, not the nearer ones.
    """
    wall = Body(
        shape=Plane(size=(9.0, 9.0)),
        texture=Texture(low=0.5, high=0.5),
        path=Still(position=(0.0, 0.0, 3.0)),
    )
    settings = {
        "name": "wall",
        "description": "a wall",
        "motion": "none",
        "bodies": (wall,),
        "frames": 4,
    }
    scene = Scene(**settings, width=96, height=72, horizontal_fov_deg=field_of_view)
    images = [phasors(record(scene, noise=False, engine=e))[0] for e in ("gaussian", "mesh")]
    distance, amplitude = (np.abs(image[2:-2, 2:-2]) for image in apart(*images, scene.sensor))
    growth = np.gradient(first_hit((wall,), scene.camera(), 0.0).distance)
    per_ray = sum(np.abs(along) for along in growth)[2:-2, 2:-2] / scene.subsamples
    assert (distance < 0.5 * per_ray + 1e-4).all()
    assert amplitude.max() < 0.04
    assert field_of_view > 30 or (distance.max() < 1e-3 and amplitude.max() < 0.01)


def agree_on_the_demo(distance, amplitude, still, moving):
    """The bounds that the next test explains."""
    assert np.abs(distance[still]).max() < 10e-3
    assert np.abs(distance[still]).mean() < 2e-3
    assert np.abs(amplitude[still]).max() < 0.07
    assert np.abs(amplitude[still]).mean() < 0.015
    assert np.abs(distance[moving]).max() < 5e-3
    assert -0.12 < amplitude[moving].min() <= amplitude[moving].max() < -0.05


def test_engines_agree_on_the_demo_away_from_edges():
    """Two pixels inside one face and one texture cell, 192x144, simultaneous quads.

    Still surfaces: phase within 10 mm everywhere and 2 mm on average, amplitude within 7 % and 1.5
    % on average; the rest is the slope of distance and the 1/d^2 within a splat's footprint. The
    box that moves: phase within 5 mm, and 5 to 12 % too dark, since its cover is made for its
    nearest approach and overlaps more wherever it is farther away. At edges splats blur: there is
    no bound.
    """
    scene, size = SCENES["demo"], (192, 144)
    gaussian, mesh = (
        phasors(record(scene, frames=8, size=size, noise=False, sync=True, engine=e))
        for e in ("gaussian", "mesh")
    )
    for quartet in (0, 1):
        distance, amplitude = apart(gaussian[quartet], mesh[quartet], scene.sensor)
        hit = first_hit(scene.bodies, scene.camera(size), 4 * quartet / 120)
        still, moving = inside(hit, 0), inside(hit, 1)
        assert still.sum() > 5000
        assert moving.sum() > 200
        agree_on_the_demo(distance, amplitude, still, moving)
        rest = ~inside(hit, 0, 1) & ~inside(hit, 1, 1)
        assert np.abs(distance[rest]).max() > 0.1, (
            "the engines share their edges, so they are not two"
        )


# -- on disk ---------------------------------------------------------------------------------------


def test_the_card_names_the_engine_and_how_to_make_it_again(tmp_path):
    """Both cards differ in the engine; the same command gives the same bytes;
    another engine needs another folder.
    """
    command = [
        "simulate",
        "demo",
        "--size",
        "48x36",
        "--frames",
        "4",
        "-q",
        "--engine",
        "mesh",
        "--out",
    ]
    assert cli.main([*command, str(tmp_path / "a")]) == 0
    assert cli.main([*command, str(tmp_path / "b"), "--device", "cpu"]) == 0
    card = (tmp_path / "a" / "README.md").read_text()
    assert "Engine mesh" in card
    assert "gftorf simulate demo --out SEQ --frames 4 --size 48x36 --engine mesh --seed 0" in card
    assert "Light and camera coincide" in card
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    got, want = (
        Sequence.open(tmp_path / "a"),
        record(SCENES["demo"], size=SMALL, frames=4, engine="mesh").sequence,
    )
    np.testing.assert_array_equal(got.quads, want.quads)
    with pytest.raises(UsageError, match="other settings"):
        simulate("demo", tmp_path / "a", size=SMALL, frames=4)
    simulate("demo", tmp_path / "g", size=SMALL, frames=4)
    card = (tmp_path / "g" / "README.md").read_text()
    assert "Engine gaussian" in card
    assert "--engine" not in card


def test_bounces_are_on_the_card(tmp_path):
    """With the command that makes them again, and the beam."""
    options = [
        "--frames",
        "4",
        "--size",
        "24x18",
        "--engine",
        "mesh",
        "--bounces",
        "2",
        "--paths",
        "4",
        "-q",
    ]
    assert cli.main(["simulate", "demo", "--out", str(tmp_path / "a"), *options]) == 0
    card = (tmp_path / "a" / "README.md").read_text()
    assert "direct light and up to 2 bounces, from 4 paths per pixel" in card
    assert "--engine mesh --bounces 2 --paths 4" in card
    scene = slider(beam_deg=(70.0, 50.0))
    card = (simulate(scene, tmp_path / "b", frames=4, engine="mesh") / "README.md").read_text()
    assert "it shines on 70 x 50 deg; direct light only" in card


def test_light_beside_the_camera_is_on_the_card_and_needs_mesh(tmp_path):
    """An emitter off the lens is recorded by mesh, said on the card,
    and refused by gaussian however it is called.
    """
    scene = slider(emitter=(0.04, 0.0, 0.0))
    card = (simulate(scene, tmp_path / "m", frames=4, engine="mesh") / "README.md").read_text()
    assert "The light is at (40, 0, 0) mm in camera axes and casts shadows" in card
    assert "emitter" not in (simulate(slider(), tmp_path / "c", frames=4) / "README.md").read_text()
    with pytest.raises(UsageError, match="light is beside the camera"):
        simulate(scene, tmp_path / "g", frames=4)
    for more in ({"emitter": (0.04, 0.0, 0.0)}, {"beam_deg": (60.0, 40.0)}):
        with pytest.raises(UsageError, match="expected mesh"):
            record(slider(**more), frames=4)
    together, beside = (
        record(s, frames=1, noise=False, engine="mesh").sequence.quads for s in (slider(), scene)
    )
    assert np.abs(together - beside).max() > 1e-3
    assert not (tmp_path / "g").exists()


def test_engines_and_devices_that_do_not_exist(tmp_path, capsys):
    """Exit code 2 with the names there are; gaussian renders on the CPU."""
    assert cli.main(["simulate", "demo", "--out", str(tmp_path / "x"), "--engine", "rays"]) == 2
    assert "gaussian, mesh" in capsys.readouterr().err
    with pytest.raises(UsageError, match="--engine mesh"):
        simulate("demo", tmp_path / "x", device="elsewhere")
    with pytest.raises(UsageError, match="bounces"):
        simulate("demo", tmp_path / "x", bounces=1)
    for wrong in ({"bounces": -1}, {"paths": 0}):
        with pytest.raises(UsageError, match="cannot simulate with"):
            simulate("demo", tmp_path / "x", engine="mesh", **wrong)
    with pytest.raises(UsageError, match="gaussian, mesh"):
        record(SCENES["demo"], engine="rays")
    assert not (tmp_path / "x").exists()
