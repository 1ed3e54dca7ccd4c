"""Parts of the light: direct and indirect, ambient, the spread of paths, gloss;
and where things go next.
"""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from comparison import DEVICES
from test_bounces import HERE, PLAIN, ball_from_within
from test_trace import AHEAD, CAMERA, F_MOD_HZ, GREY, expected, light, plane, scene_of

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.render.trace import Bounces, RigidBody, Tracer
from gftorf_warp.scene.camera import Camera
from gftorf_warp.scene.sensor import Sensor
from gftorf_warp.sim.bodies import room
from gftorf_warp.sim.curves import Curve, Guided, Turn
from gftorf_warp.sim.mesh_engine import MeshEngine
from gftorf_warp.sim.paths import Line, Still
from gftorf_warp.sim.readout import mean_quad
from gftorf_warp.sim.record import record
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.world import Body, Box, Sphere, Texture, first_hit, flow_of

SHINY = Texture(low=0.6, high=0.6, gloss=0.4, shininess=30.0)


@pytest.fixture(params=DEVICES)
def device(request):
    """Every device there is."""
    return request.param


def test_direct_light_is_a_part_of_the_light(device):
    """The direct part is that of a tracer without bounces, to the bit;
    the rest has longer paths and only adds.
    """
    bodies, settings = (
        (room(), plane(2.0, size=(1.0, 1.0))),
        {"device": device, "harmonics": (1, 3)},
    )
    scene = scene_of(*bodies, subsamples=2, emitter=(0.05, 0.0, 0.0))
    alone = MeshEngine(scene, lambda _: CAMERA, **settings).light((0.0,), F_MOD_HZ)
    both = MeshEngine(
        scene, lambda _: CAMERA, bounces=Bounces(count=2, paths=16), **settings
    ).light((0.0,), F_MOD_HZ)
    np.testing.assert_array_equal(both.direct, alone.light)
    np.testing.assert_array_equal(both.direct_amplitude, alone.amplitude)
    np.testing.assert_array_equal(alone.direct, alone.light)
    assert (alone.error == 0).all()
    more = both.amplitude - both.direct_amplitude
    assert (more >= 0).all()
    assert (more > 0).mean() > 0.9
    assert (np.abs(both.light[1] - both.direct[1]) <= more * (1 + 1e-5) + 1e-7).all()


def test_ambient_is_the_mean_reflectance_of_the_rays(device):
    """Of all sub-samples, shadows or not: edges mix by area, what meets nothing has none."""
    scene = SCENES["demo"]
    camera = scene.camera((48, 36))
    got = light(
        *scene.bodies,
        camera=camera,
        device=device,
        times=(0.1,),
        subsamples=2,
        emitter=(0.3, 0.0, 0.0),
    )
    hit = first_hit(scene.bodies, camera.resized(96, 72), 0.1)
    want = hit.reflectance.reshape(36, 2, 48, 2).mean((1, 3))
    assert (np.abs(got.ambient - want) > 1e-5).mean() < 0.01  # a ray on a border of two cells
    assert (got.amplitude == 0).any()
    half = light(plane(2.0, size=(9.0, 9.0), x=4.5), device=device, subsamples=4).ambient
    np.testing.assert_allclose(half[:, [8, 24]], [[0.0, 0.5]] * 24, atol=1e-6)


def test_the_standard_error_is_that_of_repeated_images(device):
    """Mean square of the error over seeds equals that of the deviations from their mean,
    within 10 %.
    """
    scene = scene_of(room())
    traced = MeshEngine(scene, lambda _: CAMERA, bounces=Bounces(count=2, paths=32), device=device)
    images = [traced.light((0.0,), F_MOD_HZ, seed=s) for s in range(24)]
    lights = np.stack([image.light[0] for image in images]).astype(np.complex128)
    spread = (np.abs(lights - lights.mean(0)) ** 2).sum(0).mean() / (len(images) - 1)
    told = np.mean([image.error.astype(np.float64) ** 2 for image in images])
    assert told / spread == pytest.approx(1.0, abs=0.1)
    single = MeshEngine(
        scene, lambda _: CAMERA, bounces=Bounces(count=2, paths=1), device=device
    ).light((0.0,), F_MOD_HZ)
    assert np.isnan(single.error).all()


# -- gloss -----------------------------------------------------------------------------------------


def test_gloss_of_direct_light(device):
    """Light at the camera: rho cos(i) [1 - g + g (n + 2) / 2 cos(2 i)^n] / d^2,
    by rays and by the analytic hits.
    """
    for turn in (0.0, 10.0, 30.0, 60.0):
        got = light(
            plane(2.0, turn=turn, texture=SHINY), camera=AHEAD, device=device
        ).amplitude.item()
        i = math.radians(turn)
        want = 0.6 * math.cos(i) * (0.6 + 0.4 * 16.0 * max(math.cos(2 * i), 0.0) ** 30) / 4
        assert got == pytest.approx(want, rel=2e-5)
    ball = Body(shape=Sphere(radius=0.7), texture=SHINY, path=Still(position=(0.2, 0.1, 2.5)))
    got, want = light(room(), ball, device=device), expected((room(), ball), CAMERA)
    off = np.abs(got.amplitude - want[1]) > 1e-4 * want[1].max()
    assert off.mean() < 5e-3
    assert (
        want[1].max()
        > 2 * light(room(), replace(ball, texture=GREY), device=device).amplitude.max()
    )


def test_gloss_is_brightest_where_light_is_mirrored(device):
    """Light beside the camera: on a wall the highlight is half way to it,
    where both angles are the same.
    """
    camera = Camera.from_fov(201, 101, 60.0)
    mirror = Texture(low=0.6, high=0.6, gloss=1.0, shininess=3000.0)
    got = light(
        plane(2.0, texture=mirror), camera=camera, device=device, emitter=(0.4, 0.2, 0.0)
    ).amplitude
    y, x = np.unravel_index(got.argmax(), got.shape)
    assert abs(x + 0.5 - (camera.cx + camera.fx * 0.2 / 2.0)) <= 1
    assert abs(y + 0.5 - (camera.cy + camera.fy * 0.1 / 2.0)) <= 1


def sphere_of_gloss(reflectance, gloss, n, bounces, turns):
    """Total light at the centre of a glossy sphere of radius 1 over incident light, with phases of
    ``turns`` per metre.

    State: cosine of arrival m. A bounce to m', turned about the normal by t, has the factor pi f m'
    dm' dt / pi and a chord 2 m' long, which arrives under m' again; the last one goes to the centre
    along the normal.
    """
    m, w, between, ends, straight = lobes(reflectance, gloss, n)
    step = 2 * between * (m * w * np.exp(2j * math.pi * turns * 2 * m))
    # left along the normal's mirror: the normal
    first = 2 * ends * m * w * np.exp(2j * math.pi * turns * 2 * m)
    total, state = complex(straight), first
    for _ in range(bounces):
        total += (state * ends).sum()
        state = state @ step
    return total


@functools.cache
def lobes(reflectance, gloss, n):
    """Cosines m with their weights; pi f between two of them, mean over t, to the normal, and
    straight back.
    """
    node, weight = np.polynomial.legendre.leggauss(160)
    m, w = (node + 1) / 2, weight / 2
    t = (np.arange(256) + 0.5) / 256 * math.pi  # the other half is the same
    sine = np.sqrt(1 - m**2)

    def lobe(cosine):
        return reflectance * (1 - gloss + gloss * (n + 2) / 2 * np.maximum(cosine, 0.0) ** n)

    between = lobe(
        m[:, None, None] * m[None, :, None] + sine[:, None, None] * sine[None, :, None] * np.cos(t)
    ).mean(2)
    return m, w, between, lobe(m), lobe(np.array(1.0))


@pytest.mark.parametrize(("gloss", "n"), [(0.3, 5.0), (0.6, 20.0), (1.0, 3.0)])
def test_furnace_of_gloss(gloss, n, device):
    """T21 with a lobe: a glossy sphere after 1 and 4 bounces against its integral,
    amplitude and complex light.
    """
    # the normals of 5 subdivisions blunt a lobe of n = 20 by 0.4 %
    points, triangles = ball_from_within(6 if n > 10 else 5)
    body = RigidBody(
        points=points, triangles=triangles, low=0.7, high=0.7, gloss=gloss, shininess=n, **PLAIN
    )
    tracer, camera = Tracer([body], 32, 24, device=device), Camera.from_fov(32, 24, 60.0)
    for count in (1, 4):
        got = tracer.light([camera], HERE, 2e7, bounces=Bounces(count=count, paths=40), seed=count)
        amplitude = got.amplitude.astype(np.float64)
        sigma = amplitude.std() / math.sqrt(amplitude.size)
        want = sphere_of_gloss(0.7, gloss, n, count, 0.0).real
        assert amplitude.mean() == pytest.approx(want, abs=2e-3 * want + 4 * sigma)
        assert sigma < 2e-3 * want
        # the camera is one more radius away, and so is the lamp
        turned = got.light[0].astype(np.complex128).mean()
        turned *= np.exp(-2j * math.pi * 2e7 / SPEED_OF_LIGHT * 2.0)
        assert (
            abs(turned - sphere_of_gloss(0.7, gloss, n, count, 2e7 / SPEED_OF_LIGHT))
            < 2e-3 * want + 6 * sigma
        )


def test_the_integral_of_gloss_without_gloss_is_the_sphere():
    """The quadrature above is T20 and T21 for Lambert's law,
    and the closed form of one bounce with a lobe.
    """
    assert sphere_of_gloss(0.5, 0.0, 9.0, 6, 0.0).real == pytest.approx(
        0.5 * sum(0.5**k for k in range(7)), rel=1e-9
    )
    ratio = sphere_of_gloss(0.5, 0.0, 9.0, 1, 2e7 / SPEED_OF_LIGHT) / 0.5
    assert SPEED_OF_LIGHT / (4 * math.pi * 2e7) * np.angle(ratio) == pytest.approx(
        0.216921, abs=1e-6
    )
    kd, ks, n = 0.7 * 0.4, 0.7 * 0.6, 20.0
    closed = kd + ks * (n + 2) / 2 + kd**2 + 2 * kd * ks + ks**2 * (n + 2) ** 2 / (4 * (n + 1))
    assert sphere_of_gloss(0.7, 0.6, 20.0, 1, 0.0).real == pytest.approx(closed, rel=1e-9)


def test_gloss_returns_no_more_than_it_gets():
    """The albedo of the lobe, from any direction: 1 for light from straight ahead,
    less at a slant.
    """
    node, weight = np.polynomial.legendre.leggauss(200)
    for cosine in (1.0, 0.7, 0.2):  # albedo of the lobe that the kernel samples, by quadrature
        m, t = (node + 1) / 2, (np.arange(1024) + 0.5) / 1024 * 2 * math.pi
        a = cosine * m[:, None] + math.sqrt(1 - cosine**2) * np.sqrt(1 - m**2)[:, None] * np.cos(t)
        albedo = (2 * (weight / 2) * m * (5.0 * np.maximum(a, 0.0) ** 8).mean(1)).sum()
        assert albedo <= 1 + 1e-9
        assert (cosine < 1) == (albedo < 1 - 1e-6)


@pytest.mark.parametrize(
    "wrong", [{"gloss": -0.1}, {"gloss": 1.1}, {"shininess": -1.0}, {"shininess": np.inf}]
)
def test_lobes_that_cannot_be(wrong):
    """Shares outside 0 to 1, exponents below 0 or infinite, and surfaces that would make light."""
    with pytest.raises(ValueError, match="gloss must be 0 to 1"):
        Texture(low=0.5, high=0.5, **wrong)
    with pytest.raises(ValueError, match="gloss must be 0 to 1"):
        RigidBody(radius=1.0, low=0.5, high=0.5, cell=0.3, **wrong)
    with pytest.raises(ValueError, match="at most the incident light"):
        Texture(low=0.5, high=1.2, gloss=0.1)
    assert "gloss" not in repr(Texture(low=0.5, high=0.5, hue=0.2))
    assert "gloss=0.4, shininess=30.0" in repr(SHINY)


# -- flow ------------------------------------------------------------------------------------------


def traced_flow(engine, time, later):
    """Flow [px] from traced distances and bodies."""
    camera, hits = engine.camera_at(time), engine.first_hits(time)
    point = camera.centre + camera.rays(dtype=torch.float64).numpy() * hits.distance[..., None]
    return flow_of(
        engine.scene.bodies, point, hits.body, (camera, engine.camera_at(later)), (time, later)
    )


@pytest.mark.parametrize("name", ["tour", "demo", "baseball"])
def test_flow_is_where_bodies_go(name, device):
    """Against the recording's exact flow, forwards and backwards,
    for cameras and bodies that move; NaN for nothing.
    """
    scene, size = SCENES[name], (64, 48)
    traced = MeshEngine(scene, lambda time: scene.camera(size, time), device=device)
    sequence = record(scene, frames=8, size=size, noise=False, flow=True, engine="mesh").sequence
    for flow, start, end in ((sequence.flow.forward[0], 0, 4), (sequence.flow.backward[4], 4, 0)):
        got = traced_flow(traced, float(sequence.times[start]), float(sequence.times[end]))
        off = np.abs(got - flow).max(0) > 1e-3
        assert off.mean() < 1e-3  # a ray that grazes an outline
        assert np.abs(flow).max() > 0.5


def test_flow_in_closed_form(device):
    """A card that moves by 0.1 m sideways at 2 m moves by fx 0.1 / 2; an empty ray has none."""
    card = replace(
        plane(2.0, size=(0.5, 0.5)), path=Line(position=(0.0, 0.0, 2.0), velocity=(1.0, 0.0, 0.0))
    )
    got = traced_flow(MeshEngine(scene_of(card), lambda _: CAMERA, device=device), 0.0, 0.1)
    hit = first_hit((card,), CAMERA, 0.0).body == 0
    np.testing.assert_allclose(got[0][hit], CAMERA.fx * 0.05, atol=1e-4)
    np.testing.assert_allclose(got[1][hit], 0.0, atol=1e-4)
    assert np.isnan(got[:, ~hit]).all()
    assert (~hit).any()


def test_flow_of_a_turn_in_closed_form(device):
    """A card that turns by 90 deg/s about the optical axis takes its points around the middle of
    the image, x to y.
    """
    path = Guided(z=2.0, turns=(Turn(axis="z", angle=Curve(rate=90.0)),))
    card = replace(plane(2.0, size=(1.2, 1.2)), path=path)
    got = traced_flow(MeshEngine(scene_of(card), lambda _: CAMERA, device=device), 0.1, 0.3)
    hit = first_hit((card,), CAMERA, 0.1).body == 0
    y, x = np.mgrid[:24, :32] + 0.5
    place = (x - CAMERA.cx) + 1j * (y - CAMERA.cy)
    want = place * (np.exp(1j * math.radians(18.0)) - 1)
    assert hit.sum() > 50
    np.testing.assert_allclose((got[0] + 1j * got[1])[hit], want[hit], atol=1e-4)


def test_boxes_are_hit_alike_whichever_way(device):
    """A room from its middle, where no ball culls, and a card that most rays miss:
    the hits are the tracer's.
    """
    bodies = (
        Body(shape=Box(size=(5, 4, 7), inside=True), texture=GREY, path=Still()),
        plane(2.0, size=(0.3, 0.4), x=0.5),
    )
    hits = MeshEngine(scene_of(*bodies), lambda _: CAMERA, device=device).first_hits(0.0)
    want = first_hit(bodies, CAMERA, 0.0)
    np.testing.assert_array_equal(hits.body, want.body)
    np.testing.assert_allclose(hits.distance, want.distance, atol=2e-5)


@pytest.mark.parametrize("dc", [0.0, 1.0])
@pytest.mark.parametrize(
    ("shifts", "wanted"),
    [
        (
            (0, 1, 2, 3),
            {
                0.0: (2.407, 2.103, 2.196, 2.196, 2.053, 2.331),
                1.0: (1.700, 2.378, 1.799, 2.812, 2.005, 2.546),
            },
        ),
        (
            (0, 2, 1, 3),
            {
                0.0: (2.407, 2.103, 2.178, 2.204, 2.053, 2.331),
                1.0: (1.700, 2.378, 2.178, 2.204, 2.005, 2.546),
            },
        ),
        (
            (0, 1, 3, 2),
            {
                0.0: (2.407, 2.103, 2.196, 2.196, 2.103, 2.407),
                1.0: (1.700, 2.378, 1.799, 2.812, 1.803, 2.870),
            },
        ),
    ],
)
def test_a_sliding_edge_mixes_two_distances(shifts, wanted, dc, device):
    """T15 by rays: a card at 2.0 m leaves or comes after 1, 2 or 3 of four raw frames;
    published distances, to 1 mm.
    """
    shifts = np.array(shifts) * math.pi / 2
    far = plane(2.6, texture=Texture(low=0.074 * 2.6**2, high=0.074 * 2.6**2))
    got = []
    for frames in (1, 2, 3):
        for edge in (1.0, -1.0):
            path = Line(
                position=(edge - 3.0 / 120 * (frames - 0.5), 0.0, 2.0), velocity=(3.0, 0.0, 0.0)
            )
            card = plane(2.0, size=(2.0, 2.0), texture=Texture(low=0.6, high=0.6))
            traced = MeshEngine(
                scene_of(far, replace(card, path=path)), lambda _: AHEAD, device=device
            )
            sensor = Sensor(f_mod_hz=2e7, dc_offset=dc)
            seen = [traced.light([k / 120], sensor.f_mod_hz) for k in range(len(shifts))]
            quads = [
                mean_quad(mean.light, mean.amplitude, sensor.with_shifts((float(s),)))[0].item()
                for mean, s in zip(seen, shifts, strict=True)
            ]
            psi = np.angle(np.sum(quads * np.exp(1j * shifts))) % (2 * math.pi)
            got.append(psi / sensor.phase_slope)
    np.testing.assert_allclose(got, wanted[dc], atol=1e-3)
