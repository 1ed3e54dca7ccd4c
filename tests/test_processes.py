"""Pictures by processes: the files that threads write, their errors,
and nothing left of those who wrote.
"""

import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from analytic_run import FRAMES, AnalyticRun, interrupt
from test_writers import WHAT, files_in, scales_and_series

from gftorf_warp.data.exr import read_exr
from gftorf_warp.errors import ResourceError, UsageError
from gftorf_warp.evaluate import processes, writers
from gftorf_warp.evaluate.views import render_to_folder

needs_memory = pytest.mark.skipif(
    not hasattr(os, "memfd_create"), reason="no memory without a name on this system"
)
ALL = ("distance", "quads", "phasor", "colour")


@pytest.fixture
def analytic(tmp_path):
    """A finished run that renders by itself."""
    return AnalyticRun(tmp_path, colour=True)


@pytest.fixture
def started(monkeypatch):
    """Two processes whatever the machine has; the list of those that were started."""
    found, right = [], subprocess.Popen

    def popen(*arguments, **options):
        found.append(right(*arguments, **options))
        return found[-1]

    monkeypatch.setattr(processes, "useful", lambda _: 2)
    monkeypatch.setattr(processes.subprocess, "Popen", popen)
    yield found
    assert found
    assert all(process.returncode is not None for process in found), "one is still there"
    gc.collect()
    assert not open_memory(os.getpid())


def open_memory(pid):
    """How often a process holds the memory of pictures."""
    found = []
    for file in Path(f"/proc/{pid}/fd").glob("*"):
        try:
            found.append("gftorf-pictures" in os.readlink(file))
        except OSError:  # of whoever lists this folder
            continue
    return sum(found)


def test_few_images_or_cpus_are_left_to_threads(monkeypatch):
    """Starting a process takes as long as writing a hundred images."""
    monkeypatch.setattr(os, "memfd_create", lambda _: 0, raising=False)
    for cpus, want in ((1, 0), (processes.CPUS, 0), (16, 15), (256, processes.MOST)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=cpus: set(range(n)), raising=False)
        assert processes.useful(processes.MANY) == want
        assert processes.useful(processes.MANY - 1) == 0
    monkeypatch.delattr(os, "memfd_create")
    assert processes.useful(10_000) == 0


def written(run, out):
    """Files of all images of a run, and its progress."""
    seen = []
    folder = render_to_folder(run, out, ALL, progress=lambda *done: seen.append(done))
    return files_in(folder), seen


@pytest.fixture(scope="module")
def by_threads(tmp_path_factory):
    """A run, and what threads write of it."""
    folder = tmp_path_factory.mktemp("threads")
    run = AnalyticRun(folder, colour=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "useful", lambda _: 0)
        return run, written(run, folder / "out")


@needs_memory
@pytest.mark.parametrize(("count", "block", "limit"), [(1, 4, 1 << 23), (3, 5, 1 << 23), (2, 4, 1)])
def test_processes_write_what_threads_do(by_threads, tmp_path, monkeypatch, count, block, limit):
    """Byte by byte, of messages that the images fill or do not; progress counts up."""
    monkeypatch.setattr(processes, "BLOCK", block)
    monkeypatch.setattr(processes, "BLOCK_BYTES", limit)
    monkeypatch.setattr(processes, "useful", lambda total: count if total == FRAMES else 0)
    run, want = by_threads
    files, seen = written(run, tmp_path / "out")
    assert (files, seen) == want
    assert len(files) == 1 + 2 * len(ALL) * FRAMES
    assert seen == [(k + 1, FRAMES) for k in range(FRAMES)]
    assert not open_memory(os.getpid())


@needs_memory
def test_processes_load_neither_torch_nor_warp(analytic, tmp_path, started):
    """What is mapped into them while they write."""
    (tmp_path / "distance").mkdir()
    scales, series = scales_and_series(analytic)
    maps = []

    def looked_at():
        for index, images in enumerate(series):
            if index == FRAMES - 1:
                while not all((tmp_path / "distance" / f"{k:06d}.png").exists() for k in range(8)):
                    time.sleep(0.01)
                maps.extend(Path(f"/proc/{process.pid}/maps").read_text() for process in started)
            yield images

    writers.write_all(tmp_path, scales, looked_at(), FRAMES)
    assert len(maps) == 2
    for text in maps:
        assert "OpenEXR" in text
        assert "libtorch" not in text
        assert "warp.so" not in text


@needs_memory
def test_what_stops_a_process_is_the_error_of_the_command(analytic, tmp_path, started):
    """A name that is taken by a folder; nothing is left half-written, and nothing runs on."""
    (tmp_path / "distance" / "000005.png").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"000005\.png"):
        writers.write_all(tmp_path, *scales_and_series(analytic), FRAMES)
    assert len(started) == 2
    assert_whole(tmp_path / "distance")


@needs_memory
def test_a_disk_that_is_full_for_a_process(analytic, tmp_path, monkeypatch, started):
    """The error that threads have."""
    import resource

    (tmp_path / "distance").mkdir()
    right = processes.Writing.start

    def start(self, count):
        right(self, count)
        for process in started:
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (200, 200))

    monkeypatch.setattr(processes.Writing, "start", start)
    with pytest.raises(ResourceError, match="disk"):
        writers.write_all(tmp_path, *scales_and_series(analytic), FRAMES)
    assert not list((tmp_path / "distance").iterdir())


@needs_memory
@pytest.mark.parametrize("at", [0, 9])
def test_a_process_that_is_killed(analytic, tmp_path, started, at):
    """Before the first image or later: an error, and what it left half-written goes."""
    (tmp_path / "distance").mkdir()
    scales, series = scales_and_series(analytic)

    def with_murder():
        for index, images in enumerate(series):
            if index == at:
                started[1].kill()
                started[1].wait()
                (tmp_path / "distance" / f".000099.exr.tmp-{started[1].pid}-7").write_bytes(b"half")
            yield images

    with pytest.raises(ResourceError, match="signal 9"):
        writers.write_all(tmp_path, scales, with_murder(), FRAMES)
    assert_whole(tmp_path / "distance")


@needs_memory
def test_what_stops_the_rendering_stops_processes(analytic, tmp_path, started):
    """Whole pictures of some times."""
    interrupt(analytic, 13)
    with pytest.raises(KeyboardInterrupt):
        render_to_folder(analytic, tmp_path / "out", WHAT)
    assert started
    for name in WHAT:
        assert_whole(tmp_path / "out" / name)


def assert_whole(folder):
    """Every file below a folder is one."""
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]
    for path in folder.glob("*.exr"):
        read_exr(path)


STOPPED = """
import signal
import sys
from pathlib import Path

import numpy as np

from gftorf_warp.evaluate import processes, writers
from gftorf_warp.evaluate.pictures import Scale

# a shell's background job ignores the signal, and so do its children
signal.signal(signal.SIGINT, signal.default_int_handler)
scales = {"distance": Scale(low=0.0, high=1.0, colours="viridis", unit="m")}
processes.useful = lambda _: 3


def series():
    for k in range(10000):
        image = np.random.default_rng(k).random((240, 320), dtype=np.float32)
        yield {"distance": {"distance": image}}


progress = lambda done, _: print(done, flush=True)
writers.write_all(Path(sys.argv[1]), scales, series(), 10000, progress)
"""


def of_command(marker):
    """Processes with a variable of the environment: those that a command started."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if marker.encode() in path.read_bytes():
                found.append(int(path.parent.name))
        except OSError:  # it is gone, or not ours
            continue
    return found


@needs_memory
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_leaves_no_process(tmp_path, number):
    """Ctrl-C as from a terminal, and what nobody can catch: no half of a file,
    and an end of all.
    """
    folder = tmp_path / "distance"
    folder.mkdir()
    marker = f"GFTORF_TEST={tmp_path}"
    command = [sys.executable, "-c", STOPPED, str(tmp_path)]
    own = os.environ | {"GFTORF_TEST": str(tmp_path)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=own, process_group=0, **pipes) as process:
        for line in process.stdout:
            if int(line) >= 5:
                break
        before = of_command(marker)
        os.killpg(process.pid, number)
        _, said = process.communicate(timeout=60)
    assert len(before) == 4
    if number == signal.SIGINT:
        assert process.returncode != 0
        assert said.rstrip().endswith("KeyboardInterrupt")
        assert said.count("Traceback") == 1, "processes say nothing"
    else:
        assert (process.returncode, said) == (-number, "")
    patience = time.monotonic() + 20.0
    while number != signal.SIGINT and of_command(marker) and time.monotonic() < patience:
        time.sleep(0.01)
    assert not of_command(marker)
    assert 10 <= len(list(folder.iterdir())) < 10000
    assert_whole(folder)
