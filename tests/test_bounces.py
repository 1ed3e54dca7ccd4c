"""Light that met more than one surface: a sphere and a corner in closed form, the furnace,
convergence, the beam.
"""

import cmath
import math
from functools import cache

import numpy as np
import pytest
from comparison import DEVICES

from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.render.trace import Bounces, Lamp, RigidBody, Tracer
from gftorf_warp.scene.camera import Camera
from gftorf_warp.sim.mesh_engine import rigid_bodies
from gftorf_warp.sim.paths import Still, inverse, looking_at, rigid
from gftorf_warp.sim.world import Body, Box, Plane, Texture

PLAIN = {"cell": 0.3}
HERE = np.eye(4)[None, None]


@pytest.fixture(params=DEVICES)
def device(request):
    """Every device there is."""
    return request.param


@cache
def ball_from_within(subdivisions=5):
    """An icosphere of mean radius 1, seen from its centre: vertices [m] and triangles."""
    golden = (1 + math.sqrt(5)) / 2
    signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    points = np.array(
        [v for a, b in signs for v in ((0, a, b * golden), (a, b * golden, 0), (b * golden, 0, a))],
        dtype=float,
    )
    edge = np.linalg.norm(points[:, None] - points, axis=-1) < 2.1
    numbers = range(12)
    faces = [
        (i, j, k)
        for i in numbers
        for j in numbers[i:]
        for k in numbers[j:]
        if edge[i, j] and edge[j, k] and edge[i, k]
    ]
    corners = np.array(
        [[points[n] for n in face if face.count(n) == 1] for face in faces if len({*face}) == 3]
    )
    for _ in range(subdivisions):
        a, b, c = (
            corners[:, n] / np.linalg.norm(corners[:, n], axis=-1, keepdims=True) for n in range(3)
        )
        ab, bc, ca = a + b, b + c, c + a
        corners = np.concatenate(
            [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    corners /= np.linalg.norm(corners, axis=-1, keepdims=True)
    outwards = np.einsum(
        "ti,ti->t",
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
        corners[:, 0],
    )
    corners[outwards > 0] = corners[outwards > 0][:, ::-1]
    middle = np.linalg.norm(corners.mean(1), axis=-1)
    corners /= (1 + 2 * middle.mean()) / 3  # between its vertices and the middles of its faces
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def sphere_gain(radius, reflectance, f_mod_hz, bounces):
    """T20: total over direct light at the centre of a Lambert sphere, after so many bounces."""
    k = 2 * math.pi * f_mod_hz / SPEED_OF_LIGHT
    x = 2j * k * radius
    q = reflectance * (cmath.exp(x) * (1 - x) - 1) / (2 * (k * radius) ** 2)
    return (1 - q ** (bounces + 1)) / (1 - q)


def shift_of(ratio, f_mod_hz):
    """Error of the decoded distance [m] that a complex factor makes."""
    return SPEED_OF_LIGHT / (4 * math.pi * f_mod_hz) * np.angle(ratio)


def traced_sphere(
    radius, reflectance, f_mod_hz, bounces, device="cpu", seed=0, size=(32, 24), harmonics=(1,)
):
    """Total and direct light at the centre, each pixel an independent estimate: (light, direct,
    gain of amplitude).

    Of several ``harmonics`` of the frequency, light and direct light are lists.
    """
    points, triangles = ball_from_within()
    body = RigidBody(
        points=radius * points, triangles=triangles, low=reflectance, high=reflectance, **PLAIN
    )
    tracer, camera = (
        Tracer([body], *size, harmonics=harmonics, device=device),
        Camera.from_fov(*size, 60.0),
    )
    total = tracer.light([camera], HERE, f_mod_hz, bounces=bounces, seed=seed)
    direct = tracer.light([camera], HERE, f_mod_hz)
    lights = (
        (total.light[0], direct.light[0]) if len(harmonics) == 1 else (total.light, direct.light)
    )
    return *lights, total.amplitude / direct.amplitude


@pytest.mark.parametrize(("radius", "in_mhz"), [(1.0, (20, 30, 60)), (2.0, (20, 60))])
@pytest.mark.parametrize("reflectance", [0.2, 0.5, 0.8])
def test_sphere(radius, in_mhz, reflectance, device):
    """T20: bias of a sphere's centre after 1 and 6 bounces against the closed form,
    0.1 mm plus 4 sigma.
    """
    harmonics = tuple(f_mhz // 10 for f_mhz in in_mhz)
    for count in (1, 6):
        bounces = Bounces(count=count, paths=64 if reflectance > 0.5 else 32)
        lights, directs, _ = traced_sphere(
            radius, reflectance, 1e7, bounces, device, harmonics=harmonics
        )
        for f_mhz, light, direct in zip(in_mhz, lights, directs, strict=True):
            ratio = (light / direct).astype(np.complex128)
            want = sphere_gain(radius, reflectance, f_mhz * 1e6, count)
            sigma = abs(shift_of(ratio / ratio.mean(), f_mhz * 1e6).std()) / math.sqrt(ratio.size)
            assert (
                abs(shift_of(ratio.mean(), f_mhz * 1e6) - shift_of(want, f_mhz * 1e6))
                < 1e-4 + 4 * sigma
            )
            assert sigma < 2e-3
            assert abs(abs(ratio.mean()) / abs(want) - 1) < 2e-3 + 4 * np.abs(
                ratio
            ).std() / math.sqrt(ratio.size)
    if reflectance == 0.5:
        # the notes' number
        assert shift_of(sphere_gain(1.0, 0.5, 2e7, 1), 2e7) == pytest.approx(0.216921, abs=1e-6)


@pytest.mark.slow
def test_sphere_closely():
    """T20: 0.1 mm plus 4 sigma with so many paths that 4 sigma are less than 0.8 mm,
    and the gain within 0.1 %.
    """
    light, direct, _ = traced_sphere(1.0, 0.5, 2e7, Bounces(count=6, paths=448))
    ratio, want = (light / direct).astype(np.complex128), sphere_gain(1.0, 0.5, 2e7, 6)
    sigma = abs(shift_of(ratio / ratio.mean(), 2e7).std()) / math.sqrt(ratio.size)
    assert sigma < 2e-4
    assert abs(shift_of(ratio.mean(), 2e7) - shift_of(want, 2e7)) < 1e-4 + 4 * sigma
    assert abs(abs(ratio.mean()) / abs(want) - 1) < 1e-3


def test_furnace(device):
    """T21: without phases a sphere gains sum rho^k up to the number of bounces, within 0.1 %."""
    for count in (1, 3, 6):
        gain = traced_sphere(1.0, 0.5, 2e7, Bounces(count=count, paths=16), device)[2].mean()
        assert gain == pytest.approx(sum(0.5**k for k in range(count + 1)), rel=1e-3)


CORNER = {  # z [m]: bias [mm] at 20, 30 and 100 MHz, indirect over direct DC, gain at 20 MHz
    0.05: (52.409, 50.114, 39.118, 0.78670, 1.7749),
    0.10: (88.430, 84.135, 63.088, 0.74366, 1.7214),
    0.25: (156.647, 146.914, 91.952, 0.59053, 1.5425),
    0.50: (189.118, 169.778, 33.674, 0.37044, 1.2959),
    1.00: (117.304, 85.284, -14.857, 0.13005, 1.0584),
    2.00: (24.071, 7.290, 2.054, 0.02473, 0.9953),
}


@pytest.mark.parametrize(
    ("z", "paths"),
    [
        *((z, 100) for z in CORNER),
        *(pytest.param(z, 1000, marks=pytest.mark.slow) for z in (0.5, 2.0)),
    ],
)
def test_corner(z, paths, device):
    """T19: one bounce in a corner of two walls: bias at three frequencies within 0.5 %, DC 0.3 %,
    plus 4 sigma.
    """
    far = 400.0
    # x = 0, seen from +x
    wall = np.array([[0, -far, 0], [0, far, 0], [0, far, far], [0, -far, far]])
    # z = 0, seen from +z
    floor = np.array([[0, -far, 0], [far, -far, 0], [far, far, 0], [0, far, 0]])
    square = np.array([[0, 1, 2], [0, 2, 3]])
    bodies = [
        RigidBody(points=points, triangles=square, low=0.8, high=0.8, **PLAIN)
        for points in (wall, floor)
    ]
    pose = inverse(looking_at(np.array([1.0, 0.0, 2.0]), np.array([0.0, 0.0, z])))
    camera = Camera.from_fov(64, 64, 0.02, camera_from_world=pose)
    tracer = Tracer(bodies, 64, 64, harmonics=(2, 3, 10), device=device)
    poses = np.broadcast_to(np.eye(4), (1, 2, 4, 4))
    *biases, dc, gain = CORNER[z]
    got = tracer.light([camera], poses, 1e7, bounces=Bounces(count=1, paths=paths))
    indirect = got.amplitude.astype(np.float64) / got.direct_amplitude - 1
    assert indirect.mean() == pytest.approx(dc, abs=0.003 * dc + 4 * indirect.std() / 64)
    for h, (f_mod_hz, bias_mm) in enumerate(zip((2e7, 3e7, 1e8), biases, strict=True)):
        ratio = (got.light[h] / got.direct[h]).astype(np.complex128)
        sigma = shift_of(ratio / ratio.mean(), f_mod_hz).std() / 64
        assert 1e3 * shift_of(ratio.mean(), f_mod_hz) == pytest.approx(
            bias_mm, abs=0.005 * abs(bias_mm) + 4e3 * sigma
        )
        assert sigma < 1e-3
        if f_mod_hz == 2e7:
            assert (
                np.abs(got.direct_amplitude / (0.8 / math.hypot(1.0, 2.0 - z) ** 3) - 1).max()
                < 2e-3
            )
            assert abs(ratio.mean()) == pytest.approx(
                gain, abs=3e-3 * gain + 4 * np.abs(ratio).std() / 64
            )


def test_room(device):
    """A closed room of reflectance 0.5, beam 74.4 x 59.3 deg, 6 bounces: 130 and 69 mm at two rays,
    within 3 mm.

    The numbers are of the sensor notes, from a random walk that shares no code with this one.
    """
    size, middle = (4.0, 2.4, 4.4), (0.0, -0.2, 1.7)
    shape = Box(size=size, inside=True)
    (body,) = rigid_bodies(Body(shape=shape, texture=Texture(low=0.5, high=0.5), path=Still()))
    pose = rigid(np.eye(3), np.array(middle))[None, None]
    tracer, n = Tracer([body], 48, 48, device=device), 48
    for (x, y), want in (((0.0, 0.0), 0.130), ((0.5, 0.25), 0.069)):
        camera = Camera(width=n, height=n, fx=1e5, fy=1e5, cx=n / 2 - 1e5 * x, cy=n / 2 - 1e5 * y)
        lamp = Lamp(beam_deg=(74.4, 59.3))
        direct = tracer.light([camera], pose, 2e7, lamp=lamp).light[0]
        total = tracer.light(
            [camera], pose, 2e7, lamp=lamp, bounces=Bounces(count=6, paths=64)
        ).light[0]
        assert shift_of((total / direct).mean(), 2e7) == pytest.approx(want, abs=3e-3)


def test_what_the_light_does_not_reach_returns_none(device):
    """A wall behind a card lights the side wall only if the card is taken away:
    the light is asked at every bounce.
    """
    # faces -x
    side = (Plane(size=(2.0, 2.0)), Still(position=(3.0, 0.0, 2.0), turn_deg=(0.0, 90.0, 0.0)))
    back = (Plane(size=(2.0, 2.0)), Still(position=(0.0, 0.0, 3.0)))
    card = (Plane(size=(2.0, 2.0)), Still(position=(0.0, 0.0, 1.0)))
    # looks at the middle of the side wall
    camera = Camera(width=8, height=8, fx=1e3, fy=1e3, cx=4 - 1.5e3, cy=4)
    added = []
    for parts in ((side, back), (side, back, card)):
        bodies = [
            Body(shape=shape, texture=Texture(low=0.5, high=0.5), path=path)
            for shape, path in parts
        ]
        poses = np.stack([body.path.world_from_body(0.0) for body in bodies])[None]
        tracer = Tracer(
            [piece for body in bodies for piece in rigid_bodies(body)], 8, 8, device=device
        )
        direct = tracer.light([camera], poses, 2e7).amplitude
        assert (direct > 0).all()
        added.append(
            tracer.light([camera], poses, 2e7, bounces=Bounces(count=1, paths=200)).amplitude
            - direct
        )
    assert added[0].mean() > 1e-4
    assert (added[1] == 0).all()


def test_spread_falls_with_the_root_of_the_number_of_paths(device):
    """T30: the error falls as paths^-0.5, slope within 0.05; the complex mean is unbiased,
    4 sigma.
    """
    counts = (2, 8, 32, 128)
    lights = [
        traced_sphere(1.0, 0.5, 2e7, Bounces(count=2, paths=n), device, seed=n)[0].astype(
            np.complex128
        )
        for n in counts
    ]
    slope = np.polyfit(np.log(counts), np.log([light.std() for light in lights]), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.05)
    direct = traced_sphere(1.0, 0.5, 2e7, Bounces(), device)[1].astype(np.complex128).mean()
    for light in lights:
        sigma = light.std() / math.sqrt(light.size)
        assert abs(light.mean() / direct - sphere_gain(1.0, 0.5, 2e7, 2)) < 1e-3 + 4 * sigma / abs(
            direct
        )


def test_bias_of_depth_is_of_second_order(device):
    """T30: the mean of decoded distances is off by terms of second order:
    4 times less with 4 times the paths.
    """

    def bias_of(paths):
        many = [
            traced_sphere(
                1.0, 0.8, 2e7, Bounces(count=2, paths=paths), device, seed=s, size=(96, 72)
            )[0]
            for s in range(3)
        ]
        light = np.stack(many).astype(np.complex128)
        turned = light / light.mean()
        second = -(turned.imag * (turned.real - 1)).mean()  # arg(1 + z) = Im z - Re z Im z + ...
        return np.angle(turned).mean(), second, np.angle(turned).std() / math.sqrt(turned.size)

    found = [bias_of(paths) for paths in (1, 4)]
    for bias, second, sigma in found:
        assert bias == pytest.approx(second, abs=0.15 * abs(second) + 4 * sigma)
    assert found[0][1] / found[1][1] == pytest.approx(4.0, rel=0.1)


def test_paths_belong_to_the_seed(device):
    """The same seed gives the same paths, another one others, and no bounce is direct light."""
    one, again, other, none = (
        traced_sphere(1.0, 0.5, 2e7, Bounces(count=n, paths=4), device, seed=s)
        for n, s in ((2, 1), (2, 1), (2, 2), (0, 1))
    )
    np.testing.assert_array_equal(one[0], again[0])
    assert (one[0] != other[0]).all()
    assert (
        abs(np.corrcoef(np.abs(one[0] - one[1]).ravel(), np.abs(other[0] - one[1]).ravel())[0, 1])
        < 0.15
    )
    np.testing.assert_array_equal(none[0], none[1])


def test_a_beam_lights_what_it_hits_only(device):
    """A beam of 20 x 10 deg is a rectangle on a wall; in a sphere, light that bounced once falls to
    its share.

    That is 4 asin(sin(h/2) sin(v/2)) / 4 pi, since chords of a sphere end evenly on it, wherever
    they start.
    """
    wall = np.array([[-9.0, -9, 3], [9, -9, 3], [9, 9, 3], [-9, 9, 3]])
    body = RigidBody(
        points=wall, triangles=np.array([[0, 2, 1], [0, 3, 2]]), low=0.5, high=0.5, **PLAIN
    )
    camera, lamp = Camera.from_fov(96, 72, 60.0), Lamp(beam_deg=(20.0, 10.0))
    lit = Tracer([body], 96, 72, device=device).light([camera], HERE, 2e7, lamp=lamp).amplitude > 0
    x, y = (np.abs(np.arange(n) + 0.5 - n / 2) / camera.fx for n in (96, 72))
    np.testing.assert_array_equal(
        lit, (y < math.tan(math.radians(5)))[:, None] & (x < math.tan(math.radians(10)))
    )
    points, triangles = ball_from_within()
    body = RigidBody(points=points, triangles=triangles, low=0.5, high=0.5, **PLAIN)
    tracer, narrow = Tracer([body], 32, 24, device=device), Camera.from_fov(32, 24, 60.0)
    bounces = Bounces(count=1, paths=256)
    wide, beam = (
        tracer.light([narrow], HERE, 2e7, bounces=bounces, lamp=lamp).amplitude
        - tracer.light([narrow], HERE, 2e7, lamp=lamp).amplitude
        for lamp in (Lamp(), Lamp(beam_deg=(60.0, 60.0)))
    )
    share = 4 * math.asin(0.5 * 0.5) / (4 * math.pi)
    ratio = beam.astype(np.float64) / wide.mean()
    assert ratio.mean() == pytest.approx(share, abs=4 * ratio.std() / math.sqrt(ratio.size))


def test_settings_that_cannot_be():
    """Angles of a beam, numbers of bounces and of paths are checked where they are made."""
    for beam in ((0.0, 10.0), (10.0, 180.0)):
        with pytest.raises(ValueError, match="between 0 and 180"):
            Lamp(beam_deg=beam)
    for wrong in ({"count": -1}, {"paths": 0}):
        with pytest.raises(ValueError, match="at least 1"):
            Bounces(**wrong)
