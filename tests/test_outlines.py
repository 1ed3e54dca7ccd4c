"""Mixed pixels at outlines: images whose pixels average two surfaces by area, as a sensor does."""

import math

import numpy as np
import pytest
import torch
from moving_box import recording
from small_runs import demo

from gftorf_warp import simulate
from gftorf_warp.constants import FRAME_RATE_HZ
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.write import write
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon import fallback, outlines
from gftorf_warp.recon.phasors import CLOSED_FORM, Phasor
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.api import Rendering
from gftorf_warp.scene.measured import extremes
from gftorf_warp.scene.sensor import Sensor

HEIGHT, WIDTH, RAYS = 24, 32, 16
SENSOR = Sensor(phase_offset=0.4)


def scene(inside, near, far, bright=(0.9, 0.5)):
    """Distance at the centres of the pixels [m], and the mean phasor of their areas.

    Args:
        inside: Whether positions (x, y) [px] are on the near surface.
        near: Its distance [m].
        far: Distance of the other one [m].
        bright: Reflectivities of both.
    """
    at = (np.arange(HEIGHT * RAYS) + 0.5) / RAYS, (np.arange(WIDTH * RAYS) + 0.5) / RAYS
    y, x = np.meshgrid(*at, indexing="ij")
    front = inside(x, y)
    distance = np.where(front, near, far)
    amplitude = np.where(front, *bright) / distance**2
    phasor = amplitude * np.exp(1j * (SENSOR.phase_slope * distance + SENSOR.phase_offset))
    mean = phasor.reshape(HEIGHT, RAYS, WIDTH, RAYS).mean(axis=(1, 3))
    y, x = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    return np.where(inside(x, y), near, far), mean


def decoded(phasor):
    """Distance of a phasor [m], in [0, range)."""
    phase = np.mod(np.angle(phasor) - SENSOR.phase_offset, 2.0 * math.pi)
    return phase / SENSOR.phase_slope


def resolved(distance, phasor, source=None, **more):
    """Distance and source after resolving the outlines of a rendering."""
    none, flat = torch.zeros(0, *distance.shape), torch.zeros(0, distance.shape[1])
    images = torch.tensor(np.stack([phasor.real, phasor.imag, abs(phasor)]), dtype=torch.float32)
    rendering = Rendering(
        quads=none,
        phasor=images,
        colour=None,
        distance=torch.tensor(distance, dtype=torch.float32),
        opacity=flat,
        distortion=flat,
        distance_median=flat,
        extra=None,
        screen=None,
        source=source,
    )
    given = outlines.resolved(rendering, SENSOR, **more)
    return given.distance.numpy(), given.source.numpy()


SHAPES = {
    "edge": lambda x, y: x < 13.27 + 0.1 * y,
    "disc": lambda x, y: np.hypot(x - 15.3, y - 11.6) < 7.4,
    "stick": lambda x, y: abs(x - 12.1 - 0.7 * y) < 3.3,
}
DISTANCES = {"near": (2.0, 2.6), "opposite": (1.5, 5.4), "beyond_half": (1.0, 6.8)}  # [m]


@pytest.mark.parametrize("distances", DISTANCES.values(), ids=DISTANCES)
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_mixed_pixels_have_the_distance_at_their_centre(shape, distances):
    """The mean squared error of what the phasor decodes to falls to a third or less, and no
    pixel away from the outline changes.
    """
    truth, phasor = scene(shape, *distances)
    before = decoded(phasor)
    after, source = resolved(before, phasor)
    mixed = abs(before - truth) > 1e-3
    assert mixed.sum() > 20
    assert np.mean((after - truth) ** 2) < 0.36 * np.mean((before - truth) ** 2)
    sides = abs(after - truth) < 0.25 * (distances[1] - distances[0])
    assert sides[mixed].mean() > 0.55
    beside = np.stack([np.roll(mixed, shift, axis) for shift in (-1, 1) for axis in (0, 1)])
    away = ~(mixed | beside.any(axis=0))
    np.testing.assert_allclose(after[away], truth[away], atol=0.03 * (distances[1] - distances[0]))
    assert set(np.unique(source)) == {0, outlines.OUTLINE}
    assert (source == outlines.OUTLINE)[mixed].mean() > 0.9


def test_a_mixed_pixel_may_have_a_mixed_neighbour():
    """Of a stick that is two pixels wide, both edges are mixed, and none of its pixels may be pure.
    With neighbours that agree within a quarter of the step more than half of the error stays.
    """
    truth, phasor = scene(lambda x, y: abs(x - 12.1 - 0.3 * y) < 1.0, 2.0, 2.6)
    before = decoded(phasor)
    after, _ = resolved(before, phasor)
    assert np.mean((after - truth) ** 2) < 0.35 * np.mean((before - truth) ** 2)


@pytest.mark.parametrize("slope", [0.08, 0.15, 0.3])
def test_on_a_slope_a_distance_is_within_what_both_sides_continue_to(slope):
    """Errors of a rendering whose phasor is right fall to a third, and no distance leaves the
    surroundings that it had.
    """
    columns = np.arange(WIDTH)[None].repeat(HEIGHT, axis=0)
    truth = 2.0 + slope * columns  # [m]
    phasor = 0.5 / truth**2 * np.exp(1j * (SENSOR.phase_slope * truth + SENSOR.phase_offset))
    before = truth + np.random.default_rng(0).normal(0.0, 0.02, truth.shape)
    after, _ = resolved(before, phasor)
    assert np.mean((after - truth) ** 2) < 0.33 * np.mean((before - truth) ** 2)
    low, high = extremes(torch.tensor(before, dtype=torch.float32))
    assert (after >= low.numpy() - 1e-5).all()
    assert (after <= high.numpy() + 1e-5).all()


def test_the_closed_form_of_a_moving_camera_is_resolved_too():
    """Its distance is first what the phasor of the run decodes to, here without the noise of the
    measurement; of a camera at rest the closed form stays.
    """
    truth, phasor = scene(SHAPES["disc"], 2.0, 5.0)
    noise = np.random.default_rng(0).normal(0.0, 0.05, truth.shape)
    before = decoded(phasor) + noise
    source = torch.full(truth.shape, CLOSED_FORM, dtype=torch.uint8)
    stays, same = resolved(before, phasor, source)
    np.testing.assert_allclose(stays, before, rtol=1e-6)
    assert torch.equal(torch.tensor(same), source)
    after, marked = resolved(before, phasor, source, camera_moves=True)
    mixed = abs(decoded(phasor) - truth) > 1e-3
    # half of the change leaves a quarter of the squared error where it is right
    assert np.mean((after - truth)[mixed] ** 2) < 0.4 * np.mean((before - truth)[mixed] ** 2)
    assert (marked == outlines.OUTLINE)[mixed].mean() > 0.9
    away = ~mixed & (marked == CLOSED_FORM)
    assert away.mean() > 0.7
    np.testing.assert_allclose(after[away], truth[away], atol=2e-3)


@pytest.mark.parametrize("apart", [0.0, 100.0, -100.0])
def test_a_closed_form_is_averaged_with_the_fit_within_what_is_around(apart):
    """A quarter is the fit's, however far [m] that is from the truth; sources stay."""
    truth, phasor = scene(SHAPES["disc"], 2.0, 5.0)
    source = torch.full(truth.shape, CLOSED_FORM, dtype=torch.uint8)
    alone, sources = resolved(decoded(phasor), phasor, source, camera_moves=True)
    fitted = torch.tensor(truth + apart, dtype=torch.float32)
    given, same = resolved(decoded(phasor), phasor, source, camera_moves=True, fitted=fitted)
    around = np.pad(alone, 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(around, (3, 3))
    within = np.clip(fitted.numpy(), windows.min(axis=(2, 3)), windows.max(axis=(2, 3)))
    np.testing.assert_allclose(given, 0.75 * alone + 0.25 * within, rtol=1e-6)
    np.testing.assert_array_equal(same, sources)
    assert (abs(given - alone) > 0.1).any()


def test_a_phasor_decodes_to_the_turn_nearest_to_a_distance():
    """Whole ranges of the frequency away, and never behind the camera."""
    reach = 2.0 * math.pi / SENSOR.phase_slope
    near = torch.tensor([[1.0, 1.2 + reach, 0.9 + 2.0 * reach, reach - 0.01]])
    value = torch.polar(torch.ones(1, 4), SENSOR.phase_slope * torch.ones(1, 4) + 0.4)
    value[0, 3] = torch.polar(torch.tensor(1.0), torch.tensor(SENSOR.phase_slope * 0.02 + 0.4))
    zero = torch.zeros(1, 4)
    phasor = Phasor(value=value, variance_re=zero, variance_im=zero, covariance=zero)
    expected = torch.tensor([[1.0, 1.0 + reach, 1.0 + 2.0 * reach, 0.02 + reach]])
    torch.testing.assert_close(phasor.decoded(near, SENSOR), expected)
    assert phasor.decoded(torch.full((1, 4), -reach), SENSOR).min() == 0.0


def test_a_slope_and_a_texture_are_no_outline():
    """A floor seen at a grazing angle, and a chessboard on a wall."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    floor = 1.5 + 0.09 * y
    board = np.where((x // 4 + y // 4) % 2, 0.2, 0.9)
    for distance in (floor, np.full_like(floor, 2.0)):
        phasor = board / distance**2 * np.exp(1j * SENSOR.phase_slope * distance)
        after, source = resolved(distance, phasor)
        np.testing.assert_allclose(after, distance, rtol=1e-6)
        assert not source.any()


def test_a_surface_of_its_own_stays():
    """A pixel between two surfaces whose phasor is no mixture of theirs: a third one is there."""
    truth, phasor = scene(SHAPES["edge"], 2.0, 5.0)
    row, column = 12, int(np.argmax(truth[12] == 5.0))
    phasor[row, column] = 0.12 * np.exp(1j * (SENSOR.phase_slope * 3.3 + SENSOR.phase_offset))
    before = decoded(phasor)
    after, _ = resolved(before, phasor)
    assert before[row, column] == pytest.approx(3.3)
    assert after[row, column] == pytest.approx(3.3, abs=0.15)


def test_black_images_stay():
    """Nothing is seen, nothing is divided by zero."""
    distance = np.where(np.arange(WIDTH) < 10, 1.0, 3.0) * np.ones((HEIGHT, 1))
    after, source = resolved(distance, np.zeros((HEIGHT, WIDTH), dtype=complex))
    np.testing.assert_allclose(after, distance, rtol=1e-6)
    assert not source.any()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short fit with the setting alone."""
    folder = tmp_path_factory.mktemp("runs")
    write("ftorf", folder / "box", *recording(frames=16))
    return reconstruct(folder / "box", folder / "run", demo(images=60, outlines=True))


def test_a_run_with_the_setting_says_where_outlines_are(run):
    """Run.render and its renderer agree; without a fallback the source is the fit or an outline."""
    time = 9 / FRAME_RATE_HZ
    given = run.render(time)
    assert set(given.source.unique().tolist()) == {0, outlines.OUTLINE}
    quick = run.renderer(("distance",))(time, run.camera)
    torch.testing.assert_close(quick.distance, given.distance, atol=1e-4, rtol=0)
    bare = run.renderer(("distance",), corrected=False)(time, run.camera)
    same = given.source == 0
    torch.testing.assert_close(bare.distance[same], quick.distance[same], atol=2e-3, rtol=0)
    assert not torch.equal(bare.distance, quick.distance)


def test_compare_scores_what_was_resolved(run):
    """The share of outlines, and the error of the fit alone beside it."""
    scores = compare(run)
    assert 0.0 < scores["source"]["outline"] < 0.5
    assert scores["d_fit_mse_x100"] != scores["d_mse_x100"]
    assert "outline" in (run.path / "report.html").read_text()


def test_a_run_of_a_moving_camera_resolves_its_closed_form(tmp_path, monkeypatch):
    """Of phasors all of it is the closed form, of which mixed pixels change; a sound fit has a
    share in all pixels, within the distances around each.
    """
    sequence = simulate("tour", tmp_path / "tour", size=(48, 36), frames=8, format="torf")
    run = reconstruct(sequence, tmp_path / "run", demo(images=8, outlines=True, fallback=True))
    view = 4 / FRAME_RATE_HZ, run.camera.at(run.sequence().camera_from_world[4])
    given = run.render(*view)
    closed = torch.tensor(closed_form_distance(run.sequence(), 1), dtype=torch.float32)
    resolved_here, stays = given.source == outlines.OUTLINE, given.source == CLOSED_FORM
    assert 0.02 < resolved_here.float().mean() < 0.8
    assert (resolved_here | stays).all()
    change = (given.distance - closed).abs()
    assert change[resolved_here].quantile(0.9) > 0.05  # the others are on slopes
    assert change[stays].median() < 0.03
    monkeypatch.setattr(fallback, "UNEXPLAINED_SOUND", 1.0)
    averaged = Run.open(run.path).render(*view)
    assert torch.equal(averaged.source, given.source)
    low, high = extremes(given.distance)
    assert ((averaged.distance > low - 1e-5) & (averaged.distance < high + 1e-5)).all()
    assert ((averaged.distance - given.distance).abs() > 1e-3).float().mean() > 0.2
