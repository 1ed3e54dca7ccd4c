"""Files beside the rendering: the same whoever writes them, whole or not there,
and errors that say what happened.
"""

import errno
import json
import mmap
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
from analytic_run import FRAMES, HEIGHT, WIDTH, AnalyticRun, interrupt
from test_replay import PLAIN, run  # noqa: F401

try:
    import fcntl
except ImportError:  # not a Unix
    fcntl = None

from gftorf_warp.data import files, resources
from gftorf_warp.data.exr import read_exr
from gftorf_warp.errors import ResourceError, UsageError
from gftorf_warp.evaluate import previews, stored, views, writers
from gftorf_warp.evaluate.views import render_to_folder

WHAT = ("distance", "quads")


@pytest.fixture
def analytic(tmp_path):
    """A finished run that renders by itself."""
    return AnalyticRun(tmp_path)


def files_in(folder):
    """Content of every file below a folder, by its name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_threads_write_what_one_call_after_the_other_does(analytic, tmp_path, monkeypatch):
    """Byte by byte: more threads than images, or one; progress counts up."""
    seen, found = [], {}
    for threads in (1, 20):
        monkeypatch.setattr(writers, "THREADS", threads)
        out = render_to_folder(
            analytic, tmp_path / str(threads), WHAT, progress=lambda *done: seen.append(done)
        )
        found[threads] = files_in(out)
    assert found[1] == found[20]
    assert len(found[1]) == 1 + 4 * FRAMES
    assert seen == 2 * [(k + 1, FRAMES) for k in range(FRAMES)]
    scales, series = scales_and_series(analytic)
    (tmp_path / "plain" / "distance").mkdir(parents=True)
    taken = [(k / 120, analytic.camera) for k in range(FRAMES)]
    labels = views.labels_of(taken, analytic.sequence())
    for index, images in enumerate(series):
        writers.write_images(tmp_path / "plain", scales, index, images, labels)
    assert {name: found[1][name] for name in files_in(tmp_path / "plain")} == files_in(
        tmp_path / "plain"
    )


def scales_and_series(of):
    """What ``render_to_folder`` hands on."""
    render, times = of.renderer(), [k / 120 for k in range(FRAMES)]
    few = [(times[k], of.camera) for k in (0, FRAMES // 2, -1)]
    samples = list(views.series_of(render, few, of.sensor, ("distance",)))
    scales = {
        "distance": previews.preview_scale("distance", [sample["distance"] for sample in samples])
    }
    return scales, views.series_of(
        render, [(time, of.camera) for time in times], of.sensor, ("distance",)
    )


def test_what_stops_a_thread_is_the_error_of_the_command(analytic, tmp_path):
    """A name that is taken by a folder; nothing is left half-written, and nothing runs on."""
    (tmp_path / "distance" / "000005.png").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"000005\.png"):
        writers.write_all(tmp_path, *scales_and_series(analytic), FRAMES)
    assert not list((tmp_path / "distance").glob(".*"))
    for path in (tmp_path / "distance").glob("*.exr"):
        assert read_exr(path)["distance"].shape == (HEIGHT, WIDTH)


def test_not_more_images_wait_than_memory_holds(analytic, tmp_path, monkeypatch):
    """Rendering is faster than writing: it stops until something is written."""
    (tmp_path / "distance").mkdir()
    monkeypatch.setattr(writers, "THREADS", 1)
    rendered, written, ahead = [0], [0], []
    scales, series = scales_and_series(analytic)

    def counted():
        for images in series:
            rendered[0] += 1
            ahead.append(rendered[0] - written[0])
            yield images

    right = writers.write_images

    def slow(*arguments):
        time.sleep(0.02)
        right(*arguments)
        written[0] += 1

    monkeypatch.setattr(writers, "write_images", slow)
    writers.write_all(tmp_path, scales, counted(), FRAMES)
    assert 2 < max(ahead) <= writers.QUEUED + 2
    assert written[0] == FRAMES


def test_arrays_hold_what_pictures_hold(analytic, tmp_path, monkeypatch):
    """Every channel of every image, mapped or read; written again into the same folder,
    and not over pictures.
    """
    monkeypatch.setattr(stored, "BLOCK", 8)
    pictures = render_to_folder(analytic, tmp_path / "pictures", WHAT)
    seen = []
    out = render_to_folder(
        analytic, tmp_path / "out", WHAT, arrays=True, progress=lambda *done: seen.append(done)
    )
    names = {f"quads/quad_{degrees}.npy" for degrees in ("000", "180", "090", "270")}
    assert (
        set(files_in(out))
        == {"renders.json", "distance/distance.npy", "distance/opacity.npy"} | names
    )
    for name, channels in json.loads((out / "renders.json").read_text())["channels"].items():
        for channel in channels:
            array = np.load(out / name / f"{channel}.npy", mmap_mode="r")
            assert (array.shape, array.dtype) == ((FRAMES, HEIGHT, WIDTH), np.dtype("<f4"))
            assert array.offset == stored.HEADER
            for k in range(FRAMES):
                np.testing.assert_array_equal(
                    array[k], read_exr(pictures / name / f"{k:06d}.exr")[channel]
                )
    assert seen == [(stored.BLOCK, FRAMES), (FRAMES, FRAMES)]
    before = files_in(out)
    assert files_in(render_to_folder(analytic, out, WHAT, arrays=True)) == before
    with pytest.raises(UsageError, match="other"):
        render_to_folder(analytic, pictures, WHAT, arrays=True)
    with pytest.raises(UsageError, match="other"):
        render_to_folder(analytic, out, WHAT)


def test_arrays_of_a_replay(run, tmp_path, monkeypatch):  # noqa: F811
    """Through memory that is used again, of more images than are held at a time:
    those of single calls.
    """
    monkeypatch.setattr(stored, "BLOCK", 3)
    monkeypatch.setattr(stored, "HELD", 2 * 3 + 2)
    times = [float(time) for time in np.linspace(0.0, 0.07, 60)]
    cameras = [run.camera] * len(times)
    monkeypatch.setattr(views, "views_to_take", lambda *_: (times, cameras))
    monkeypatch.setattr(type(run), "sequence", lambda _: None)
    out = render_to_folder(
        run, tmp_path / "out", ("distance", "phasor", "colour"), times, arrays=True
    )
    render = run.renderer((*PLAIN, "colour"))
    found = {
        name: np.load(out / f"{name}.npy")
        for name in ("distance/distance", "phasor/im", "colour/B")
    }
    for k, time_s in enumerate(times):
        want = render(time_s, run.camera)
        np.testing.assert_array_equal(found["distance/distance"][k], want.distance.cpu().numpy())
        np.testing.assert_array_equal(found["phasor/im"][k], want.phasor[1].cpu().numpy())
        np.testing.assert_array_equal(found["colour/B"][k], want.colour[2].cpu().numpy())


@pytest.mark.parametrize("taken", [0, 1, 100, 4 * 35, 4 * 35 + 3, 8 * 35])
def test_arrays_are_whole_where_the_system_takes_a_part(tmp_path, monkeypatch, taken):
    """A call may write less than it is given, and some systems have no call for several images."""
    images = np.random.default_rng(0).random((3, 5, 7), dtype=np.float32)
    monkeypatch.setattr(
        os, "writev", lambda file, rows: os.write(file, b"".join(rows)[:taken]), raising=False
    )
    if not taken:
        monkeypatch.delattr(os, "writev")
        monkeypatch.delattr(os, "posix_fadvise", raising=False)
    with stored.Stored(tmp_path / "a.npy", images.shape) as file:
        file.write(1, images[1:])
        file.write(0, images[:1])
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), images)


def on_pages(count, height, width):
    """Images that start where pages do, as those of a renderer: no two are the same."""
    images = np.frombuffer(mmap.mmap(-1, 4 * count * height * width), dtype=np.float32).reshape(
        count, height, width
    )
    images[:] = np.random.default_rng(1).random(images.shape, dtype=np.float32)
    return images


@pytest.mark.skipif(not stored.DIRECT, reason="no such writing on this system")
@pytest.mark.parametrize("code", [errno.EINVAL, errno.EFAULT])
@pytest.mark.parametrize("refused", [(), (0,), (1,), (0, 1, 2)])
def test_arrays_past_the_systems_memory(tmp_path, monkeypatch, refused, code):
    """What the disk does not take as it is, it gets as other programs write;
    the same file in any case.
    """
    images, direct = on_pages(6, 32, 64), []
    right = os.writev

    def writev(file, rows):
        direct.append(bool(fcntl.fcntl(file, fcntl.F_GETFL) & stored.DIRECT))
        if direct[-1] and len(direct) - 2 in refused:
            raise OSError(code, os.strerror(code))
        return right(file, rows)

    monkeypatch.setattr(os, "writev", writev)
    with stored.Stored(tmp_path / "a.npy", images.shape) as file:
        for first in (0, 2, 4):
            file.write(first, images[first : first + 2])
    found = np.load(tmp_path / "a.npy", mmap_mode="r")
    np.testing.assert_array_equal(found, images)
    assert (tmp_path / "a.npy").stat().st_size == stored.HEADER + images.nbytes
    assert direct[0] is False, "the header comes from anywhere"
    if direct[1]:  # this file system has it
        at = min(refused, default=None)
        assert direct[1:] == ([True] * 3 if at is None else [True] * (at + 1) + [False] * (3 - at))


def test_arrays_of_any_size_and_address(tmp_path):
    """No multiple of what disks count in, in memory that starts anywhere."""
    images = np.random.default_rng(2).random((5, 7, 9), dtype=np.float32)[:, :, 1:]
    with stored.Stored(tmp_path / "a.npy", images.shape) as file:
        file.write(0, images)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), images)


def test_an_error_of_the_disk_is_no_reason_to_try_again(tmp_path, monkeypatch):
    """Only what the disk cannot take as it is is given to it in another way."""
    calls = []

    def writev(file, rows):
        calls.append(len(rows))
        if len(calls) > 1:
            raise OSError(errno.EIO, "Input/output error")
        return os.write(file, b"".join(rows))

    monkeypatch.setattr(os, "writev", writev, raising=False)
    with (
        pytest.raises(UsageError, match="Input/output"),
        stored.Stored(tmp_path / "a.npy", (2, 4, 4)) as file,
    ):
        file.write(0, np.zeros((2, 4, 4), dtype=np.float32))
    assert calls == [1, 2]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("limit", [stored.BLOCK_BYTES, 3 * 2 * 64])
def test_of_arrays_two_blocks_are_held(tmp_path, monkeypatch, limit):
    """One that is written and one that comes next, of fewer images where they are large:
    what a renderer reserves.
    """
    monkeypatch.setattr(stored, "BLOCK", 4)
    monkeypatch.setattr(stored, "BLOCK_BYTES", limit)
    held, most, calls = weakref.WeakSet(), [], []
    right = stored.Stored.write

    def slow(file, first, images):
        calls.append(len(images))
        time.sleep(0.005)
        right(file, first, images)

    class Image(np.ndarray):
        """One that can be told from others."""

        __hash__ = object.__hash__

    def series():
        for k in range(30):
            both = np.full((2, 4, 4), k, dtype=np.float32).view(Image)
            held.add(both)
            most.append(len(held))
            yield {"distance": {"distance": both[0], "opacity": both[1]}}
            del both

    monkeypatch.setattr(stored.Stored, "write", slow)
    (tmp_path / "distance").mkdir()
    stored.store_all(tmp_path, {"distance": ("distance", "opacity")}, series(), (30, 4, 4))
    block = 4 if limit > 1000 else 3
    assert set(calls) <= {block, 30 % block}
    assert len(calls) == 2 * -(-30 // block)
    assert block < max(most) <= 2 * block + 1
    found = np.load(tmp_path / "distance" / "opacity.npy")
    np.testing.assert_array_equal(found, np.broadcast_to(np.arange(30)[:, None, None], found.shape))


def test_the_cost_of_a_picture_does_not_grow_with_those_before_it(analytic, tmp_path, monkeypatch):
    """A folder is listed and flushed once, however many files come into it;
    what a dead process left there goes.
    """
    listed, flushed = [], []
    right = os.listdir, files.flush_folder
    monkeypatch.setattr(
        files.os, "listdir", lambda folder: listed.append(Path(folder).name) or right[0](folder)
    )
    monkeypatch.setattr(
        files, "flush_folder", lambda folder: flushed.append(Path(folder).name) or right[1](folder)
    )
    for name in WHAT:
        (tmp_path / name).mkdir()
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / "quads" / f".000001.exr.tmp-{dead.pid}-0").write_bytes(b"cut off")
    (tmp_path / "quads" / f".000002.exr.tmp-{os.getpid()}-999999").write_bytes(b"being written")
    render, times = analytic.renderer(), [k / 120 for k in range(FRAMES)]
    (images,) = views.series_of(render, [(0.0, analytic.camera)], analytic.sensor, WHAT)
    scales = {name: previews.preview_scale(name, [images[name]]) for name in WHAT}
    views_taken = [(time, analytic.camera) for time in times]
    writers.write_all(
        tmp_path, scales, views.series_of(render, views_taken, analytic.sensor, WHAT), FRAMES
    )
    assert sorted(name for name in listed if name in WHAT) == sorted(flushed) == sorted(WHAT)
    assert len(list((tmp_path / "distance").iterdir())) == 2 * FRAMES
    left = [path.name for path in (tmp_path / "quads").iterdir() if path.name.startswith(".")]
    assert left == [f".000002.exr.tmp-{os.getpid()}-999999"]


@pytest.mark.parametrize("arrays", [True, False])
def test_what_stops_the_rendering_leaves_nothing_half_written(analytic, tmp_path, arrays):
    """Ctrl-C in the middle: whole pictures of some times, or no array at all."""
    interrupt(analytic, 13)
    with pytest.raises(KeyboardInterrupt):
        render_to_folder(analytic, tmp_path / "out", WHAT, arrays=arrays)
    left = [
        path
        for path in (tmp_path / "out").rglob("*")
        if path.is_file() and path.name != "renders.json"
    ]
    assert not [path for path in left if path.name.startswith(".") or path.suffix == ".npy"]
    for path in left:
        if path.suffix == ".exr":
            read_exr(path)
    assert arrays == (not left)
    assert not [
        one.name
        for one in threading.enumerate()
        if one.name.startswith(("gftorf-files", "gftorf-arrays"))
    ]


def test_a_disk_that_cannot_hold_the_arrays(analytic, tmp_path, monkeypatch):
    """Said before anything is written; one that fills up on the way is an error of the file."""
    usage = type("Usage", (), {"free": 10_000})
    for arrays in (True, False):
        with monkeypatch.context() as patch:
            patch.setattr(resources.shutil, "disk_usage", lambda _: usage)
            with pytest.raises(ResourceError, match="not enough disk space"):
                render_to_folder(analytic, tmp_path / "out", WHAT, arrays=arrays)
        assert not (tmp_path / "out").exists()

    class Full(stored.FileIO):
        def write(self, data):
            if len(data) == 4 * WIDTH * HEIGHT - 10:
                raise OSError(28, "No space left on device")
            return super().write(data)

    monkeypatch.setattr(stored, "FileIO", Full)
    monkeypatch.setattr(
        os, "writev", lambda file, rows: os.write(file, rows[0][:10]), raising=False
    )
    with pytest.raises(ResourceError, match="no space left"):
        render_to_folder(analytic, tmp_path / "out", WHAT, arrays=True)
    assert not list((tmp_path / "out").rglob("*.npy*"))


INTERRUPTED = """
import signal
import sys
from pathlib import Path

import numpy as np

from gftorf_warp.evaluate import writers
from gftorf_warp.evaluate.pictures import Scale

# a shell's background job ignores the signal, and so do its children
signal.signal(signal.SIGINT, signal.default_int_handler)
scales = {"distance": Scale(low=0.0, high=1.0, colours="viridis", unit="m")}


def series():
    for k in range(10000):
        image = np.random.default_rng(k).random((240, 320), dtype=np.float32)
        yield {"distance": {"distance": image}}


progress = lambda done, _: print(done, flush=True)
writers.write_all(Path(sys.argv[1]), scales, series(), 10000, progress)
"""


@pytest.mark.skipif(os.name == "nt", reason="sends a signal as a terminal does")
def test_ctrl_c_ends_threads_between_images(tmp_path):
    """A signal as from a terminal, to a program: no half of a file, and an end."""
    (tmp_path / "distance").mkdir()
    command = [sys.executable, "-c", INTERRUPTED, str(tmp_path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0
    ) as process:
        for line in process.stdout:
            if int(line) >= 5:
                break
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT
    assert said.rstrip().endswith("KeyboardInterrupt")
    left = sorted((tmp_path / "distance").iterdir())
    assert len(left) < 10000
    assert not [path.name for path in left if path.name.startswith(".")]
    assert {path.with_suffix(".png") for path in left} == set(left) - {
        path for path in left if path.suffix == ".exr"
    }
    time.sleep(0.2)
    assert sorted((tmp_path / "distance").iterdir()) == left, "nobody writes any more"
