"""Interrupted recordings go on at the next raw frame, end with the same bytes,
and are never read as sequences.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import BusyError, InputError, UsageError
from gftorf_warp.sim import simulate as simulating
from gftorf_warp.sim.resume import partial_of
from gftorf_warp.sim.simulate import simulate

OPTIONS = {"size": (24, 18), "frames": 8, "seed": 3}
# Commands in processes of their own, forked after what they import. In a shell's background job
# SIGINT is ignored, and children inherit that.
COMMANDS = """
import json, os, signal, sys
from gftorf_warp.cli import main
from gftorf_warp.sim import simulate
for line in sys.stdin:
    words, errors = json.loads(line)
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.dup2(os.open(errors, os.O_WRONLY | os.O_CREAT), 2)
        os.dup2(2, 1)
        sys.exit(main(words))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def contents(folder):
    """Every file of a folder by relative name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def stop_after(frames):
    """Progress that ends a recording like Ctrl-C once so many raw frames are done."""

    def progress(done, _):
        if done == frames:
            raise KeyboardInterrupt

    return progress


def interrupted(out, scene="demo", frames=3, **more):
    """Leave a recording after ``frames`` raw frames."""
    with pytest.raises(KeyboardInterrupt):
        simulate(scene, out, **{**OPTIONS, **more}, progress=stop_after(frames))


@pytest.mark.parametrize(
    "more",
    [{}, {"engine": "mesh", "bounces": 1, "paths": 4}, {"scene": "tour", "format": "torf"}],
    ids=str,
)
def test_an_interrupted_recording_goes_on_with_the_same_bytes(tmp_path, more):
    """Only what was missing is made, and nobody can tell afterwards."""
    more = {"scene": "demo", **more}
    whole = simulate(
        more["scene"],
        tmp_path / "whole",
        **OPTIONS,
        **{k: v for k, v in more.items() if k != "scene"},
    )
    interrupted(tmp_path / "seq", **more)
    assert not (tmp_path / "seq").exists()
    done = []
    options = {**OPTIONS, **{k: v for k, v in more.items() if k != "scene"}}
    simulate(more["scene"], tmp_path / "seq", **options, progress=lambda n, _: done.append(n))
    assert done == [4, 5, 6, 7, 8], "raw frames that were finished were made again"
    assert contents(tmp_path / "seq") == contents(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seq", "whole"]


def test_what_is_unfinished_is_no_sequence(tmp_path):
    """Reading it is an error that says what it is and how to go on."""
    interrupted(tmp_path / "seq")
    with pytest.raises(InputError, match="unfinished") as caught:
        Sequence.open(partial_of(tmp_path / "seq"))
    assert "continues" in str(caught.value)


def test_another_command_is_refused_unless_fresh(tmp_path):
    """Half of one recording and half of another would be neither."""
    interrupted(tmp_path / "seq")
    before = contents(partial_of(tmp_path / "seq"))
    with pytest.raises(UsageError, match="--fresh"):
        simulate("demo", tmp_path / "seq", **{**OPTIONS, "seed": 4})
    assert contents(partial_of(tmp_path / "seq")) == before
    simulate("demo", tmp_path / "seq", **{**OPTIONS, "seed": 4}, fresh=True)
    assert contents(tmp_path / "seq") == contents(
        simulate("demo", tmp_path / "other", **{**OPTIONS, "seed": 4})
    )
    assert not partial_of(tmp_path / "seq").exists()


def test_fresh_begins_again_although_the_settings_are_the_same(tmp_path):
    """All frames are made, none is kept."""
    interrupted(tmp_path / "seq")
    done = []
    simulate("demo", tmp_path / "seq", **OPTIONS, fresh=True, progress=lambda n, _: done.append(n))
    assert done == [*range(1, 9)]


def test_a_damaged_file_is_made_again(tmp_path):
    """Cut off, empty, other bytes: the frame is not there, and the result is the same."""
    whole = simulate("demo", tmp_path / "whole", **OPTIONS)
    interrupted(tmp_path / "seq", frames=4)
    files = sorted(partial_of(tmp_path / "seq").glob("*.npz"))
    assert len(files) == 4
    files[0].write_bytes(files[0].read_bytes()[:200])
    files[1].write_bytes(b"")
    files[2].write_bytes(bytes(1000))
    data = bytearray(files[3].read_bytes())
    data[200] ^= 1
    files[3].write_bytes(bytes(data))
    simulate("demo", tmp_path / "seq", **OPTIONS)
    assert contents(tmp_path / "seq") == contents(whole)


def test_a_kill_while_the_settings_are_written_is_no_other_recording(tmp_path):
    """A temporary file, and nothing else, is there."""
    partial = partial_of(tmp_path / "seq")
    partial.mkdir()
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (partial / ".lock").touch()
    (partial / f".unfinished.md.tmp-{gone.pid}-0").write_text("# de")
    simulate("demo", tmp_path / "seq", **OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["seq"]


def test_a_kill_while_finished_images_are_removed_is_no_other_recording(tmp_path, monkeypatch):
    """Whatever is removed first of the folder."""

    def killed(folder, **_):
        (Path(folder) / "unfinished.md").unlink(missing_ok=True)
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", killed)
        with pytest.raises(SystemExit):
            simulate("demo", tmp_path / "seq", **OPTIONS)
    before = contents(tmp_path / "seq")
    simulate("demo", tmp_path / "seq", **OPTIONS)
    assert contents(tmp_path / "seq") == before
    assert [path.name for path in tmp_path.iterdir()] == ["seq"]


def test_two_processes_do_not_record_the_same(tmp_path):
    """The second is told who the first is."""

    def meanwhile(*_):
        simulate("demo", tmp_path / "seq", **OPTIONS)

    with pytest.raises(BusyError, match=str(os.getpid())):
        simulate("demo", tmp_path / "seq", **OPTIONS, progress=meanwhile)
    assert len(list(partial_of(tmp_path / "seq").glob("*.npz"))) == 1, (
        "the second removed what the first had made"
    )


def test_a_mistake_leaves_nothing(tmp_path, monkeypatch):
    """An error before the first raw frame is done leaves no folder, also none above it."""

    def broken(*_, **__):
        raise ValueError("no light")

    monkeypatch.setattr(simulating, "record", broken)
    with pytest.raises(ValueError, match="no light"):
        simulate("demo", tmp_path / "a" / "b", **OPTIONS)
    assert not any(tmp_path.iterdir())


def test_something_else_in_its_place_is_left_alone(tmp_path):
    """A folder of that name that no recording left is not touched, with or without --fresh."""
    (tmp_path / "seq.partial").mkdir()
    (tmp_path / "seq.partial" / "mine").write_text("mine")
    for fresh in (False, True):
        with pytest.raises(UsageError, match="is in use"):
            simulate("demo", tmp_path / "seq", **OPTIONS, fresh=fresh)
    assert contents(tmp_path) == {"seq.partial/mine": b"mine"}


def test_a_place_that_cannot_be_written_to_is_named_before_anything_is_made(tmp_path):
    """No frame is rendered for a folder that cannot be there."""
    (tmp_path / "file").write_text("mine")
    done = []
    with pytest.raises(UsageError, match="cannot write"):
        simulate("demo", tmp_path / "file" / "seq", **OPTIONS, progress=lambda *n: done.append(n))
    assert not done


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """What nobody stopped."""
    return simulate(
        "demo", tmp_path_factory.mktemp("undisturbed") / "seq", size=(64, 48), frames=16
    )


@pytest.fixture(scope="module")
def commands():
    """Starts commands: two lines, words and file of messages, to process id and exit code."""
    with subprocess.Popen(
        [sys.executable, "-c", COMMANDS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process


@pytest.mark.parametrize(
    "kind", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda s: s.name
)
def test_a_signal_loses_no_finished_frame(tmp_path, kind, undisturbed, commands):
    """The command line, stopped in the middle however hard,
    goes on and gives the bytes of one that was not.
    """
    words = ["simulate", "demo", "--size", "64x48", "--frames", "16", "--out"]
    errors = tmp_path / "errors.txt"
    line = json.dumps([[*words, str(tmp_path / "seq")], str(errors)])
    print(line, file=commands.stdin, flush=True)
    process = int(commands.stdout.readline())
    folder = partial_of(tmp_path / "seq")
    while len(list(folder.glob("*.npz")) if folder.exists() else []) < 3:
        os.kill(process, 0)  # an error if it has ended
        time.sleep(0.005)
    os.kill(process, kind)
    codes = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -signal.SIGKILL}
    assert int(commands.stdout.readline()) == codes[kind]
    assert kind == signal.SIGKILL or "the same command resumes it" in errors.read_text()
    kept = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    assert 3 <= len(kept) < 16, "the signal came too late to be a test"
    done = []
    simulate(
        "demo", tmp_path / "seq", size=(64, 48), frames=16, progress=lambda n, _: done.append(n)
    )
    assert len(done) == 16 - len(kept)
    assert contents(tmp_path / "seq") == contents(undisturbed)
    np.testing.assert_array_equal(
        Sequence.open(undisturbed).quads, Sequence.open(tmp_path / "seq").quads
    )


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (("demo", "--override", "sensor.f_mod_hz=0"), 2, "f_mod_hz"),
        (("demo", "--override", "sensor.exposure_s=-1"), 2, "exposure_s"),
        (("demo", "--override", "sensor.shifts=0,0,0,0"), 2, "shift"),
        (("demo", "--override", "sensor.shifts=0", "--format", "capture"), 2, "shift"),
        (("demo", "--frames", "0"), 2, "--frames"),
        (("demo", "--level", "L9"), 2, "--level"),
        (("demo", "--format", "zip"), 2, "--format"),
        (("missing.toml",), 3, "missing.toml"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_what_cannot_be_recorded_leaves_nothing(tmp_path, capsys, arguments, code, word):
    """Named, with the exit code of its kind; neither a folder nor a part of one."""
    assert main(["simulate", *arguments, "--size", "8x6", "--out", str(tmp_path / "seq")]) == code
    assert word in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
