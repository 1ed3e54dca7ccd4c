"""Lenses: distortion against OpenCV, its inverse, what it does to the truth;
fall-off and beam on a frontal wall.
"""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from small_runs import small

from gftorf_warp.cli import main
from gftorf_warp.data.exr import write_exr
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.distortion import Distortion
from gftorf_warp.scene.electrons import electron_gain
from gftorf_warp.scene.measured import camera_of
from gftorf_warp.scene.optics import Lens, lens_rows, shading
from gftorf_warp.scene.pattern import Pattern, gain_map
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.assembly import Level
from gftorf_warp.sim.ideal_sensor import ideal_recording, light_of
from gftorf_warp.sim.paths import Still
from gftorf_warp.sim.readout import read_out
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scene import Scene
from gftorf_warp.sim.scene_file import read_scene
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Box, Texture

BARREL = Distortion(k1=-0.25, k2=0.08, p1=0.002, p2=-0.003, k3=-0.01)
PINCUSHION = Distortion(k1=0.15, k2=-0.02)
WALL = Body(
    shape=Level(axis=2, value=3.0),
    texture=Texture(low=0.5, high=0.5),
    path=Still(position=(0.0, 0.0, 0.0)),
)


def scene(**settings):
    """A grey wall at z = 3 m, with one pixel on the optical axis and one ray per pixel."""
    sensor = Sensor(shifts=(0.0, math.pi), dc_offset=1.0, contrast=0.4)
    texts = {"name": "wall", "description": "", "motion": ""}
    size = {"frames": 2, "width": 33, "height": 25, "subsamples": 1}
    return Scene(**{**texts, **size, "bodies": (WALL,), "sensor": sensor, **settings})


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_distortion_is_opencv_s(lens):
    """Where a lens images points, and back again."""
    camera = Camera(width=320, height=240, fx=230.0, fy=228.0, cx=159.0, cy=119.0, distortion=lens)
    points = np.random.default_rng(0).uniform([-1, -0.7, 1.5], [1, 0.7, 4.0], (200, 3))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    want = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(camera.project(torch.from_numpy(points)).numpy(), want, atol=1e-8)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    np.testing.assert_allclose(lens.undo(*lens.apply(x, y)), (x, y), atol=1e-10)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_rays_meet_the_pixel_centres(lens):
    """A point on the ray of a pixel is imaged at its centre;
    a pose turns the rays as it did before.
    """
    pose = np.eye(4)
    pose[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    camera = Camera(
        width=40,
        height=30,
        fx=29.0,
        fy=28.0,
        cx=19.0,
        cy=16.0,
        camera_from_world=pose,
        distortion=lens,
    )
    rays = camera.rays(dtype=torch.float64)
    seen = camera.project(torch.from_numpy(camera.centre) + 2.0 * rays).numpy()
    y, x = np.mgrid[:30, :40] + 0.5
    np.testing.assert_allclose(seen, np.stack([x, y], -1), atol=1e-8)
    np.testing.assert_allclose(rays.norm(dim=-1).numpy(), 1.0)
    fine = camera.resized(80, 60).directions().reshape(30, 2, 40, 2, 3).mean((1, 3))
    bent = torch.nn.functional.normalize(fine, dim=-1) - camera.directions()
    # sub-samples of the same lens surround the ray of the pixel
    assert bent.norm(dim=-1).max() < 1e-3


def test_derivatives_of_a_lens():
    """Against central differences: they decide where a lens folds."""
    x, y = np.random.default_rng(0).uniform(-0.8, 0.8, (2, 50))
    lens, step = Distortion(k1=-0.25, k2=0.3, p1=0.2, p2=-0.1, k3=0.4), 1e-6
    by_x = (np.array(lens.apply(x + step, y)) - lens.apply(x - step, y)) / (2 * step)
    by_y = (np.array(lens.apply(x, y + step)) - lens.apply(x, y - step)) / (2 * step)
    xx, xy, yy = lens.slope(x, y)
    np.testing.assert_allclose((xx, xy), by_x, atol=1e-8)
    np.testing.assert_allclose((xy, yy), by_y, atol=1e-8)


def test_truth_and_ideal_quads_are_seen_through_the_lens():
    """Distance of the wall along the bent rays; the sequence keeps the coefficients."""
    bent = scene(lens=Lens(distortion=BARREL))
    cosine = bent.camera().directions()[..., 2].numpy()
    np.testing.assert_allclose(light_of(bent, 0.0).distance, 3.0 / cosine, rtol=1e-12)
    straight = light_of(scene(), 0.0).distance
    assert np.abs(straight - 3.0 / cosine)[0, 0] > 0.05
    sequence, truth = ideal_recording(bent)
    np.testing.assert_allclose(truth.distance[0], 3.0 / cosine, rtol=1e-6)
    assert sequence.intrinsics.distortion == (BARREL.k1, BARREL.k2, BARREL.p1, BARREL.p2, BARREL.k3)
    assert camera_of(sequence, 0).distortion == BARREL
    assert ideal_recording(scene())[0].intrinsics.distortion is None


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"frequencies_hz": np.repeat([20e6, 20e6 * math.sqrt(2)], 6)},
            "frequencies without a common range",
        ),
    ],
)
def test_what_cannot_be_rendered_is_not_reconstructed(changes, says, tmp_path):
    """A sequence of frequencies that nothing unwraps would be fitted wrong without a word."""
    with pytest.raises(InputError, match=says):
        reconstruct(replace(small(), **changes), tmp_path / "run", "demo", images=4)


def test_lenses_that_cannot_be_undone_are_refused():
    """A fold inside the image, and coefficients that are no numbers;
    nothing is decided by luck of an iteration.
    """
    fold = Distortion(k1=-2.0)  # r (1 - 2 r^2) turns at r = .41
    with pytest.raises(ValueError, match=r"k1=-2\.0.* cannot be undone"):
        Camera.from_fov(33, 25, 60.0, distortion=fold)
    Camera.from_fov(33, 25, 10.0, distortion=fold)  # far inside its turn
    # turns, and turns back: what it images at .5 is behind both, at 1.546
    twice = Distortion(k1=-1.0, k2=0.3)
    np.testing.assert_allclose(
        twice.apply(np.array([1.54582907]), np.zeros(1)), [[0.5], [0.0]], atol=1e-7
    )
    with pytest.raises(ValueError, match="cannot be undone"):
        twice.undo(np.array([0.5]), np.zeros(1))
    with pytest.raises(ValueError, match="cannot be undone"):
        scene(lens=Lens(distortion=fold))
    with pytest.raises(ValueError, match="p2 must be finite"):
        Distortion(p2=math.nan)


def test_a_lens_that_cannot_be_undone_is_an_error_of_the_user(tmp_path):
    """Before anything is written."""
    with pytest.raises(UsageError, match="cannot be undone"):
        simulate("demo", tmp_path / "out", overrides=["lens.distortion.k1=-2"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("lens", "power"),
    [
        (Lens(), 3),
        (Lens(cosine_power=4.0), 7),
        (Lens(cosine_power=4.0, beam_power=-3.0), 4),
    ],
)
def test_fall_off_of_a_frontal_wall(lens, power):
    """Sensor notes, T24: cos^3 of an isotropic emitter, cos^7 with the lens,
    cos^4 if the wall is lit evenly; 1e-5.
    """
    image = (
        record(scene(lens=lens), engine="mesh", noise=False)
        .sequence.quads.astype(np.float64)
        .mean(0)
    )
    cosine = scene().camera().directions()[..., 2].numpy()
    assert cosine.min() < 0.83
    np.testing.assert_allclose(image / image[12, 16], cosine**power, rtol=1e-5)


def test_both_engines_are_shaded_alike():
    """The shading is the sensor's, not an engine's: it multiplies what either of them gives."""
    lens = Lens(cosine_power=4.0, vignetting=(-0.3, 0.05), beam_power=2.0)
    for engine in ("gaussian", "mesh"):
        plain, shaded = (
            record(scene(lens=one), engine=engine, noise=False).sequence.quads
            for one in (Lens(), lens)
        )
        np.testing.assert_allclose(
            shaded, plain * shading(lens, scene().camera()).active, rtol=1e-6
        )


def test_the_light_of_the_truth_is_that_of_the_quads():
    """Amplitude and the parts of the light, as the lens and the beam weaken them; not the share of
    ambient light, which belongs to the surface.
    """
    lens = Lens(cosine_power=4.0, beam_power=2.0)
    active = shading(lens, scene().camera()).active
    for engine in ("gaussian", "mesh"):
        more = {"format": "capture", "truth": "all"} if engine == "mesh" else {}
        plain, shaded = (
            record(scene(lens=one), engine=engine, noise=False, **more) for one in (Lens(), lens)
        )
        before, after = plain.truth, shaded.truth
        np.testing.assert_allclose(after.amplitude, before.amplitude * active, rtol=1e-6)
        quads = shaded.sequence.quads[:2].astype(np.float64)
        np.testing.assert_allclose(quads.mean(0), after.amplitude[0], rtol=1e-5)
        for name, images in after.layers.items():
            factor = active if name == "phasor.1" else 1.0
            np.testing.assert_allclose(images, before.layers[name] * factor, rtol=1e-5, atol=1e-9)


def test_a_beam_keeps_its_power():
    """Sensor notes, T6: whatever its shape, its mean over the solid angle of the image is 1;
    ambient light has none.
    """
    camera = Camera.from_fov(320, 240, 70.0)
    cosine = camera.directions()[..., 2].numpy()
    for power in (-3.0, 1.0, 8.0):
        seen = shading(Lens(beam_power=power), camera)
        assert (seen.active * cosine**3).sum() / (cosine**3).sum() == pytest.approx(1.0, rel=1e-12)
        np.testing.assert_array_equal(seen.ambient, np.ones((240, 320)))
    assert shading(Lens(distortion=BARREL), camera) is None


def test_ambient_light_passes_the_lens_and_not_the_beam():
    """What each pixel gets of the ambient electrons is its reflectance times the fall-off times
    its own response.
    """
    sensor = Sensor(
        noise=True, ambient_electrons=4e4, pattern=Pattern(gain=0.2), dark_electrons_per_s=0.0
    )
    sensor = replace(sensor, read_noise_electrons=0.0, adc_bits=None)
    camera = Camera.from_fov(8, 6, 60.0)
    seen, dark = shading(Lens(cosine_power=4.0, beam_power=8.0), camera), np.zeros((6, 8))
    draws = [
        read_out(
            dark, dark, sensor, np.random.default_rng(n), ambient=np.full((6, 8), 0.5), shading=seen
        ).quad
        for n in range(4000)
    ]
    # the variance of a difference of two taps
    want = 2e4 * seen.ambient * gain_map(sensor.pattern, 6, 8)
    got = np.var(draws, axis=0) * (sensor.contrast * electron_gain(sensor)) ** 2
    np.testing.assert_allclose(got, want, rtol=5 * math.sqrt(2 / 4000))
    assert np.ptp(want) > 0.5 * want.max()


def test_vignetting_is_one_on_the_axis_and_its_polynomial_in_the_corner():
    """The farthest pixel has r = 1; V multiplies all light."""
    camera = Camera.from_fov(33, 25, 60.0)
    seen = shading(Lens(vignetting=(-0.3, -0.1)), camera)
    assert seen.ambient[12, 16] == 1.0
    assert seen.ambient[0, 0] == pytest.approx(0.6)
    np.testing.assert_array_equal(seen.active, seen.ambient)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"cosine_power": math.nan}, "cosine_power must be finite"),
        ({"beam_power": math.inf}, "beam_power must be finite"),
        ({"vignetting": (-1.2,)}, "vignetting must keep V above 0"),
        ({"vignetting": (0.4,)}, "not above 1"),
    ],
)
def test_lenses_that_cannot_be(settings, says):
    """The message names the setting."""
    with pytest.raises(ValueError, match=says):
        Lens(**settings)


def test_a_recording_of_a_lens_that_cannot_be_undone_is_bad_input(tmp_path, capsys):
    """Coefficients of another order or resolution: the image folds inside of its borders."""
    sequence = record(scene(sensor=Sensor(), frames=4)).sequence
    folded = replace(sequence.intrinsics, distortion=(-5.0, 0.0, 0.0, 0.0, 0.0))
    path = write("capture", tmp_path / "seq", replace(sequence, intrinsics=folded))
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "run"), "--preset", "ctof"]) == 3
    error = capsys.readouterr().err
    assert f"a lens that cannot be undone - {path}" in error
    assert "k1=-5.0" in error
    assert main(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert "a lens that cannot be undone" in said
    assert "[lens]" in said


@pytest.mark.parametrize("power", [-3.0, 4.0])
def test_a_beam_beside_the_camera_is_seen_from_there(power):
    """On a frontal wall: the angle is the emitter's, the mean over the image the camera's; 2e-5."""
    lens, place = Lens(beam_power=power), np.array([0.4, -0.1, 0.0])
    bent = scene(lens=lens, emitter=tuple(place))
    image = record(bent, engine="mesh", noise=False).sequence.quads.astype(np.float64).mean(0)
    rays = bent.camera().directions().numpy()
    towards = 3.0 * rays / rays[..., 2:] - place
    reach = np.linalg.norm(towards, axis=-1)
    cosine, own = towards[..., 2] / reach, rays[..., 2]
    factor = (own**3).sum() / (own**3 * own**power).sum()
    shape = np.maximum(cosine, own.min() if power < 0 else 0.0) ** power
    np.testing.assert_allclose(image, 0.5 * cosine / reach**2 * factor * shape, rtol=2e-5)
    assert power > 0 or (cosine < own.min()).any()


def test_a_beam_bounces():
    """Direct light has the beam of the pixels, as without bounces;
    what bounces comes of what the beam lights.
    """
    box = replace(
        WALL, shape=Box(size=(4.0, 3.0, 5.0), inside=True), path=Still(position=(0.0, 0.0, 1.0))
    )
    options = {
        "engine": "mesh",
        "noise": False,
        "bounces": 1,
        "paths": 256,
        "frames": 1,
        "format": "capture",
    }
    plain, beam = (
        record(scene(bodies=(box,), lens=lens), **options).truth.layers
        for lens in (Lens(), Lens(beam_power=8.0))
    )
    active = shading(Lens(beam_power=8.0), scene().camera()).active
    np.testing.assert_allclose(beam["direct"][0, 2], plain["direct"][0, 2] * active, rtol=2e-5)
    assert active[12, 16] > 1.3
    both = [
        record(scene(bodies=(box,), lens=lens), **options).truth
        for lens in (Lens(), Lens(beam_power=8.0))
    ]
    bounced = [truth.amplitude[0] - truth.layers["direct"][0, 2] for truth in both]
    assert bounced[0].min() > 0
    assert 0 < bounced[1].mean() < 0.6 * bounced[0].mean(), (
        "what shines to the side and back comes by more walls"
    )


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".png"])
def test_a_measured_map_multiplies_all_light(tmp_path, suffix):
    """Of any size, over its largest value; it counts by content,
    and a scene file names it beside itself.
    """
    y, x = np.mgrid[:50, :66] / 66.0
    image = (40000 * (1.0 - 0.5 * x - 0.2 * y)).astype(np.uint16)
    file = tmp_path / f"map{suffix}"
    if suffix == ".npy":
        np.save(file, image.astype(np.float32))
    elif suffix == ".exr":
        write_exr(file, {"Y": image.astype(np.float32)})
    else:
        assert cv2.imwrite(str(file), image)
    lens, camera = Lens(falloff=file, cosine_power=2.0), scene().camera()
    want = image.reshape(25, 2, 33, 2).mean((1, 3)) / image.max()
    seen = shading(lens, camera)
    np.testing.assert_allclose(
        seen.ambient, want * camera.directions()[..., 2].numpy() ** 2, rtol=1e-6
    )
    np.testing.assert_array_equal(seen.active, seen.ambient)
    coarse = shading(Lens(falloff=file), Camera.from_fov(132, 100, 60.0)).ambient
    assert 0 < np.abs(np.diff(coarse, axis=1)).max() < 0.01, "linear in between"
    file.with_name(f"other{suffix}").write_bytes(file.read_bytes())
    assert (
        repr(Lens(falloff=file))
        == repr(Lens(falloff=file.with_name(f"other{suffix}")))
        != repr(Lens())
    )
    assert "falloff" not in repr(Lens(cosine_power=1.0))
    assert f"map{suffix}, 66x50" in lens_rows(lens)["fall-off map"]
    table = tmp_path / "scene.toml"
    body = (
        '[[bodies]]\nshape = { kind = "sphere", radius = 0.5 }\npath = { kind = "still", '
        "position = [0, 0, 2] }\n"
    )
    body += "texture = { low = 0.5, high = 0.5 }\n"
    table.write_text(f'[lens]\nfalloff = "map{suffix}"\n{body}')
    np.testing.assert_array_equal(read_scene(table).lens.map, lens.map)
    shaded, plain = (
        record(scene(lens=one), engine="mesh", noise=False).sequence.quads
        for one in (Lens(falloff=file), Lens())
    )
    np.testing.assert_allclose(shaded, plain * want, rtol=1e-5)


def test_maps_that_cannot_be(tmp_path):
    """Each is named, with what is wrong."""
    good = np.ones((4, 5), dtype=np.float32)
    wrong = {
        "zero.npy": (good * [1, 1, 0, 1, 1], "above 0"),
        "three.npy": (np.ones((4, 5, 3)), "rows and columns"),
    }
    for name, (image, says) in wrong.items():
        np.save(tmp_path / name, image)
        with pytest.raises(InputError, match=says):
            Lens(falloff=tmp_path / name)
    (tmp_path / "broken.png").write_bytes(b"no picture")
    (tmp_path / "broken.npy").write_bytes(b"")
    write_exr(tmp_path / "two.exr", {"A": good, "B": good})
    for name, says in (
        ("broken.png", "PNG"),
        ("broken.npy", "no fall-off map"),
        ("two.exr", "one channel"),
        ("gone.npy", "no such file"),
        ("map.tif", r"\.png, found '\.tif'"),
    ):
        with pytest.raises(InputError, match=says):
            Lens(falloff=tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        simulate("demo", tmp_path / "out", overrides=[f"lens.falloff={tmp_path / 'gone.npy'}"])
    assert not (tmp_path / "out").exists()


def test_the_card_names_what_a_lens_does(tmp_path):
    """And nothing of a pinhole."""
    assert lens_rows(Lens()) == {}
    assert set(lens_rows(Lens(distortion=BARREL, vignetting=(-0.1,), beam_power=1.0))) == {
        "distortion",
        "fall-off",
        "beam",
    }
    overrides = ["lens.cosine_power=4", "lens.vignetting=-0.2,0.05"]
    path = simulate("demo", tmp_path / "out", frames=4, size=(24, 18), overrides=overrides)
    card = (path / "README.md").read_text()
    assert (
        "| fall-off | cosine to the power 4, times 1 -0.2 r^2 +0.05 r^4 with r = 1 in the "
        "farthest corner |"
    ) in card
