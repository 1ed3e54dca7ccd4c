"""What ``gftorf render`` writes, and colours that mean what their scale says."""

import json
import re
from dataclasses import replace

import analytic_run
import numpy as np
import pytest
import torch
from analytic_run import FRAMES, HEIGHT, WIDTH, AnalyticRun, true_distance, with_colour

from gftorf_warp.data.exr import read_exr
from gftorf_warp.errors import InputError, ResourceError, UsageError
from gftorf_warp.evaluate import pictures, previews, renders
from gftorf_warp.evaluate.views import quad_of_shift, render_to_folder
from gftorf_warp.scene.sensor import Sensor


@pytest.fixture
def run(tmp_path):
    """A finished run."""
    return AnalyticRun(tmp_path)


def test_every_raw_frame_is_rendered_by_default(run, tmp_path):
    """Values in float32 as rendered, the truncated quartet included; a preview each,
    and a list of what is where.
    """
    out = render_to_folder(run, tmp_path / "out")
    assert sorted(path.name for path in out.iterdir()) == ["distance", "quads", "renders.json"]
    for n in (0, 5, FRAMES - 1):
        rendering = run.render(n / 120)
        images = read_exr(out / "distance" / f"{n:06d}.exr")
        np.testing.assert_array_equal(images["distance"], rendering.distance.numpy())
        np.testing.assert_array_equal(images["opacity"], rendering.opacity.numpy())
        quads = read_exr(out / "quads" / f"{n:06d}.exr")
        assert set(quads) == {"quad_000", "quad_180", "quad_090", "quad_270"}
        np.testing.assert_array_equal(quads["quad_180"], rendering.quads[1].numpy())
    assert (
        len(list((out / "distance").glob("*.exr")))
        == len(list((out / "distance").glob("*.png")))
        == FRAMES
    )
    listed = json.loads((out / "renders.json").read_text())
    assert listed["times_s"] == pytest.approx([n / 120 for n in range(FRAMES)])
    assert listed["channels"]["distance"] == ["distance", "opacity"]
    assert listed["preview"]["distance"]["unit"] == "m"


def test_an_instant_of_several_raw_frames_is_rendered_once(run, tmp_path):
    """A phasor recording has four raw frames of every instant; its images are no copies."""
    measured = analytic_run.as_phasors(run.sequence())
    run.sequence = lambda: measured
    out = render_to_folder(run, tmp_path / "out", what="distance", arrays=True)
    listed = json.loads((out / "renders.json").read_text())
    assert listed["times_s"] == measured.times[::4].tolist()
    assert len(np.load(out / "distance" / "distance.npy")) == measured.frames // 4


def test_previews_of_all_times_share_a_scale(run, tmp_path):
    """The wall has one colour in every picture, and the picture is that of the values."""
    import cv2

    out = render_to_folder(run, tmp_path / "out", what="distance", plain=True)
    scale = pictures.Scale(**json.loads((out / "renders.json").read_text())["preview"]["distance"])
    for n in range(FRAMES):
        rgb = cv2.imread(str(out / "distance" / f"{n:06d}.png"))[..., ::-1]
        images = read_exr(out / "distance" / f"{n:06d}.exr")
        np.testing.assert_array_equal(rgb, pictures.colour_mapped(images["distance"], scale))
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) == 2


def test_previews_of_quads_are_in_a_row_with_white_between(run):
    """Each pixel in the colour of its value, grey where there is none:
    what any reader makes of colours by number.
    """
    import cv2

    images = renders.named("quads", {"quads": run.render(0.02).quads.numpy()}, run.sensor)
    images["quad_180"][2, 3] = np.nan
    scale = previews.preview_scale("quads", [images])
    content = np.frombuffer(previews.preview("quads", images, scale), np.uint8)
    rgb = cv2.imdecode(content, cv2.IMREAD_COLOR)[..., ::-1]
    want = pictures.side_by_side(
        [pictures.colour_mapped(image, scale) for image in images.values()]
    )
    np.testing.assert_array_equal(rgb, want)
    assert (want[2, WIDTH + 2 + 3] == pictures.UNKNOWN_GREY).all()
    assert (want[:, WIDTH : WIDTH + 2] == 255).all()


def test_chosen_times_and_things(run, tmp_path):
    """Phasors at two times, at the pose of the nearest raw frame;
    previews show phase and amplitude.
    """
    import cv2

    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 1, 3] = np.arange(FRAMES)
    sequence = replace(run.sequence(), camera_from_world=poses)
    run.sequence = lambda: sequence
    out = render_to_folder(
        run, tmp_path / "out", ["phasor", "phasor"], [3.4 / 120, 8 / 120], plain=True
    )
    assert {camera.camera_from_world[1, 3] for camera in run.cameras} == {3.0, 8.0}
    images = read_exr(out / "phasor" / "000001.exr")
    np.testing.assert_allclose(np.hypot(images["re"], images["im"]), images["amplitude"], rtol=1e-5)
    np.testing.assert_allclose(images["amplitude"], 2.0 / true_distance(8) ** 2, rtol=1e-5)
    rgb = cv2.imread(str(out / "phasor" / "000001.png"))[..., ::-1]
    assert rgb.shape == (HEIGHT, 2 * WIDTH + 2, 3)
    phase = analytic_run.PHASE_SLOPE * (true_distance(8) + analytic_run.QUAD_ERROR)
    np.testing.assert_array_equal(
        rgb[:, :WIDTH], pictures.colour_mapped(phase, pictures.phase_scale())
    )
    assert rgb[0, -1, 0] < rgb[4, WIDTH + 2 + 11, 0], "the box is nearer, so brighter"
    assert len(list((out / "phasor").iterdir())) == 4


def test_writing_reports_in_order_and_stops_at_the_first_error(run, tmp_path, monkeypatch):
    """Files are written by threads: progress still counts up,
    and what stops one of them stops the command.
    """
    seen = []
    render_to_folder(
        run, tmp_path / "out", what="distance", progress=lambda *done: seen.append(done)
    )
    assert seen == [(k + 1, FRAMES) for k in range(FRAMES)]

    def full(path, _):
        if path.name == "000003.png":
            raise ResourceError("no space left", where=path, why="full", fix="free some")

    monkeypatch.setattr(previews, "write_one_of_many", full)
    with pytest.raises(ResourceError, match=r"000003\.png"):
        render_to_folder(run, tmp_path / "other", what="distance")


def taken(run):
    """Height of every camera that something was rendered from,
    without the samples for the previews, and the times.
    """
    return [float(camera.camera_from_world[1, 3]) for camera in run.cameras]


@pytest.mark.parametrize("rows", [4, 3])
def test_poses_from_a_file(run, tmp_path, rows):
    """Pose k at time k, the shorter list starting over;
    without times in the middle of the sequence.
    """
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 1, 3] = (1.0, 2.0, 3.0)
    path = tmp_path / "poses.npy"
    np.save(path, poses[:, :rows])
    out = render_to_folder(run, tmp_path / "middle", what="distance", poses=path)
    listed = json.loads((out / "renders.json").read_text())
    assert listed["times_s"] == pytest.approx([6.5 / 120] * 3)
    np.testing.assert_array_equal(listed["camera_from_world"], poses)
    assert taken(run)[-3:] == [1.0, 2.0, 3.0]
    assert len(list((out / "distance").glob("*.exr"))) == 3
    for times, want in (
        ([0.0, 0.1], [(1, 0.0), (2, 0.1), (3, 0.0)]),
        ([0.0, 0.01, 0.02, 0.03], [(1, 0.0), (2, 0.01), (3, 0.02), (1, 0.03)]),
    ):
        out = render_to_folder(run, tmp_path / str(len(times)), poses=path, times=times)
        listed = json.loads((out / "renders.json").read_text())
        found = [pose[1][3] for pose in listed["camera_from_world"]]
        assert list(zip(found, listed["times_s"], strict=True)) == want
        assert taken(run)[-len(want) :] == [height for height, _ in want]


def test_other_poses_are_other_images(run, tmp_path):
    """Of the same times and channels."""
    for k in (0, 1):
        pose = np.eye(4)[None].copy()
        pose[0, 2, 3] = k
        np.save(tmp_path / f"{k}.npy", pose)
    out = render_to_folder(run, tmp_path / "out", poses=tmp_path / "0.npy", times=[0.0])
    render_to_folder(run, out, poses=tmp_path / "0.npy", times=[0.0])
    with pytest.raises(UsageError, match="other times or poses"):
        render_to_folder(run, out, poses=tmp_path / "1.npy", times=[0.0])
    with pytest.raises(UsageError, match="other times or poses"):
        render_to_folder(run, out, times=[0.0])


def test_novel_poses_are_those_of_the_sequence(run, tmp_path):
    """Three of them; a sequence without any says so."""
    with pytest.raises(UsageError, match="no poses of novel views"):
        render_to_folder(run, tmp_path / "out", poses="novel")
    sequence = with_colour(run.sequence())
    run.sequence = lambda: sequence
    render_to_folder(run, tmp_path / "out", poses="novel")
    assert taken(run)[-3:] == [0.5, 0.0, -0.5]


@pytest.mark.parametrize(
    ("poses", "text"),
    [
        (np.eye(4), r"\(4, 4\)"),
        (np.zeros((2, 4, 3)), r"\(2, 4, 3\)"),
        (np.zeros((0, 4, 4)), r"\(0, 4, 4\)"),
        (
            np.stack([np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])]),
            "1 of 2 are no rigid motions.*index 1",
        ),
        (2 * np.eye(4)[None], "no rigid"),
        (np.full((1, 4, 4), np.nan), "not finite"),
        (np.array([["a"]]), "wrong type"),
    ],
)
def test_poses_that_are_none_are_refused(run, tmp_path, poses, text):
    """Wrong shape, none at all, mirrored, scaled, unknown; nothing is written then."""
    np.save(tmp_path / "poses.npy", poses)
    with pytest.raises(InputError) as error:
        render_to_folder(run, tmp_path / "out", poses=tmp_path / "poses.npy")
    assert re.search(text, str(error.value), re.DOTALL), error.value
    assert error.value.where == str(tmp_path / "poses.npy")
    assert not (tmp_path / "out").exists()


def test_poses_that_are_no_file_are_refused(run, tmp_path):
    """A file that is missing, and one that is no .npy."""
    with pytest.raises(InputError, match="poses"):
        render_to_folder(run, tmp_path / "out", poses=tmp_path / "missing.npy")
    with pytest.raises(UsageError, match=r"\.npy"):
        render_to_folder(run, tmp_path / "out", poses="nvel")


def test_the_median_distance_is_rendered(run, tmp_path):
    """Its own channel, beside the mean's, in metres."""
    out = render_to_folder(
        run, tmp_path / "out", what="distance_median,distance", times=[0.0], arrays=True
    )
    median = np.load(out / "distance_median" / "distance_median.npy")
    mean, opacity = (np.load(out / "distance" / f"{name}.npy") for name in ("distance", "opacity"))
    assert median.shape == mean.shape == opacity.shape
    assert np.abs(median - true_distance(0)).max() < 0.05
    assert np.abs(median - mean).max() > 0.01


@pytest.mark.parametrize(
    ("what", "times", "text"),
    [
        (("distance", "depth"), None, "'depth'"),
        ("", None, "nothing"),
        ("colour", None, "no colour"),
        ("distance", [], "no time"),
        ("distance", [0.1, 100.0], "nothing of 100 s"),
        ("distance", [-0.01], "nothing of -0.01 s"),
    ],
)
def test_what_cannot_be_rendered_is_named(run, tmp_path, what, times, text):
    """Nothing is written then."""
    with pytest.raises(UsageError, match=text):
        render_to_folder(run, tmp_path / "out", what=what, times=times)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_else_is_refused_or_moved_aside(run, tmp_path):
    """The same images are written again; others need ``fresh``, and then nothing is lost."""
    out = render_to_folder(run, tmp_path / "out", what="distance", times=[0.0])
    before = (out / "distance" / "000000.exr").read_bytes()
    (out / "distance" / "000000.exr").write_bytes(b"cut off")
    render_to_folder(run, out, what="distance", times=[0.0])
    assert (out / "distance" / "000000.exr").read_bytes() == before
    with pytest.raises(UsageError, match="--fresh"):
        render_to_folder(run, out, what="distance", times=[0.01])
    assert (out / "distance" / "000000.exr").read_bytes() == before
    render_to_folder(run, out, what="phasor", times=[0.01], fresh=True)
    assert sorted(path.name for path in out.iterdir()) == ["old-1", "phasor", "renders.json"]
    assert (out / "old-1" / "distance" / "000000.exr").read_bytes() == before
    with pytest.raises(UsageError, match="no images"):
        render_to_folder(run, out / "old-1" / "distance", fresh=True)


def test_colour_is_written_linear_and_shown_as_srgb(run):
    """Linear 0.5 is 188 in 8-bit sRGB; what is brighter than white stays white."""
    import cv2

    colour = torch.stack([torch.full((HEIGHT, WIDTH), value) for value in (0.5, 0.0, 7.0)])
    images = renders.named("colour", {"colour": colour.numpy()}, run.sensor)
    assert list(images) == ["R", "G", "B"]
    assert images["B"].max() == 7.0
    content = previews.preview("colour", images, previews.preview_scale("colour", [images]))
    assert cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[0, 0].tolist() == [
        255,
        0,
        188,
    ]


def test_a_shift_finds_its_quad(run):
    """A turn more or less is the same shift; one that is not rendered follows from the phasor,
    constant part too.
    """
    rendering, sensor = run.render(0.02), Sensor()
    for shift, channel in ((0.0, 0), (np.pi, 1), (np.pi / 2, 2), (-np.pi / 2, 3), (2 * np.pi, 0)):
        torch.testing.assert_close(
            quad_of_shift(rendering, sensor, shift), rendering.quads[channel], rtol=0, atol=0
        )
    phasor = torch.tensor([3.0, 4.0, 6.0])[:, None, None].expand(-1, *rendering.distance.shape)
    got = quad_of_shift(replace(rendering, phasor=phasor), replace(sensor, dc_offset=0.5), 0.3)
    want = torch.full_like(rendering.distance, 1.5 * np.cos(0.3) + 2.0 * np.sin(0.3) + 1.5)
    torch.testing.assert_close(got, want)


def test_colours_run_from_low_to_high_and_grey_is_unknown():
    """The ends of the map at and beyond the ends of the scale."""
    scale = pictures.Scale(low=1.0, high=2.0, colours="viridis", unit="m")
    bar = pictures.bar(scale.colours)[0]
    rgb = pictures.colour_mapped(np.array([[0.0, 1.0, 1.5, 2.0, 9.0, np.nan]]), scale)[0]
    np.testing.assert_array_equal(rgb[:5], bar[[0, 0, len(bar) // 2, -1, -1]])
    assert rgb[5].tolist() == [128, 128, 128]
    for colours in ("viridis", "magma", "twilight", "RdBu_r"):
        assert not (pictures.bar(colours) == 128).all(axis=-1).any()
    with pytest.raises(ValueError, match="low < high"):
        pictures.Scale(low=1.0, high=1.0, colours="viridis", unit="m")


def test_scales():
    """Symmetric for quads, from zero for errors, cyclic for phase, and never empty."""
    values = [np.linspace(-1.0, 3.0, 1001), np.array([np.nan])]
    signed = pictures.signed_scale(values)
    assert signed.low == -signed.high
    assert signed.high == pytest.approx(3.0, abs=0.05)
    assert pictures.error_scale([np.zeros(3)]).low == 0.0
    first, last = pictures.bar(pictures.phase_scale().colours)[0, [0, -1]].astype(int)
    assert np.abs(first - last).max() < 8
    dark = [np.zeros(4)]
    for scale in (
        pictures.distance_scale,
        pictures.error_scale,
        pictures.amplitude_scale,
        pictures.signed_scale,
    ):
        assert scale(dark).low < scale(dark).high
        assert scale([np.full(4, np.nan)]).high > scale([np.full(4, np.nan)]).low


def test_pictures_are_lossless():
    """An image comes back as it was, with red first."""
    import cv2

    rgb = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
    back = cv2.imdecode(np.frombuffer(pictures.webp(rgb), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_array_equal(back, rgb)


def test_the_analytic_run_renders_what_it_says():
    """Opposite quads cancel, and the mean distance is 2 % short of a slightly wrong one."""
    distance = analytic_run.true_distance(3)
    assert sorted(np.unique(distance)) == [2.5, 4.0]
    quads = [analytic_run.quad(distance, shift) for shift in Sensor().shifts]
    np.testing.assert_allclose(quads[0] + quads[1], 0.0, atol=1e-12)
