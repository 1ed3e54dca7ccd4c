"""Spoiled run folders and impossible numbers: every command ends with an error that says what to
do, never with a traceback, and never waits for a pipe.
"""

import os
import signal
from dataclasses import replace

import pytest
from moving_box import recording
from spoiled import copied, set_value, spoil

from gftorf_warp.cli import main
from gftorf_warp.data.sequence import Flow
from gftorf_warp.data.write import write

SEEDS = range(18)
CONFIGS = {
    "nothing": "{}",
    "a list": "[]",
    "brackets": 5000 * "[",
    "bytes": "\x00\x01",
}
VALUES = {
    "camera.width": "sixteen",
    "camera.height": 10**30,
    "camera.camera_from_world": [1],
    "camera.cy": None,
    "sensor.f_mod_hz": 1e300,
    "sensor.dc_offset": [1],
    "sequence": 1e300,
    "size_optimised": 0,
    "quad_scale": -1,
    "settings.render.support": "some",
    "settings.method": [],
    "images": "many",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished and compared run of two quartets of 16x12 pixels."""
    place = tmp_path_factory.mktemp("made")
    sequence, truth = recording(frames=8)
    small = replace(
        sequence,
        quads=sequence.quads[:, ::3, ::3],
        intrinsics=sequence.intrinsics.scaled(1 / 3, 1 / 3),
        flow=Flow(),
    )
    write("ftorf", place / "seq", small, replace(truth, distance=truth.distance[:, ::3, ::3]))
    assert main(reconstruct(place, place / "run")) == 0
    assert main(["compare", str(place / "run"), "--device", "cpu", "-q"]) == 0
    return place / "run"


@pytest.fixture(autouse=True)
def no_waiting():
    """A command that blocks on a pipe fails instead of holding up all other tests."""
    before = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def _too_long(*_):
    raise AssertionError("the command waits for ever")


def reconstruct(place, run):
    """The command that made the run."""
    words = ["reconstruct", str(place / "seq"), "--out", str(run), "--preset", "demo"]
    return [*words, "--images", "8", "--device", "cpu", "-q"]


def commands(made, run):
    """What may be done with a run."""
    device = ["--device", "cpu", "-q"]
    yield ["compare", str(run), *device]
    yield reconstruct(made.parent, run)
    yield ["render", str(run), "--out", str(run.parent / "out"), "--fresh", *device]


def ends_well(command, capsys, what):
    """Exit code of a command, which prints three lines if it is not 0."""
    capsys.readouterr()
    code = main(command)
    err = capsys.readouterr().err
    assert code in (0, 2, 3, 5), (what, command[0], err)
    if code:
        assert [line[:7] for line in err.splitlines()[-3:]] == ["error: ", "  why: ", "  fix: "], (
            err
        )
    return code


@pytest.mark.parametrize("seed", SEEDS)
def test_a_spoiled_run_is_named_or_harmless(run, tmp_path, capsys, seed):
    """One thing is changed, removed or replaced by something that is no file."""
    command = [*commands(run, tmp_path / "run")][seed % 3]
    what = spoil(copied(run, tmp_path / "run"), seed)
    ends_well(command, capsys, what)


@pytest.mark.parametrize("text", CONFIGS.values(), ids=CONFIGS)
def test_a_config_of_something_else_is_no_run(run, tmp_path, capsys, text):
    """For every command."""
    for command in commands(run, tmp_path / "run"):
        (copied(run, tmp_path / "run") / "config.json").write_text(text)
        assert ends_well(command, capsys, text[:20]) in (2, 3)


@pytest.mark.parametrize("name", VALUES)
def test_a_wrong_value_of_a_config_is_named(run, tmp_path, capsys, name):
    """With its key where it is one of our own."""
    copied(run, tmp_path / "run")
    set_value(tmp_path / "run" / "config.json", name, VALUES[name])
    for command in (["compare", str(tmp_path / "run"), "-q"], ["render", str(tmp_path / "run")]):
        out = ["--out", str(tmp_path / "out"), "-q"] if command[0] == "render" else []
        assert ends_well([*command, *out, "--device", "cpu"], capsys, name) == 3


def test_rows_that_are_none_are_named(run, tmp_path, capsys):
    """With the number of the line; a line that a crash cut off is dropped."""
    path = copied(run, tmp_path / "run") / "metrics.jsonl"
    path.write_text('{"images": 4, "seconds": 1, "loss": 1}\n{"images": 8, "lo')
    assert main(["compare", str(tmp_path / "run"), "--device", "cpu", "-q"]) == 0
    for row in ('{"images": "eight"}', '{"loss": 1}', '{"images": 8, "loss": 1e999}', "[1]"):
        path.write_text(f'{{"images": 4, "loss": 1}}\n{row}\n')
        capsys.readouterr()
        assert main(["compare", str(tmp_path / "run"), "--device", "cpu", "-q"]) == 3
        assert "line 2" in capsys.readouterr().err


def test_a_log_that_is_a_pipe_is_not_waited_for(run, tmp_path, capsys):
    """Nobody reads what would be appended to it."""
    path = copied(run, tmp_path / "run") / "run.log"
    path.unlink()
    os.mkfifo(path)
    assert ends_well(reconstruct(run.parent, tmp_path / "run"), capsys, "pipe") == 3


@pytest.mark.parametrize(
    "override",
    [
        "sensor.ambient_electrons=1e300",
        "sensor.exposure_s=1e15",
        "sensor.f_mod_hz=1e300",
        "sensor.f_mod_hz=20",
        "sensor.contrast_cutoff_hz=1e-300",
        "sensor.frame_period_s=1e300",
        "bodies.1.path.velocity=1e300,1e300,1e300",
        "bodies.1.texture.high=1e300",
    ],
)
def test_a_number_of_nothing_that_exists_is_named(tmp_path, capsys, override):
    """Nothing is left of such a recording."""
    words = ["simulate", "demo", "--size", "8x6", "--frames", "4", "--override", override]
    code = ends_well([*words, "--out", str(tmp_path / "seq"), "-q"], capsys, override)
    assert code == 2
    assert not any(tmp_path.iterdir())


def test_a_name_that_is_not_utf8_is_refused(tmp_path, capsys):
    """JSON, EXR and HTML could not hold it."""
    name = os.fsdecode(os.fsencode(tmp_path) + b"/s\xff")
    words = ["simulate", "demo", "--size", "8x6", "--frames", "4", "-q", "--out", name]
    assert ends_well(words, capsys, "name") == 2
    assert not any(tmp_path.iterdir())
