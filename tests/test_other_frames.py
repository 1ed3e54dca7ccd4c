"""Moving outlines: what quads of other raw frames tell of the share of a mixed pixel."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from moving_box import as_phasors, flow, recording, seen
from sequences import changed

from gftorf_warp.constants import CANONICAL_SHIFTS, FRAME_RATE_HZ
from gftorf_warp.data.write import write
from gftorf_warp.recon import outlines, presets
from gftorf_warp.recon.other_frames import OtherFrames, log_likelihood, normals_of
from gftorf_warp.recon.phasors import MeasuredPhasors, Phasor, rendered_phasor
from gftorf_warp.recon.runs.moving import MovingOutlines
from gftorf_warp.recon.straight import Outline
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.api import Rendering
from gftorf_warp.scene.motion import Still
from gftorf_warp.scene.sensor import Sensor

HEIGHT, WIDTH, RAYS = 24, 40, 12
NEAR, FAR = 2.0, 2.9  # [m]
TILT = 0.23  # [px per row] of the edge
EDGE = 20.37  # [px] where it is in row 0 at the raw frame
NOISE = 1e-4  # [quad units]
GAINS, SHARES = torch.tensor(outlines.GAINS), torch.linspace(0.0, 1.0, outlines.SHARES)
SENSOR = Sensor(phase_offset=0.4)
OTHERS = [-3, -2, -1, 1, 2, 3]  # [raw frames] later


def subsamples():
    """Positions (x, y) [px] of RAYS x RAYS rays per pixel."""
    at = (np.arange(HEIGHT * RAYS) + 0.5) / RAYS, (np.arange(WIDTH * RAYS) + 0.5) / RAYS
    return np.meshgrid(*at, indexing="ij")[::-1]


def mean(image):
    """Means over the rays of every pixel."""
    return image.reshape(HEIGHT, RAYS, WIDTH, RAYS).mean(axis=(1, 3))


def light(distance, reflectivity):
    """Phasors of length 2a."""
    phase = SENSOR.phase_slope * distance + SENSOR.phase_offset
    return 2.0 * reflectivity / distance**2 * np.exp(1j * phase)


class MovingEdge:
    """A near surface with a slanted edge that moves to the right in front of a textured wall.

    Args:
        velocity: Of the edge [px per raw frame].
        left: Whether the near surface is on the left of its edge; or on its right.
    """

    def __init__(self, velocity, left=True):
        self.velocity, self.left = velocity, left
        x, y = subsamples()
        wall = light(FAR, 0.5 + 0.2 * np.sin(1.1 * x) * np.cos(0.7 * y))
        self.wall, front = mean(wall), light(NEAR, 0.6)
        covered = {k: (x < EDGE + TILT * y + velocity * k) == left for k in [0, *OTHERS]}
        self.share = mean(covered[0])
        phasors = {k: mean(np.where(there, front, wall)) for k, there in covered.items()}
        self.phasor = phasors[0]
        self.shifts = [CANONICAL_SHIFTS[k % 4] for k in OTHERS]
        quads = [
            0.5 * (phasors[k] * np.exp(-1j * shift)).real
            for k, shift in zip(OTHERS, self.shifts, strict=True)
        ]
        noise = NOISE * np.random.default_rng(0).standard_normal((len(OTHERS), HEIGHT, WIDTH))
        self.quads = np.stack(quads) + noise
        centre = (np.arange(WIDTH) + 0.5 < EDGE + TILT * (np.arange(HEIGHT) + 0.5)[:, None]) == left
        self.truth = np.where(centre, NEAR, FAR)
        self.rendered = NEAR * self.share + FAR * (1.0 - self.share)

    def others(self, moves=1.0):
        """What is known of it, if the near surface has this weight of moving Gaussians."""
        moving = moves * tensor(self.share)
        return OtherFrames(
            quads=tensor(self.quads),
            variance=torch.full((len(OTHERS), HEIGHT, WIDTH), NOISE**2),
            shifts=tensor(self.shifts),
            later=tensor(OTHERS),
            moving=moving,
            flow=torch.stack([self.velocity * moving, 0.0 * moving]),
            behind=torch.tensor(self.wall, dtype=torch.complex64),
            opacity=torch.ones(HEIGHT, WIDTH),
            normals=normals_of(tensor(self.rendered)),
        )

    def rendering(self, error=0.2, seed=0):
        """A rendering, and its phasor with an error relative to the amplitude."""
        random = np.random.default_rng(seed).standard_normal((2, HEIGHT, WIDTH))
        amplitude = np.abs(self.phasor).max()
        wrong = self.phasor + error * amplitude * (random[0] + 1j * random[1])
        none, flat = torch.zeros(0, HEIGHT, WIDTH), torch.zeros(0, WIDTH)
        rendering = Rendering(
            quads=none,
            phasor=tensor([self.phasor.real, self.phasor.imag, abs(self.phasor)]),
            colour=None,
            distance=tensor(self.rendered),
            opacity=flat,
            distortion=flat,
            distance_median=flat,
            extra=None,
            screen=None,
        )
        variance = torch.full((HEIGHT, WIDTH), (error * amplitude) ** 2)
        # mixed pixels only: what is beside them is known
        value = np.where((self.share > 0.0) & (self.share < 1.0), wrong, self.phasor)
        return rendering, Phasor(
            value=torch.tensor(value, dtype=torch.complex64),
            variance_re=variance,
            variance_im=variance,
            covariance=torch.zeros_like(variance),
        )


def tensor(values):
    """In single precision."""
    return torch.as_tensor(np.array(values), dtype=torch.float32)


def mixed_pixels(edge):
    """The mixed pixels of an edge between columns, and amplitudes on both sides."""
    row, column = np.nonzero((edge.share > 0.02) & (edge.share < 0.98))
    near, far = (abs(light(*of)) for of in ((NEAR, 0.6), (FAR, 0.5)))
    order = slice(None) if edge.left else slice(None, None, -1)
    (first, second), amplitudes = ((NEAR, FAR)[order], (near, far)[order])
    pixels = torch.tensor(row), torch.tensor(column)
    distances = [torch.full((len(row),), value) for value in (first, second)]
    outline = Outline((0, 1), pixels, *distances, tensor(edge.rendered), 0.25)
    share = edge.share[row, column]
    amplitudes = tuple(torch.full((len(row),), float(value)) for value in amplitudes)
    return outline, amplitudes, tensor(share if edge.left else 1.0 - share)


def likeliest(likelihood):
    """Each pixel's most likely share under its logarithm of a likelihood [g s P]."""
    return SHARES[likelihood.logsumexp(dim=0).argmax(dim=0)]


@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("velocity", [0.4, -1.3, 2.7])
def test_other_raw_frames_tell_the_share(velocity, left):
    """Whatever the velocity, and on whichever side the surface in front is."""
    edge = MovingEdge(velocity, left)
    outline, amplitudes, true = mixed_pixels(edge)
    given = log_likelihood(edge.others(), outline, amplitudes, GAINS, SHARES, SENSOR)
    torch.testing.assert_close(given.exp().mean(dim=(0, 1)), torch.ones_like(true))
    apart = (likeliest(given) - true).abs()
    assert apart.mean() < 0.1


@pytest.mark.parametrize("velocity", [0.4, -1.3, 2.7])
def test_fewer_mixed_pixels_are_on_the_wrong_side(velocity):
    """Of a phasor that is wrong by a third of the light."""
    edge = MovingEdge(velocity)
    mixed = (edge.share > 0.02) & (edge.share < 0.98) & (abs(edge.share - 0.5) > 0.05)
    wrong = {"without": 0, "with": 0}
    for seed in range(10):
        rendering, phasor = edge.rendering(error=0.3, seed=seed)
        for name, others in (("without", None), ("with", edge.others())):
            given = outlines.resolved(rendering, SENSOR, phasor, others=others)
            apart = abs(given.distance.numpy() - edge.truth)
            wrong[name] += (apart > 0.5 * (FAR - NEAR))[mixed].sum()
    assert wrong["with"] < 0.7 * wrong["without"]


def test_where_nothing_moves_nothing_is_told():
    """Nor of an edge that is too fast, or along the line of pixels: all shares are as likely, and
    the distances are those without other raw frames.
    """
    edge = MovingEdge(0.4)
    outline, amplitudes, _ = mixed_pixels(edge)
    rendering, phasor = edge.rendering()
    alone = outlines.resolved(rendering, SENSOR, phasor).distance
    others = edge.others()
    along = others.normals.flip(0) * torch.tensor([0.1, 1.0])[:, None, None]
    for nothing in (
        edge.others(moves=0.2),
        replace(others, flow=20.0 * others.flow),
        replace(others, normals=along),
    ):
        given = log_likelihood(nothing, outline, amplitudes, GAINS, SHARES, SENSOR)
        assert given.shape == (len(GAINS), len(SHARES), len(outline.first))
        assert not given.any()
    still = outlines.resolved(rendering, SENSOR, phasor, others=edge.others(moves=0.2))
    assert torch.equal(still.distance, alone)
    assert not torch.equal(
        outlines.resolved(rendering, SENSOR, phasor, others=others).distance, alone
    )


def test_an_outline_that_leaves_the_image_tells_nothing():
    """All its other positions are outside."""
    edge = MovingEdge(-1.3)
    cut = slice(19, 24)  # columns; the outline has left them after few raw frames
    others = edge.others()
    names = ("quads", "variance", "moving", "flow", "behind", "opacity", "normals")
    others = replace(others, **{name: getattr(others, name)[..., cut] for name in names})
    outline, amplitudes, _ = mixed_pixels(edge)
    near = outline.pixels[1] < 21
    pixels = outline.pixels[0][near], outline.pixels[1][near] - cut.start
    first, second = outline.first[near], outline.second[near]
    inside = outline._replace(pixels=pixels, first=first, second=second)
    sides = [amplitude[near] for amplitude in amplitudes]
    far = replace(others, later=100.0 * others.later)
    assert not log_likelihood(far, inside, sides, GAINS, SHARES, SENSOR).any()
    assert log_likelihood(others, inside, sides, GAINS, SHARES, SENSOR).isfinite().all()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short fit of a moving box, with windows."""
    folder = tmp_path_factory.mktemp("runs")
    write("ftorf", folder / "box", *recording())
    settings = presets.best()
    schedule = replace(settings.schedule, images=80)
    settings = replace(settings, schedule=schedule, attempts_max=1)
    return reconstruct(folder / "box", folder / "run", settings)


def others_of(run, n, sequence=None, camera=None, time=None):
    """What is known of the outlines of raw frame n of a run, or of its other sequence."""
    sequence = sequence or run.sequence()
    measured = MeasuredPhasors.of(sequence, run.camera, run.field.device)
    outlines_of_run = MovingOutlines.of(run, measured)
    if outlines_of_run is None:
        return None
    camera = camera or run.camera
    time = float(sequence.times[n]) if time is None else time
    rendering = run.renderer(("distance", "phasor"), corrected=False)(time, camera)
    return outlines_of_run.at(rendering, time, camera, float(run.sensor.f_mod_hz))


@pytest.mark.parametrize("n", [0, 5, 15])
def test_a_run_knows_flow_and_static_layer(run, n):
    """The flow is that of the box; the static layer, rendered alone, is the wall wherever it was
    seen; at both ends there are fewer raw frames.
    """
    others = others_of(run, n)
    frames = [m for m in range(max(n - 3, 0), min(n + 4, 16)) if m != n]
    assert others.later.tolist() == pytest.approx([m - n for m in frames])
    np.testing.assert_array_equal(others.quads, run.sequence().quads[frames])
    inside = others.moving > 0.9
    assert inside.sum() > 50
    apart = others.flow / others.moving - torch.tensor(flow(n, 1))
    assert apart[:, inside].abs().mean() < 0.2
    assert others.opacity.median() > 0.9
    wall = ~torch.tensor(seen(n)[2])
    re, im, _ = run.renderer(("phasor",), corrected=False)(
        float(run.sequence().times[n]), run.camera
    ).phasor
    same = (others.behind - torch.complex(re, im))[wall & (others.moving < 0.05)]
    assert same.abs().max() < 0.1 * others.behind.abs().max()


def test_a_rendering_at_a_raw_frame_uses_it(run):
    """Its distances are those of the parts together, and others without other raw frames."""
    sequence, camera, sensor = run.sequence(), run.camera, run.sensor
    time, f_mod_hz = float(sequence.times[5]), float(sensor.f_mod_hz)
    fitted = run.renderer(("distance", "phasor"), corrected=False)(time, camera)
    rendering = run.fallback.applied(fitted, time, camera)
    measured = MeasuredPhasors.of(sequence, camera, run.field.device)
    rests = run.fallback.rests_at(fitted, time, camera)
    others = MovingOutlines.of(run, measured).at(rendering, time, camera, f_mod_hz)
    assert others.quadrature is not None
    given = run.corrected(fitted, time, camera)
    parts, without = (
        outlines.resolved(
            rendering,
            sensor,
            measured.corrected(
                rendering,
                time,
                camera,
                f_mod_hz,
                averaged=rests,
                quadrature=which and which.quadrature,
            ),
            others=which,
        ).distance
        for which in (others, None)
    )
    smooth = measured.corrected(rendering, time, camera, f_mod_hz, averaged=rests)
    torch.testing.assert_close(torch.complex(*given.phasor[:2]), smooth.value)
    given = given.distance
    torch.testing.assert_close(given, parts)
    differs = (given - without).abs() > 0.01
    assert 0.002 < differs.float().mean() < 0.05
    assert others.moving[differs].min() > 0.01


THIRDS = tuple(2.0 * np.pi * k / 3.0 for k in range(3))
WRONG = 1.2 * np.exp(0.15j)  # a measured phasor over the one that the Gaussians explain


def misfit(run, shifts, factor=WRONG):
    """The recording of a run as if its phasors, or those of each raw frame, were wrong by a factor,
    and what is missing in them.
    """
    sequence, phasors = run.sequence(), rendered(run)
    shifts = np.resize(shifts, sequence.frames)
    quads = 0.5 * np.real(factor * phasors * np.exp(-1j * shifts)[:, None, None])
    wrong = changed(sequence, quads=quads.astype(np.float32), shifts=shifts)
    return wrong, (factor - 1.0) * phasors


def rendered(run):
    """Phasors of all raw frames."""
    images = run.renderer(("phasor",), corrected=False)
    times = run.sequence().times.tolist()
    phasors = [images(time, run.camera).phasor.numpy().copy() for time in times]
    return np.stack([re + 1j * im for re, im, _ in phasors])


@pytest.mark.parametrize(
    ("shifts", "n"),
    [(CANONICAL_SHIFTS, n) for n in (0, 5, 6, 9, 15)] + [(THIRDS, n) for n in (0, 5, 14)],
)
def test_other_raw_frames_tell_the_component_in_quadrature(run, shifts, n):
    """Where all phasors are wrong by one factor: exactly on the wall, whose Gaussians are the same
    in all windows, and nearly on the box that moves by half a pixel from one raw frame to the next,
    whose texture two short fits have differently. Shifts may be a third of a turn apart.
    """
    sequence, wrong = misfit(run, shifts)
    others = others_of(run, n, sequence=sequence)
    truth = (wrong[n] * np.exp(-1j * sequence.shifts[n])).imag
    moving = others.moving.numpy()
    box = cv2.erode((moving > 0.9).astype(np.uint8), np.ones((3, 3))) > 0
    wall = cv2.erode((moving < 0.02).astype(np.uint8), np.ones((9, 9))) > 0
    apart = np.abs(others.quadrature.numpy() - truth) / np.abs(wrong[n])
    assert min(box.sum(), wall.sum()) > 50
    assert apart[wall].max() < 1e-4
    assert np.median(apart[box]) < 0.2


def test_the_nearest_raw_frames_are_interpolated_in_time(run):
    """What is missing grows linearly from raw frame 7, one before, to 10, two after, which tell the
    component; those farther away would mislead.
    """
    n = 8
    factor = np.full(run.sequence().frames, 1.4 + 0.5j)
    factor[7:11] = 1.0 + 0.1j * np.arange(1, 5)
    sequence, wrong = misfit(run, CANONICAL_SHIFTS, factor[:, None, None])
    others = others_of(run, n, sequence=sequence)
    truth = (wrong[n] * np.exp(-1j * sequence.shifts[n])).imag
    wall = cv2.erode((others.moving.numpy() < 0.02).astype(np.uint8), np.ones((9, 9))) > 0
    apart = np.abs(others.quadrature.numpy() - truth)[wall]
    assert np.median(apart) < 1e-3 * np.abs(wrong[n])[wall].mean()


def test_the_component_is_moved_with_its_surface(run, monkeypatch):
    """Stripes on the box, of a period of five pixels, are found where they are."""
    n = 6
    velocity = flow(n, 1)[0][seen(n)[2]].mean()
    x = np.arange(seen(n)[2].shape[1])
    moved = velocity * (np.arange(run.sequence().frames) - n)
    stripes = 1.0 + 0.3 * np.sin(2.0 * np.pi * (x - moved[:, None, None]) / 5.0)
    sequence, wrong = misfit(run, CANONICAL_SHIFTS, stripes)
    truth = (wrong[n] * np.exp(-1j * sequence.shifts[n])).imag
    errors = []
    for moves in (True, False):
        if not moves:
            monkeypatch.setattr("gftorf_warp.recon.quadrature.displaced", lambda image, _: image)
        others = others_of(run, n, sequence=sequence)
        box = others.moving.numpy() > 0.9
        errors.append(np.square(others.quadrature.numpy() - truth)[box].mean())
    assert errors[1] > 0.1 * np.square(truth[box]).mean()
    assert errors[0] < 0.3 * errors[1]


def test_a_phasor_is_corrected_in_both_components(run):
    """The quad of the raw frame gives one, other raw frames the one in quadrature: whole, even if
    the noise is as large as the residuals, where without them a part would be taken; the same where
    quartets are averaged. The error in phase is the noise of the quad.
    """
    sequence, wrong = misfit(run, CANONICAL_SHIFTS)
    n, camera, f_mod_hz = 6, run.camera, float(run.sensor.f_mod_hz)
    time = float(sequence.times[n])
    measured = MeasuredPhasors.of(sequence, camera, run.field.device)
    rendering = run.renderer(("distance", "phasor"), corrected=False)(time, camera)
    square = measured.residual(*rendering.phasor[:2], n).square().mean()
    loud = replace(
        measured,
        of_quads=0.25 * square.expand_as(measured.of_quads),
        variance=torch.full_like(measured.variance, float(square)),
    )
    turn = np.exp(-1j * sequence.shifts[n])
    quadrature = torch.as_tensor((wrong[n] * turn).imag, dtype=torch.float32)
    nowhere = torch.zeros_like(quadrature, dtype=torch.bool)
    right = torch.complex(*rendering.phasor[:2]) + torch.as_tensor(wrong[n])
    for averaged, value in ((nowhere, right), (~nowhere, loud.value[n // 4, 0])):
        whole, part = (
            loud.corrected(rendering, time, camera, f_mod_hz, averaged=averaged, quadrature=which)
            for which in (quadrature, None)
        )
        torch.testing.assert_close(whole.value, value.to(whole.value), atol=1e-5, rtol=1e-4)
        assert (part.value - value).abs().mean() > 0.1 * float(square.sqrt())
    given = loud.corrected(
        rendering, time, camera, f_mod_hz, averaged=nowhere, quadrature=quadrature
    )
    cosine, sine = turn.real, -turn.imag
    in_phase = (
        given.variance_re * cosine**2
        + given.variance_im * sine**2
        + 2.0 * given.covariance * cosine * sine
    )
    noise = in_phase - rendered_phasor(rendering).variance_re
    torch.testing.assert_close(noise, 4.0 * loud.of_quads[n % 4], atol=1e-9, rtol=1e-2)


def test_components_in_quadrature_that_are_unknown(run):
    """With a DC offset a quad is no component; where all near raw frames have nearly one shift, or
    the opposite one, they tell one component only; raw frames after the last complete quartet.
    """
    n = 6
    sequence, _ = misfit(run, CANONICAL_SHIFTS)
    assert others_of(run, n, sequence=sequence).quadrature is not None
    one_tap = replace(sequence, calibration=replace(sequence.calibration, dc_offset=0.5))
    assert others_of(run, n, sequence=one_tap).quadrature is None
    alike = np.resize([0.0, 0.5, np.pi, np.pi + 0.5], sequence.frames)
    sequence, _ = misfit(run, alike)
    assert others_of(run, n, sequence=sequence).quadrature is None
    sequence, _ = misfit(run, THIRDS)
    assert others_of(run, 14, sequence=sequence).quadrature is not None
    assert others_of(run, 15, sequence=sequence).quadrature is None


def test_other_recordings_and_views_are_left_out(run):
    """Phasors, several frequencies, a moving camera, no windows; times between raw frames, raw
    frames that were not measured, other cameras.
    """
    sequence = run.sequence()
    assert others_of(run, 5) is not None
    poses = sequence.camera_from_world.copy()
    poses[8:, 0, 3] += 0.1
    frequencies = np.repeat([20e6, 16e6] * 2, 4)
    for other in (
        as_phasors(sequence),
        changed(sequence, camera_from_world=poses),
        changed(sequence, frequencies_hz=frequencies),
    ):
        assert others_of(run, 5, sequence=other) is None
    still = Still(torch.tensor([0.0, 1.0]))
    assert others_of(replace(run, motion=still, binding=still.bind(run.field)), 5) is None
    compared = replace(run, config=run.config | {"input": "phasor"})
    assert others_of(compared, 5) is None
    measured = np.arange(sequence.frames) != 5
    assert others_of(run, 5, sequence=replace(sequence, measured=measured)) is None
    assert others_of(run, 5, time=5.5 / FRAME_RATE_HZ) is None
    assert others_of(run, 5, camera=run.camera.resized(24, 18)) is None
    pose = np.eye(4)
    pose[0, 3] = 0.1
    assert others_of(run, 5, camera=run.camera.at(pose)) is None
