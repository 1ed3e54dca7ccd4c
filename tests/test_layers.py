"""Layers of a capture's truth: what the tracer knows anyway,
and ambient light that each pixel sends back by itself.
"""

from dataclasses import replace

import numpy as np
import pytest

from gftorf_warp import Sequence
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.electrons import electron_gain
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.assembly import Level
from gftorf_warp.sim.mesh_engine import MeshEngine
from gftorf_warp.sim.paths import Still
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scene import Scene
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Box, Texture

SMALL = {"frames": 5, "size": (24, 18), "engine": "mesh"}
SUN = 4e5  # [e-] of a white surface
DARK, BRIGHT = 0.1, 0.8


def two_walls(sensor):
    """A dark wall and, in front of its right half, a bright one,
    so far away that own light is almost nothing.
    """
    walls = (
        Body(shape=Level(axis=2, value=60.0), texture=Texture(low=DARK, high=DARK), path=Still()),
        Body(
            shape=Box(size=(100.0, 200.0, 1.0)),
            texture=Texture(low=BRIGHT, high=BRIGHT),
            path=Still(position=(50.0, 0.0, 55.0)),
        ),
    )
    texts = {"name": "walls", "description": "walls", "motion": "none"}
    view = {"width": 160, "height": 120, "horizontal_fov_deg": 40.0, "subsamples": 1}
    return Scene(**texts, bodies=walls, frames=4, sensor=sensor, **view)


def test_dark_and_bright_walls_have_shot_noise_of_their_own():
    """T8: variance of a quad is (ambient electrons times reflectance + own light + dark) and read
    noise; 4 sigma.
    """
    sensor = Sensor(noise=True, ambient_electrons=SUN, full_well_electrons=1e9, adc_bits=None)
    scene, unit = two_walls(sensor), sensor.contrast * electron_gain(sensor)
    clean, noisy = (
        record(scene, noise=noise, engine="mesh").sequence.quads for noise in (False, True)
    )
    noise = (noisy - clean).astype(np.float64) * unit
    for side, reflectance in ((np.s_[:, :, :75], DARK), (np.s_[:, :, 85:], BRIGHT)):
        # at most, and hardly a thousandth of the sun
        own = electron_gain(sensor) * reflectance / 55.0**2
        want = SUN * reflectance + own + 2 * sensor.dark_electrons_per_s * sensor.exposure_s
        want += 2 * sensor.read_noise_electrons**2
        values = noise[side]
        assert values.var() == pytest.approx(want, rel=4 * np.sqrt(2 / values.size) + 1e-3)
        assert abs(values.mean()) < 4 * np.sqrt(want / values.size)
    everywhere = (
        record(scene, engine="gaussian").sequence.quads - record(scene, noise=False).sequence.quads
    )
    spread = (everywhere * unit).astype(np.float64)
    ratio = spread[:, :, 85:].var() / spread[:, :, :75].var()
    assert ratio == pytest.approx(1.0, abs=0.05), (
        "splats do not know what ambient light they send back"
    )


def test_without_ambient_light_its_share_changes_nothing(monkeypatch):
    """The bytes of a noisy recording are those of a sensor that was told nothing about
    reflectance.
    """
    import gftorf_warp.sim.record as recording

    scene = replace(SCENES["demo"], sensor=Sensor(noise=True))
    told, read_out = record(scene, **SMALL).sequence.quads, recording.read_out
    monkeypatch.setattr(
        recording, "read_out", lambda *a, **k: read_out(*a, **{**k, "ambient": None})
    )
    np.testing.assert_array_equal(told, record(scene, **SMALL).sequence.quads)
    sunny = replace(scene, sensor=Sensor(noise=True, ambient_electrons=1e4))
    assert (told != record(sunny, **SMALL).sequence.quads).any()


def test_a_capture_keeps_the_ambient_image(tmp_path):
    """By default, and nothing else without bounces; the values are the tracer's own."""
    path = simulate("demo", tmp_path / "seq", format="capture", **SMALL)
    truth = Sequence.open(path).truth()
    assert set(truth.layers) == {"ambient"}
    scene = SCENES["demo"]
    for n in (0, 4):
        want = (
            MeshEngine(scene, lambda time: scene.camera((24, 18), time))
            .light((n / 120,), 2e7)
            .ambient
        )
        np.testing.assert_array_equal(truth.layers["ambient"][n, 0], want)
    assert (
        not Sequence.open(simulate("demo", tmp_path / "splats", frames=4, format="capture"))
        .truth()
        .layers
    )
    assert not Sequence.open(simulate("demo", tmp_path / "ftorf", **SMALL)).truth().layers


def test_light_in_parts_is_kept_if_it_bounces(tmp_path):
    """Direct light is that of a recording without bounces; 'all' adds the light itself, harmonics,
    depth, normals.
    """
    changes = [
        "sensor.harmonic_contrast=0,-0.1",
        "sensor.source_intensity=1.5",
        "sensor.phase_offset=0.4",
    ]
    options = {"format": "capture", "noise": False, "overrides": changes, **SMALL}
    bounced = {"bounces": 2, "paths": 8}
    plain = Sequence.open(simulate("demo", tmp_path / "a", **options)).truth()
    usual = Sequence.open(simulate("demo", tmp_path / "b", **options, **bounced)).truth()
    whole_path = simulate("demo", tmp_path / "c", **options, **bounced, truth="all")
    sequence = Sequence.open(whole_path)
    whole = sequence.truth()
    assert set(usual.layers) == {"ambient", "direct", "error"}
    assert set(whole.layers) == {*usual.layers, "phasor.1", "phasor.3", "z_depth", "normal"}
    for name, images in usual.layers.items():
        np.testing.assert_array_equal(whole.layers[name], images)
    np.testing.assert_array_equal(usual.layers["direct"][:, 2], plain.amplitude)
    assert (whole.amplitude >= plain.amplitude).all()
    assert (usual.layers["error"] > 0).mean() > 0.9
    light = {
        h: whole.layers[f"phasor.{h}"][:, 0] + 1j * whole.layers[f"phasor.{h}"][:, 1]
        for h in (1, 3)
    }
    # the quads follow: intensity is in the light, the phase offset is not
    for n in range(sequence.frames):
        angle = 0.4 - sequence.shifts[n]
        quad = (light[1][n] * np.exp(1j * angle) - 0.1 * light[3][n] * np.exp(3j * angle)).real
        quad = quad + sequence.calibration.dc_offset * whole.amplitude[n]
        np.testing.assert_allclose(sequence.quads[n], quad, atol=2e-6)
    camera = SCENES["demo"].camera((24, 18))
    cosine = camera.rays().numpy()[..., 2]
    np.testing.assert_allclose(whole.layers["z_depth"][:, 0], whole.distance * cosine, atol=2e-5)
    np.testing.assert_allclose((whole.layers["normal"] ** 2).sum(1), 1.0, atol=1e-5)
    assert ((whole.layers["normal"] * np.moveaxis(camera.rays().numpy(), -1, 0)).sum(1) < 0).all()
    assert "--format capture --truth all" in (whole_path / "README.md").read_text()
    with pytest.raises(UsageError, match="other settings"):
        simulate("demo", tmp_path / "c", **options, **bounced)


def test_layers_survive_an_interruption(tmp_path):
    """Those of the raw frames before it are kept, too."""

    def stop(done, _):
        if done == 3:
            raise KeyboardInterrupt

    options = {"format": "capture", "truth": "all", "bounces": 1, "paths": 4, **SMALL}
    with pytest.raises(KeyboardInterrupt):
        simulate("demo", tmp_path / "a", **options, progress=stop)
    paths = [simulate("demo", tmp_path / name, **options) for name in ("a", "b")]
    files = [{f.name: f.read_bytes() for f in (p / "truth").iterdir()} for p in paths]
    assert files[0] == files[1]


def test_all_truth_needs_a_tracer_and_a_place(tmp_path):
    """Named before anything is made."""
    for options in (
        {"format": "capture"},
        {"engine": "mesh"},
        {"engine": "mesh", "format": "torf", "frames": 4},
    ):
        with pytest.raises(UsageError, match="--engine mesh --format capture"):
            simulate("demo", tmp_path / "seq", truth="all", **options)
    with pytest.raises(UsageError, match="usual, all"):
        simulate("demo", tmp_path / "seq", truth="most", engine="mesh", format="capture")
    with pytest.raises(UsageError, match="--engine mesh --format capture"):
        record(SCENES["demo"], frames=1, truth="all")
    assert not any(tmp_path.iterdir())
    at_level = simulate(
        "demo", tmp_path / "l0", level="L0", format="capture", truth="all", frames=4, size=(8, 6)
    )
    assert "normal" in Sequence.open(at_level).truth().layers
