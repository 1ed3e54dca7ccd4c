"""Pictures for people: enlarged, with title and colour bar; videos of them; what headers state."""

import base64
import json

import cv2
import numpy as np
import OpenEXR
import pytest
from analytic_run import FRAMES, HEIGHT, WIDTH, AnalyticRun, true_distance, with_colour
from browser import browser

from gftorf_warp.constants import SOURCES
from gftorf_warp.data.exr import read_exr
from gftorf_warp.errors import ResourceError, UsageError
from gftorf_warp.evaluate import pictures, video
from gftorf_warp.evaluate.captioned import Panel, captioned
from gftorf_warp.evaluate.previews import with_units
from gftorf_warp.evaluate.views import render_to_folder, render_to_video
from gftorf_warp.recon.outlines import OUTLINE


@pytest.fixture
def run(tmp_path):
    """A finished run."""
    return AnalyticRun(tmp_path)


def test_a_preview_holds_the_image_enlarged_below_a_title(run, tmp_path):
    """Every pixel as a square in the colour of its value; ink above it, the scale beside it."""
    out = render_to_folder(run, tmp_path / "out", what="distance", times=[5 / 120])
    rgb = cv2.imread(str(out / "distance" / "000000.png"))[..., ::-1]
    scale = pictures.Scale(**json.loads((out / "renders.json").read_text())["preview"]["distance"])
    image = read_exr(out / "distance" / "000000.exr")["distance"]
    factor = 640 // WIDTH
    want = pictures.colour_mapped(image, scale).repeat(factor, axis=0).repeat(factor, axis=1)
    found = [
        top
        for top in range(len(rgb) - len(want))
        if np.array_equal(rgb[top : top + len(want), 12 : 12 + want.shape[1]], want)
    ]
    assert len(found) == 1
    assert rgb[: found[0] - 30].min() < 100, "a title"
    beside = rgb[found[0] : found[0] + len(want), 12 + want.shape[1] :]
    for value in (scale.low, scale.high):
        colour = pictures.colour_mapped(np.array([[value]]), scale)[0, 0]
        assert (beside == colour).all(axis=2).any()


def test_pictures_of_one_scale_share_a_bar():
    """Four pictures and a bar are as wide as with one bar each, less three bars."""
    image, scale = np.zeros((10, 400, 3), np.uint8), pictures.phase_scale()
    other = pictures.Scale(low=0.0, high=1.0, colours="gray", unit="1")
    shared = captioned([Panel("", image, scale)] * 2, "title")
    apart = captioned([Panel("", image, scale), Panel("", image, other)], "title")
    none = captioned([Panel("", image, None)] * 2, "title")
    assert none.shape[1] < shared.shape[1] < apart.shape[1]
    assert not any(side % 2 for one in (shared, apart, none) for side in one.shape[:2])


def test_headers_state_time_units_frame_and_camera(run, tmp_path):
    """As another reader of OpenEXR finds them; a time between raw frames has no raw frame."""
    out = render_to_folder(run, tmp_path / "out", "distance,quads", [3 / 120, 3.4 / 120])
    with OpenEXR.File(str(out / "distance" / "000000.exr")) as file:
        header = dict(file.header())
    assert header["time_s"].tolist() == [3 / 120]
    assert header["raw_frame"] == 3
    assert header["units"] == "distance: m; opacity: 1"
    camera = json.loads(header["camera"])
    assert (camera["width"], camera["fx"], camera["cy"]) == (WIDTH, 20.0, HEIGHT / 2)
    assert camera["camera_from_world"] == np.eye(4).tolist()
    with OpenEXR.File(str(out / "quads" / "000001.exr")) as file:
        header = dict(file.header())
    assert header["time_s"].tolist() == [3.4 / 120]
    assert "raw_frame" not in header
    assert "quad_180: of the sequence" in header["units"]
    sources = with_units({}, ["source"])["units"]
    assert all(f"{k} {name}" in sources for k, name in enumerate(SOURCES))
    assert f"{OUTLINE} outline" in sources


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_a_video_shows_every_time(run, tmp_path, capfd, suffix):
    """Read back by its player's library: as many pictures, the box where it is, nothing printed."""
    path = render_to_video(run, tmp_path / f"film{suffix}", ["distance"], rate_hz=10.0)
    assert capfd.readouterr().err == ""
    reader = cv2.VideoCapture(str(path))
    assert reader.get(cv2.CAP_PROP_FPS) == 10.0
    shown = [reader.read()[1] for _ in range(FRAMES)]
    assert not reader.read()[0]
    factor = 640 // WIDTH
    for n in (0, FRAMES - 1):
        rows = slice(58 + factor // 2, 58 + factor * HEIGHT, factor)
        columns = slice(12 + factor // 2, 12 + factor * WIDTH, factor)
        brightness = shown[n][rows, columns].astype(float).sum(axis=2)
        near = true_distance(n) < 3.0
        assert brightness[near].max() + 50 < brightness[~near].min(), "near is dark in viridis"


PLAYER = """<video src="data:video/{kind};base64,{data}" muted></video><script>
const video = document.querySelector("video"), sketch = document.createElement("canvas");
function shows(colour) {{
  const pen = sketch.getContext("2d");
  pen.drawImage(video, 0, 0);
  const data = pen.getImageData(20, 20, 1, 1).data;
  return colour.every((value, k) => Math.abs(value - data[k]) < 40);
}}
</script>"""


@pytest.fixture(scope="module")
def tab():
    """One browser for both kinds."""
    with browser() as one:
        yield one


@pytest.mark.parametrize("kind", ["webm", "mp4"])
def test_a_video_plays_in_a_browser(tab, tmp_path, kind):
    """Chromium decodes it, has its size and length, and shows the picture of each time; it plays
    until its end.
    """
    colours = np.array([[220, 30, 30], [30, 200, 30], [30, 30, 220]], np.uint8)
    film = [np.broadcast_to(colour, (48, 64, 3)) for colour in colours]
    video.write_video(tmp_path / f"film.{kind}", film, len(film), rate_hz=4.0)
    data = base64.b64encode((tmp_path / f"film.{kind}").read_bytes()).decode()
    (tmp_path / "player.html").write_text(PLAYER.format(kind=kind, data=data))
    tab.open((tmp_path / "player.html").as_uri())
    tab.until("video.readyState >= 2")
    assert tab.value("[video.videoWidth, video.videoHeight]") == [64, 48]
    assert tab.value("video.duration") == pytest.approx(0.75, abs=0.02)
    for k, colour in enumerate(colours):
        tab.value(f"video.currentTime = {(k + 0.5) / 4}")
        # OpenCV states no matrix for its YUV, and Chromium takes another one: 27 away here
        tab.until(f"shows({colour.tolist()})")  # "seeked" may come before the picture
    tab.value("video.play()")
    tab.until("video.ended")
    assert tab.problems == []


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_an_animation_shows_every_time(run, tmp_path, suffix):
    """As Pillow reads it, which did not write it."""
    from PIL import Image

    path = render_to_video(run, tmp_path / f"film{suffix}", ["distance"], times=[0.0, 0.02, 0.05])
    with Image.open(path) as found:
        assert found.n_frames == 3
        found.load()
        assert found.info["duration"] == 250
        assert found.width > 640


def test_several_kinds_are_side_by_side(tmp_path):
    """Distance and colour in one picture."""
    run = AnalyticRun(tmp_path, colour=True)
    run.sequence = lambda: with_colour(AnalyticRun.sequence(run))
    one = render_to_video(run, tmp_path / "one.webp", "distance", times=[0.0])
    two = render_to_video(run, tmp_path / "two.webp", "distance,colour", times=[0.0])
    widths = [cv2.imread(str(path)).shape[1] for path in (one, two)]
    assert widths[1] == pytest.approx(widths[0] + 16, abs=2 * WIDTH)


def test_a_name_must_say_which_kind_of_video(run, tmp_path):
    """Before anything is rendered."""
    with pytest.raises(UsageError, match=r"\.webm"):
        render_to_video(run, tmp_path / "film.avi")
    assert not run.cameras


def test_a_video_that_lacks_pictures_is_no_video(tmp_path, monkeypatch):
    """A full disk, which OpenCV does not notice: an error, and no file."""
    picture = np.full((48, 64, 3), 200, np.uint8)

    class Forgetful:
        def __init__(self, *arguments):
            self.right = right(*arguments)
            self.isOpened, self.release = self.right.isOpened, self.right.release
            self.count = 0

        def write(self, image):
            self.count += 1
            if self.count < 4:
                self.right.write(image)

    right = cv2.VideoWriter
    Forgetful.fourcc = right.fourcc
    monkeypatch.setattr(cv2, "VideoWriter", Forgetful)
    with pytest.raises(ResourceError, match="3 of 6"):
        video.write_video(tmp_path / "film.webm", [picture] * 6, 6)
    assert not list(tmp_path.iterdir())


def test_an_animation_that_memory_cannot_hold_is_refused(run, tmp_path, monkeypatch):
    """With the kinds that need not hold it, before all of it is rendered."""
    monkeypatch.setattr(video, "HELD_BYTES_MAX", 5_000_000)
    with pytest.raises(UsageError, match=r"\.webm"):
        render_to_video(run, tmp_path / "film.webp")
    assert not (tmp_path / "film.webp").exists()
    assert len(run.cameras) < FRAMES


def test_the_rate_lets_a_few_pictures_be_seen():
    """Four to thirty per second."""
    assert [video.rate_of(count) for count in (4, 60, 1000)] == [4.0, 12.0, 30.0]
