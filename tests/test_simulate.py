"""Recording a scene: what each raw frame shows and when, its truth, its files,
and what is refused.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from sequences import values_of

from gftorf_warp import Sequence
from gftorf_warp.errors import UsageError
from gftorf_warp.scene.sensor import Sensor, distance_from_phasor, phasor_from_quads
from gftorf_warp.sim.bodies import room
from gftorf_warp.sim.paths import Line
from gftorf_warp.sim.record import record, still_interior
from gftorf_warp.sim.scenes import OURS, SCENES, Scene
from gftorf_warp.sim.simulate import simulate
from gftorf_warp.sim.world import Body, Box, Texture, first_hit

SMALL = (48, 36)
MIDDLE = (96, 72)


def slider(**more):
    """A plain box that slides fast in front of the room,
    with another sensor or whatever else is given.
    """
    box = Body(
        shape=Box(size=(0.9, 0.9, 0.9)),
        texture=Texture(low=0.8, high=0.8),
        path=Line(position=(-0.2, 0.0, 2.5), velocity=(6.0, 0.0, 0.0)),
    )
    settings = {
        "name": "slider",
        "description": "a plain box slides",
        "motion": "sliding",
        "bodies": (room(), box),
        "frames": 8,
        "width": 48,
        "height": 36,
        "sensor": Sensor(noise=True),
    }
    return Scene(**{**settings, **more})


def closed_form(sequence):
    """Distance [m] decoded from each complete quartet."""
    quartets = sequence.frames // 4
    quads = torch.from_numpy(sequence.quads[: 4 * quartets].astype(np.float64)).unflatten(
        0, (quartets, 4)
    )
    sensor = Sensor(
        f_mod_hz=sequence.calibration.f_mod_hz, phase_offset=sequence.calibration.phase_offset
    )
    return np.stack(
        [
            distance_from_phasor(*phasor_from_quads(q, tuple(sequence.shifts[:4])), sensor)
            for q in quads
        ]
    )


def errors(recording):
    """MSE x 100 [m^2] of the closed form on moving and on static pixels of every raw frame,
    and the moving share.
    """
    truth = recording.truth.distance
    truth = truth[: len(truth) // 4 * 4].reshape(-1, 4, *truth.shape[1:])
    squares = 100 * (closed_form(recording.sequence)[:, None] - truth) ** 2
    moving = np.broadcast_to((np.ptp(truth, axis=1) > 0.05)[:, None], squares.shape)
    return (
        (squares[moving].mean() if moving.any() else None),
        squares[~moving].mean(),
        moving.mean(),
    )


def inside(hit, body, pixels=2):
    """Pixels whose neighbourhood shows one face of one texture cell of ``body``."""
    key = np.where(hit.body == body, hit.face + 10 * hit.reflectance, np.nan)
    mask = np.isfinite(key)
    for dy in range(-pixels, pixels + 1):
        for dx in range(-pixels, pixels + 1):
            mask &= np.roll(key, (dy, dx), (0, 1)) == key
    return mask


def contents(folder):
    """Every file of a folder by relative name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


# -- what is recorded ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(make.__name__ for make in OURS))
def test_rendered_and_true_distance_agree_on_still_surfaces(name):
    """Within 1 cm on every interior pixel of every scene of ours at its own size:
    the worlds are the same.
    """
    gap = record(SCENES[name], frames=2, noise=False).gap
    assert gap.pixels > 1000
    assert gap.max <= 0.01
    assert 0 < gap.mean < 0.003


def test_any_size_and_length_will_do():
    """One pixel, one raw frame; there is no interior to compare then."""
    recording = record(SCENES["demo"], size=(1, 1), frames=1)
    assert recording.sequence.quads.shape == (1, 1, 1)
    assert recording.gap is None
    assert record(SCENES["demo"], size=(9, 7), frames=5).truth.distance.shape == (5, 7, 9)


def test_interior_pixels_keep_away_from_edges_and_motion():
    """Wherever they are, 5x5 neighbours see one face of something still, in all raw frames."""
    scene = slider()
    hits = [first_hit(scene.bodies, scene.camera(), t) for t in (0.0, 0.05)]
    mask = still_interior(scene, hits)
    assert 0.2 < mask.mean() < 0.8
    for y, x in np.argwhere(mask)[::17]:
        for hit in hits:
            window = np.s_[y - 2 : y + 3, x - 2 : x + 3]
            assert len({*zip(hit.body[window].flat, hit.face[window].flat, strict=True)}) == 1
            assert hit.body[y, x] == 0


@pytest.mark.parametrize("sync", [False, True])
def test_every_raw_frame_shows_its_own_instant(sync):
    """Frame n is a (cos(kappa d - shift_n) + b) of what stands there at its time,
    on the moving box and on the wall.
    """
    sensor = Sensor(
        shifts=(math.pi, math.pi / 2, 0.0, 3 * math.pi / 2), phase_offset=0.4, dc_offset=0.2
    )
    scene = slider(sensor=sensor)
    recording = record(scene, frames=6, size=MIDDLE, sync=sync)
    sequence, camera = recording.sequence, scene.camera(MIDDLE)
    times = [0, 0, 0, 0, 4, 4] if sync else [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(sequence.times * 120, times, atol=1e-12)
    np.testing.assert_allclose(sequence.shifts, [sensor.shifts[n % 4] for n in range(6)])
    for n, time in enumerate(sequence.times):
        hit = first_hit(scene.bodies, camera, float(time))
        np.testing.assert_allclose(recording.truth.distance[n], hit.distance, rtol=1e-6)
        want = hit.amplitude * (
            np.cos(hit.distance * sensor.phase_slope + 0.4 - sensor.shifts[n % 4]) + 0.2
        )
        for body, bound in ((0, 0.15), (1, 0.08)):
            mask = inside(hit, body)
            assert mask.sum() > 20
            error = np.abs(sequence.quads[n] - want)[mask] / hit.amplitude[mask]
            assert np.quantile(error, 0.9) < bound
    moved = (
        first_hit(scene.bodies, camera, 0.0).body != first_hit(scene.bodies, camera, 3 / 120).body
    )
    assert moved.sum() > 100, "nothing moved, so any time would have passed"


def test_asynchrony_is_what_breaks_the_closed_form():
    """At one instant a quartet decodes to the truth except at outlines;
    one frame after the other it does not.
    """
    scene = SCENES["demo"]
    moving, static, share = errors(record(scene, frames=8))
    none, outlines, still = errors(record(scene, frames=8, sync=True))
    assert none is None
    assert still == 0
    assert moving > 20
    assert outlines < 2
    assert static < outlines
    assert share > 0.03


def test_the_demo_is_neither_easy_nor_hopeless():
    """Closed-form error, share of moving pixels and speed are in the range for which the demo
    promises its factor.
    """
    recording = record(SCENES["demo"], flow=True)
    moving, static, share = errors(recording)
    assert moving > 20
    assert static < 1.5
    assert 0.03 < share < 0.11
    assert recording.sequence.frames >= 40
    assert recording.sequence.quads.shape[1:] >= (72, 96)
    speed = (
        np.stack([np.linalg.norm(f, axis=0) for f in recording.sequence.flow.forward.values()]) / 4
    )
    assert 1.0 < speed[speed > 0.01].mean() < 3.0
    assert recording.saturated == 0
    assert recording.gap.max <= 0.01


@pytest.mark.parametrize("name", sorted(make.__name__ for make in OURS))
def test_named_scenes_stay_in_range(name):
    """Nothing wraps, nothing is missing, something moves, and the name is its own."""
    scene = SCENES[name]
    assert scene.name == name
    assert scene.motion in (
        "sliding",
        "axial",
        "arc",
        "sideways and in depth",
        "camera and ball on arcs",
    )
    times = [n / 120 for n in (0, scene.frames // 2, scene.frames - 1)]
    hits = [first_hit(scene.bodies, scene.camera(SMALL, time), time) for time in times]
    distances = np.stack([hit.distance for hit in hits])
    assert np.isfinite(distances).all()
    assert distances.min() > 0.8
    assert distances.max() < 0.8 * scene.sensor.unambiguous_range
    moving = [index for index, body in enumerate(scene.bodies) if body.moves]
    for hit in hits:
        assert np.isin(hit.body, moving).mean() > 0.03
        assert set(np.unique(hit.body)) == set(range(len(scene.bodies))), (
            "something is hidden or out of view"
        )


def test_exact_flow_follows_the_motion():
    """A face at depth z that slides by v dt moves by f v dt / z pixels, and back;
    the room does not move.
    """
    scene = slider(frames=12)
    sequence = record(scene, flow=True, noise=False).sequence
    assert sorted(sequence.flow.forward) == [0, 4]
    assert sorted(sequence.flow.backward) == [4, 8]
    hit = first_hit(scene.bodies, scene.camera(), 4 / 120)
    front = (hit.body == 1) & (hit.face == 4)
    want = scene.camera().fx * 6.0 * (4 / 120) / (2.5 - 0.45)
    np.testing.assert_allclose(sequence.flow.forward[4][0][front], want, rtol=1e-4)
    np.testing.assert_allclose(sequence.flow.backward[4][0][front], -want, rtol=1e-4)
    np.testing.assert_allclose(sequence.flow.forward[4][1][front], 0, atol=1e-4)
    assert (sequence.flow.forward[4][:, hit.body == 0] == 0).all()
    assert front.sum() > 100


def test_exposure_is_an_average_over_its_instants():
    """Two instants: the mean of recordings a quarter of the exposure earlier and later."""
    sensor = Sensor(exposure_s=6e-3)
    scene = slider(sensor=sensor, frames=4)
    blurred = record(scene, exposure_samples=2, noise=False).sequence.quads
    shifted = []
    for offset in (-1.5e-3, 1.5e-3):
        box = scene.bodies[1]
        path = dataclasses.replace(box.path, passing_s=-offset)
        moved = dataclasses.replace(
            scene, bodies=(scene.bodies[0], dataclasses.replace(box, path=path))
        )
        shifted.append(record(moved, noise=False).sequence.quads)
    scale = np.abs(blurred).max()
    np.testing.assert_allclose(blurred, np.mean(shifted, axis=0), atol=0.01 * scale)
    assert np.abs(blurred - record(scene, noise=False).sequence.quads).max() > 0.05 * scale


def test_noise_belongs_to_the_seed_and_the_frame():
    """The same seed and frame give the same noise whatever the number of frames;
    another seed another, of mean zero.
    """
    scene = slider()
    clean = record(scene, frames=4, noise=False).sequence.quads
    first, longer, other = (
        record(scene, frames=n, seed=s).sequence.quads for n, s in ((4, 1), (8, 1), (4, 2))
    )
    np.testing.assert_array_equal(first, longer[:4])
    assert (first != other).mean() > 0.9
    noise = first - clean
    assert noise.std() > 1e-4
    assert abs(noise.mean()) < 4 * noise.std() / math.sqrt(noise.size)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 4 / math.sqrt(noise[0].size)
    assert abs(np.corrcoef(noise.ravel(), (other - clean).ravel())[0, 1]) < 4 / math.sqrt(
        noise.size
    )


def test_noise_has_the_strength_of_the_light():
    """On still surfaces the variance of a quad is (N_s + 2 (N_dark + s_r^2) + e^2/12) / (C G)^2,
    N_s analytic.
    """
    sensor = Sensor(
        noise=True,
        electrons_per_unit=3e6,
        full_well_electrons=1e9,
        read_noise_electrons=20.0,
        adc_bits=16,
    )
    scene = slider(sensor=sensor, frames=40, bodies=(room(),), width=64)
    clean = record(scene, noise=False, frames=4).sequence.quads  # the same in every quartet
    noise = record(scene).sequence.quads - np.tile(clean, (10, 1, 1))
    hit = first_hit(scene.bodies, scene.camera(), 0.0)
    gain = 3e6
    electrons = (
        hit.amplitude * gain
        + 2 * (sensor.dark_electrons_per_s * sensor.exposure_s + 20.0**2)
        + 32**2 / 12
    )
    expected = np.sqrt(electrons) / (sensor.contrast * gain)
    mask = inside(hit, 0, pixels=1)
    assert mask.sum() > 100
    assert (noise / expected)[:, mask].std() == pytest.approx(1.0, abs=0.03)


def test_saturation_is_reported():
    """Ten times the light fills the wells on the near box."""
    bright = slider(sensor=Sensor(noise=True, electrons_per_unit=3e6), frames=1)
    assert 0.05 < record(bright).saturated < 1
    assert record(bright, noise=False).saturated == 0


# -- what is written -------------------------------------------------------------------------------


def test_a_sequence_is_read_back_as_recorded(tmp_path):
    """A sensor in the order of real recordings with offsets: quads, shifts, times, calibration,
    truth, flow.
    """
    sensor = Sensor(
        shifts=(math.pi, math.pi / 2, 0.0, 3 * math.pi / 2),
        phase_offset=0.3,
        dc_offset=1.0,
        unipolar=True,
        noise=True,
    )
    scene = slider(sensor=sensor, frames=7)
    path = simulate(scene, tmp_path / "deep" / "seq", seed=4, flow=True)
    assert path == tmp_path / "deep" / "seq"
    got, want = Sequence.open(path), record(scene, seed=4, flow=True)
    for name in ("quads", "measured", "shifts", "times", "camera_from_world"):
        np.testing.assert_allclose(
            getattr(got, name), getattr(want.sequence, name), atol=1e-9, err_msg=name
        )
    for name in ("f_mod_hz", "phase_offset", "dc_offset", "fx", "fy", "cx", "cy"):
        assert values_of(got)[name] == pytest.approx(values_of(want.sequence)[name]), name
    np.testing.assert_array_equal(got.truth().distance, want.truth.distance)
    assert got.truth().known.all()
    np.testing.assert_array_equal(got.flow.forward[0], want.sequence.flow.forward[0])
    assert got.complete_quartets == [0]
    hit = first_hit(scene.bodies, scene.camera(), 0.0)
    wall = inside(hit, 0) & ~(first_hit(scene.bodies, scene.camera(), 4 / 120).body == 1)
    clean = record(scene, noise=False, sync=True).sequence
    np.testing.assert_allclose(closed_form(clean)[0][wall], hit.distance[wall], atol=0.03)


def test_the_same_seed_writes_the_same_bytes(tmp_path):
    """T33: another seed changes the quads, their picture and the card that names it,
    nothing else.
    """
    scene = slider(frames=5)
    folders = [simulate(scene, tmp_path / str(k), seed=seed) for k, seed in enumerate((7, 7, 8))]
    first, same, other = (contents(folder) for folder in folders)
    assert first == same
    assert first.keys() == other.keys()
    differ = {name for name in first if first[name] != other[name]}
    assert differ == {name for name in first if name.startswith("tofType")} | {
        "README.md",
        "contact_sheet.png",
    }


def test_the_card_says_how_to_make_it_again(tmp_path):
    """Scene, command, sensor, and how far rendering and truth are apart;
    a scene of one's own has no command.
    """
    path = simulate("demo", tmp_path / "seq", frames=2, size=SMALL, seed=3, noise=False)
    card = (path / "README.md").read_text()
    assert "gftorf simulate demo --out SEQ --frames 2 --size 48x36 --seed 3 --no-noise" in card
    assert "19.9861639 MHz" in card
    assert f"{record(SCENES['demo'], frames=2, size=SMALL, noise=False).gap}" in card
    assert str(tmp_path) not in card
    own = simulate(slider(), tmp_path / "own", frames=2, sync=True)
    assert "gftorf simulate slider" not in (own / "README.md").read_text()


def test_a_finished_sequence_is_not_made_again(tmp_path):
    """The same settings leave it alone, others are refused, ``fresh`` moves it aside."""
    calls = []

    def make(seed, **more):
        return simulate(
            slider(frames=2),
            tmp_path / "seq",
            seed=seed,
            progress=lambda *n: calls.append(n),
            **more,
        )

    make(0)
    assert calls == [(1, 2), (2, 2)]
    before = contents(tmp_path / "seq")
    make(0)
    assert len(calls) == 2
    with pytest.raises(UsageError, match=r"--fresh"):
        make(1)
    assert contents(tmp_path / "seq") == before
    make(1, fresh=True)
    make(1, fresh=True)
    assert contents(tmp_path / "seq-old-1") == before
    assert contents(tmp_path / "seq-old-2") == contents(tmp_path / "seq") != before


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"scene": "slidin"},
            ("slidin", "did you mean sliding", "demo, sliding, axial, arc, tour"),
        ),
        ({"scene": "xyzzy"}, ("xyzzy", "take one of these")),
        ({"frames": 0}, ("--frames", "at least 1")),
        ({"frames": -4}, ("--frames", "-4")),
        ({"size": (0, 4)}, ("--size", "0x4", "WIDTHxHEIGHT")),
        ({"size": (4, -1)}, ("--size",)),
        (
            {"scene": "axial", "frames": 400},
            ("--frames", "nearer to the camera", "simulate at most "),
        ),
        ({"seed": -1}, ("--seed", "0 or more")),
        ({"exposure_samples": 0}, ("--exposure-samples",)),
        ({"format": "zip"}, ("--format", "zip", "ftorf", "capture")),
        (
            {"scene": slider(sensor=Sensor(shifts=(0.0, 2.0, 4.0)))},
            ("F-ToeRF", "sensor.shifts", "four shifts"),
        ),
        ({"scene": slider(sensor=Sensor(shifts=(0.0, 1.0, 2.0, 3.0)))}, ("sensor.shifts",)),
        (
            {"scene": slider(sensor=Sensor(noise=True, contrast=0.9, dc_offset=0.5))},
            ("dc_offset", "negative light"),
        ),
    ],
    ids=lambda value: (
        str(value)[:40] if isinstance(value, dict) and "sensor" not in str(value) else None
    ),
)
def test_what_cannot_be_meant_is_refused(tmp_path, options, words):
    """A named error with the option, what was expected and what was found; nothing is written."""
    options = {"scene": "demo", "size": SMALL, "frames": 4} | options
    with pytest.raises(UsageError) as caught:
        simulate(options.pop("scene"), tmp_path / "seq", **options)
    for word in words:
        assert word in str(caught.value)
    assert not any(tmp_path.iterdir())


def test_nothing_is_overwritten(tmp_path):
    """Neither a file nor a folder with something in it;
    what is no sequence is not even moved aside.
    """
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").write_text("mine")
    for name in ("file", "folder"):
        for fresh in (False, True):
            with pytest.raises(UsageError, match=r"choose another --out"):
                simulate("demo", tmp_path / name, frames=1, size=SMALL, fresh=fresh)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder", "mine"]
    (tmp_path / "empty").mkdir()
    assert simulate("demo", tmp_path / "empty", frames=1, size=SMALL) == tmp_path / "empty"
