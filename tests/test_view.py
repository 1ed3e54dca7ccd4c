"""The viewer: what it shows is worked out without a browser; one test moves its slider in one."""

import base64
import logging
import re
import shutil
import socket
import sys
import threading
import time
from dataclasses import replace

import analytic_run
import numpy as np
import pytest
from analytic_run import OPACITY, QUAD_ERROR, AnalyticRun, box_at, quad, sequence, true_distance
from browser import PATIENCE_S, browser, collect_sockets

from gftorf_warp import cli, reconstruct
from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.data.read import read
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, Terminated, UsageError
from gftorf_warp.recon import checkpoint
from gftorf_warp.view import pixel, scene
from gftorf_warp.view.scene import CLOSED_FORM, OURS, TRUTH, Choice
from gftorf_warp.view.state import newest
from gftorf_warp.view.subject import Subject

LOOK_THROUGH = """[...document.querySelectorAll('button')].find(
    button => button.innerText.includes('look through')).click()"""
MIDDLE_OF_SCENE = """(() => { const box = document.querySelector('canvas').getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2]; })()"""
SIZE = (900, 420)  # [px] of the browser: small pictures are quick without a GPU
POINTS = Choice(frame=5, shape=scene.POINTS)


@pytest.fixture(scope="module")
def analytic(tmp_path_factory):
    """The analytic run as a subject."""
    run = AnalyticRun(tmp_path_factory.mktemp("view"))
    run.field = ()
    return Subject(run.sequence(), run, run.path)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The folder of a short reconstruction of Gaussians."""
    folder = tmp_path_factory.mktemp("fitted")
    exact, noise = sequence(), np.random.default_rng(0).normal(0.0, 1e-3, (14, 12, 20))
    noisy = replace(exact, quads=(exact.quads + noise).astype(np.float32))
    write("ftorf", folder / "seq", noisy, analytic_run.truth())
    reconstruct(read(folder / "seq"), folder / "run", "demo", images=24)
    return folder / "run"


@pytest.fixture
def window(analytic):
    """A window of the analytic run, which nobody looks at."""
    pytest.importorskip("viser", reason="no viser: pip install 'gftorf-warp[view]'")
    from gftorf_warp.view.window import Window

    found = Window(analytic)
    yield found
    found.close()
    collect_sockets()


def test_pictures_are_the_arrays_of_the_run(analytic):
    """Distances, errors, quads and amplitude of a raw frame, and nothing that is unknown."""
    shown = scene.pictures_of(analytic, 5, "distance")
    assert [*shown] == [CLOSED_FORM, OURS, TRUTH]
    np.testing.assert_allclose(shown[TRUTH][0], true_distance(5))
    wrong = np.where(box_at(5), analytic_run.BOX_ERROR, analytic_run.WALL_ERROR)
    ours = OPACITY * (true_distance(5) + wrong)
    np.testing.assert_allclose(shown[OURS][0], ours, rtol=1e-6)
    assert len({scale for _, scale in shown.values()}) == 1, "one scale for all distances"
    errors = scene.pictures_of(analytic, 5, "error")
    assert [*errors] == [f"error of {CLOSED_FORM}", f"error of {OURS}"]
    np.testing.assert_allclose(
        errors[f"error of {OURS}"][0], np.abs(ours - true_distance(5)), atol=1e-6
    )
    measured, rendered, apart = scene.pictures_of(analytic, 5, "quads").values()
    np.testing.assert_allclose(measured[0] - rendered[0], apart[0])
    right = true_distance(5)
    want = quad(right + QUAD_ERROR, CANONICAL_SHIFTS[1], right)
    np.testing.assert_allclose(rendered[0], want, rtol=1e-5)
    assert [*scene.pictures_of(analytic, 5, "amplitude")] == ["measured amplitude"]
    assert scene.pictures_of(analytic, 13, "amplitude") == {}, "a truncated quartet decodes to none"
    assert CLOSED_FORM not in scene.pictures_of(analytic, 13, "distance")


def test_chi_square_is_at_the_size_of_the_sequence(fitted):
    """Of the quartet of the frame, on a logarithmic scale."""
    subject = Subject.open(fitted)
    assert scene.colours_of(subject) == [*scene.COLOURS]
    ((image, scale),) = scene.pictures_of(subject, 6, "chi-square").values()
    assert image.shape == (12, 20)
    assert (scale.low, scale.high) == (-1.0, 3.0)
    want = np.log10(np.maximum(subject.residuals.chi_square[1], 0.1))
    np.testing.assert_allclose(image, want)
    alone = Subject.open(subject.sequence.path)
    assert "chi-square" not in scene.colours_of(alone)


@pytest.mark.parametrize("known", [True, False], ids=["truth", "no truth"])
def test_a_recording_without_a_complete_quartet_is_shown(known, tmp_path):
    """Two raw frames of four: quads, and the truth if there is one."""
    two = {name: getattr(sequence(), name)[:2] for name in ("quads", "measured", "shifts", "times")}
    exact = analytic_run.truth()
    truth = replace(exact, distance=exact.distance[:2], known=exact.known[:2]) if known else None
    cut = replace(sequence(), **two, camera_from_world=sequence().camera_from_world[:2])
    subject = Subject.open(write("ftorf", tmp_path / "seq", cut, truth))
    assert subject.recording.width > 0
    for colour in scene.colours_of(subject):
        choice = Choice(colour=colour, pixel=(3, 4))
        assert [cloud.title for cloud in scene.clouds(subject, choice)] == [TRUTH] * known
        assert (colour == "quads") <= bool(scene.pictures_of(subject, 1, colour))
    series = pixel.series_of(subject, (3, 4), 0)
    drawing = pixel.drawing(subject, series, 0)
    assert b"180" in drawing


def test_clouds_stand_beside_each_other(analytic):
    """Points at the distances along the rays; closed form left and truth right of ours."""
    found = {cloud.title: cloud for cloud in scene.clouds(analytic, POINTS)}
    assert [*found] == [CLOSED_FORM, OURS, TRUTH]
    camera = analytic.recording.camera(5)
    rays = camera.rays().numpy().reshape(-1, 3)
    ours = analytic.ours(5)["distance"].reshape(-1, 1) * rays
    np.testing.assert_allclose(found[OURS].points, ours, rtol=1e-4)
    aside = found[TRUTH].points - true_distance(5).reshape(-1, 1) * rays
    assert aside[:, 0].min() > 1.0
    np.testing.assert_allclose(aside, np.tile(aside[:1], (len(aside), 1)), atol=1e-5)
    assert found[CLOSED_FORM].points[:, 0].max() < found[OURS].points[:, 0].min()
    alone = scene.clouds(analytic, replace(POINTS, beside=False))
    assert [cloud.title for cloud in alone] == [OURS]
    assert {*scene.titles(analytic, POINTS)} == {OURS, CLOSED_FORM, TRUTH}
    marks = scene.marks(analytic, replace(POINTS, pixel=(5, 8)))
    for title, cloud in found.items():
        here = (cloud.pixels == (5, 8)).all(axis=1)
        np.testing.assert_allclose(marks[title], cloud.points[here][0], rtol=1e-4)


def test_a_click_meets_the_pixel_that_it_points_at(analytic):
    """From the camera along its rays, from aside, and past everything."""
    found = scene.clouds(analytic, replace(POINTS, beside=False))
    camera = analytic.recording.camera(5)
    for y, x in ((0, 0), (5, 8), (11, 19)):
        ray = camera.rays()[y, x].numpy()
        assert scene.pixel_on_ray(found, camera.centre, ray) == (y, x)
    eye, (y, x) = np.array([3.0, -1.0, 0.0]), (4, 12)
    toward = analytic.ours(5)["distance"][y, x] * camera.rays()[y, x].numpy() - eye
    assert scene.pixel_on_ray(found, eye, toward / np.linalg.norm(toward)) == (y, x)
    assert scene.pixel_on_ray(found, camera.centre, np.array([0.0, 0.0, -1.0])) is None


def test_the_quads_of_a_pixel_over_time(analytic):
    """Measured in the column of its slot only, fitted in all; dots and lines are drawn."""
    series = pixel.series_of(analytic, (5, 8), 5)
    assert series.frames.tolist() == [*range(14)]
    assert np.isfinite(series.measured).sum(axis=1).tolist() == [1] * 14
    for n in range(14):
        distance = true_distance(n)[5, 8]
        want = quad(distance, CANONICAL_SHIFTS[n % 4])
        assert series.measured[n, n % 4] == pytest.approx(want, abs=1e-6)
        rendered = [quad(distance + QUAD_ERROR, shift, distance) for shift in CANONICAL_SHIFTS]
        np.testing.assert_allclose(series.fit[n], rendered, atol=1e-6)
    svg = pixel.drawing(analytic, series, 5).decode()
    assert svg.count("h0") == 14, "a dot for every measured quad"
    assert all(f">{degrees}\N{DEGREE SIGN}<" in svg for degrees in (0, 90, 180, 270))
    alone = Subject(analytic.sequence, None, analytic.path)
    assert pixel.series_of(alone, (5, 8), 5).fit is None
    with pytest.raises(ValueError, match=r"pixel \(12, 0\) is outside of 12 x 20"):
        pixel.series_of(analytic, (12, 0), 5)


def test_splats_are_the_gaussians_of_the_time(fitted):
    """As many as exist, of unit quaternions, coloured by distance or by what is seen there."""
    subject = Subject.open(fitted)
    found = scene.splats(subject, Choice(frame=4))
    assert 0 < len(found.centre) <= len(subject.run.field)
    np.testing.assert_allclose(np.linalg.norm(found.quaternion, axis=1), 1.0, rtol=1e-5)
    assert (found.scale > 0).all()
    assert ((found.rgb >= 0) & (found.rgb <= 1)).all()
    assert len(np.unique(found.rgb, axis=0)) > 3
    errors = scene.splats(subject, Choice(frame=4, colour="error"))
    assert not np.array_equal(errors.rgb, found.rgb)
    assert scene.splats(subject, POINTS) is None
    assert scene.splats(Subject.open(subject.sequence.path), Choice()) is None


def test_a_newer_checkpoint_is_read(fitted, tmp_path, caplog):
    """Once; a damaged one is left, which is said, and the state before stays."""
    run = shutil.copytree(fitted, tmp_path / "run")
    subject = Subject.open(run)
    before = subject.run
    assert not subject.reload()
    stored = checkpoint.last(run)
    checkpoint.save(run, stored | {"images": stored["images"] + 4})
    assert subject.reload()
    assert subject.run is not before
    assert subject.run.config["images_optimised"] == 28
    assert not subject.reload()
    for path in checkpoint.folder(run).glob("*.pt"):
        path.write_bytes(b"nothing")
    (checkpoint.folder(run) / "0000000099.pt").write_bytes(b"nothing")
    assert newest(run).name != "0000000099.pt", "its SHA-256 is not written yet"
    with caplog.at_level(logging.WARNING, "gftorf_warp"):
        assert not subject.reload()
    assert "the newest checkpoint was not read" in caplog.text
    assert subject.run.config["images_optimised"] == 28


def test_what_is_chosen_is_drawn(window):
    """A slider, the play button and a click, each in the next step; nothing happens unasked."""
    assert window.step(0.0), "at first"
    assert not window.step(0.0)
    first = window.controls.shown.content
    window.controls.frame.value = 9
    assert window.step(5.0)
    assert window.controls.shown.content != first
    assert "raw frame 9 of 14" in window.controls.about.content
    window.controls.colour.value = "error"
    assert window.step(5.0)
    assert "error of closed form" in window.controls.shown.content
    camera = window.subject.recording.camera(9)
    drawn = window.controls.plot.content
    window.controls.beside.value = False
    window.pick(tuple(camera.centre), tuple(camera.rays()[3, 17].numpy()))
    while window.step(0.2):
        pass
    assert (
        window.controls.choice.pixel
        == (3, 17)
        == (window.controls.row.value, window.controls.column.value)
    )
    assert window.controls.plot.content != drawn
    window.controls.play.value = True
    for _ in range(3):
        window.step(1.0)
    assert int(window.controls.frame.value) in (10, 11, 12)
    svg = base64.b64decode(re.search(r"base64,([^\"]*)", window.controls.plot.content)[1])
    assert svg.startswith(b"<svg")


def test_it_listens_at_this_machine_only(window):
    """And a port in use is named."""
    from gftorf_warp.view.window import Window

    assert window.server.get_host() == "127.0.0.1"
    assert window.address == f"http://127.0.0.1:{window.port}"
    with socket.create_connection(("127.0.0.1", window.port), timeout=10):
        pass
    with pytest.raises(UsageError, match=f"port {window.port} cannot be opened"):
        Window(window.subject, window.port)
    with pytest.raises(UsageError, match="port 70000 cannot be opened"):
        Window(window.subject, 70000)


def test_what_cannot_be_viewed_is_named(analytic, tmp_path, monkeypatch, capsys):
    """No run and no sequence; no viser."""
    with pytest.raises(InputError, match="neither a run nor a sequence"):
        Subject.open(tmp_path)
    assert cli.main(["view", str(tmp_path / "nothing"), "-q"]) == 3
    assert "neither a run nor a sequence" in capsys.readouterr().err
    from gftorf_warp.view.window import Window

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'gftorf-warp\[view\]'"):
        Window(analytic)


def test_the_command_ends_with_ctrl_c(analytic, monkeypatch):
    """It says where it listens, and closes; SIGTERM keeps its exit code."""
    pytest.importorskip("viser", reason="no viser: pip install 'gftorf-warp[view]'")
    from gftorf_warp.view import command, window

    def interrupted(_):
        raise KeyboardInterrupt

    said = []
    monkeypatch.setattr(window.Window, "run", interrupted)
    command.view(analytic.sequence.path, say=said.append)
    address = re.search(r"http://127\.0\.0\.1:(\d+)", said[0])

    def terminated(_):
        raise Terminated

    monkeypatch.setattr(window.Window, "run", terminated)
    with pytest.raises(Terminated):
        command.view(analytic.sequence.path, say=said.append)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", int(address[1])), timeout=10)


def test_the_slider_moves_the_scene_in_a_browser(fitted):
    """Open, press an arrow key on the time slider: text and pixels of the scene change; click the
    middle of the scene, seen through the camera: its pixel is chosen.
    """
    pytest.importorskip("viser", reason="no viser: pip install 'gftorf-warp[view]'")
    from gftorf_warp.view.window import Window

    with browser() as tab:
        window, ended = Window(Subject.open(fitted)), threading.Event()

        def draw():
            while not ended.is_set():
                window.step(0.05)

        drawing = threading.Thread(target=draw)
        drawing.start()
        try:
            tab.resize(SIZE)
            tab.open(window.address)
            tab.until("document.body.innerText.includes('raw frame 0 of 14')")
            tab.until("document.querySelectorAll('img.picture').length === 3")
            before = settled(tab)
            tab.value("document.querySelectorAll('[role=slider]')[0].focus()")
            for _ in range(9):
                tab.press("ArrowRight")
            tab.until("document.body.innerText.includes('raw frame 9 of 14')")
            after = settled(tab)
            assert (np.abs(after - before).max(axis=-1) > 40).sum() > 100
            window.controls.row.value = window.controls.column.value = 0
            tab.value(LOOK_THROUGH)
            settled(tab)
            tab.click(*tab.value(MIDDLE_OF_SCENE))
            until(lambda: all(window.controls.choice.pixel))  # the row is set before the column
            y, x = window.controls.choice.pixel
            assert abs(y - 6) <= 1, "the middle of the image"
            assert abs(x - 10) <= 1
            assert not tab.problems
        finally:
            ended.set()
            drawing.join()
            window.close()
    collect_sockets()


def until(condition):
    """Wait until something is true."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "never"
        time.sleep(0.05)


def settled(tab):
    """The left half of the window, which shows the scene, as soon as it stays the same."""
    last, end = None, time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        image = tab.screenshot()[:, : SIZE[0] // 2].astype(int)
        coloured = np.ptp(image, axis=-1) > 40
        if last is not None and coloured.sum() > 500 and np.abs(image - last).max() < 8:
            return image
        last = image
    raise AssertionError("the scene does not come to rest")
