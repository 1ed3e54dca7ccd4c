"""What the command line accepts, prints and returns. Quality is not its business:
everything runs at tiny size.
"""

import argparse
import errno
import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gftorf_warp import __version__, cli, options
from gftorf_warp.errors import (
    BusyError,
    DivergedError,
    InputError,
    ResourceError,
    Terminated,
    UsageError,
)
from gftorf_warp.evaluate.printed import table

SIZE, FRAMES = "32x24", "8"
HEAVY = ("torch", "warp", "numpy", "matplotlib", "cv2", "scipy")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A tiny sequence written by the command line."""
    path = tmp_path_factory.mktemp("cli") / "sequence"
    assert (
        cli.main(
            [
                "simulate",
                "demo",
                "--out",
                str(path),
                "--size",
                SIZE,
                "--frames",
                FRAMES,
                "--seed",
                "3",
            ]
        )
        == 0
    )
    return path


@pytest.fixture(scope="module")
def run(sequence):
    """A tiny reconstruction of it, far from finished."""
    path = sequence.parent / "run"
    arguments = [
        "reconstruct",
        str(sequence),
        "--out",
        str(path),
        "--preset",
        "best",
        "--images",
        "40",
    ]
    assert cli.main([*arguments, "--seed", "1", "--device", "cpu"]) == 0
    return path


def lines_of(capsys):
    """What was printed: results and messages."""
    captured = capsys.readouterr()
    return captured.out.splitlines(), captured.err.splitlines()


def fails(arguments, code, capsys, *words):
    """A command ends with an exit code and three lines that contain some words."""
    assert cli.main(arguments) == code
    out, err = lines_of(capsys)
    assert not out
    what, why, fix = err[-3:]
    assert what.startswith("error: ")
    assert why.startswith("  why: ")
    assert fix.startswith("  fix: ")
    assert not any("Traceback" in line for line in err)
    for word in words:
        assert word in "\n".join(err[-3:]), f"{word!r} is not in {err[-3:]}"


# -- parsing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [["--help"], ["reconstruct", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments):
    """`gftorf --help` is instant because it loads neither torch nor Warp nor any other library."""
    code = (
        f"import sys; from gftorf_warp.cli import main; c = main({arguments}); print(c, "
        f"*sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    code, *modules = done.stdout.splitlines()[-1].split()
    assert code == "0"
    assert "gftorf_warp.options" in modules
    assert not {name.partition(".")[0] for name in modules} & set(HEAVY)


def test_what_was_loaded_is_not_searched_for_garbage():
    """Not while a command runs; who called it from Python has the collector as before."""
    enabled = gc.isenabled()
    try:
        cli.start(argparse.Namespace(device="cpu"), compile_first=False)
        assert gc.isenabled() == enabled
        assert gc.get_freeze_count() > 10_000
    finally:
        cli.main(["--version"])
    assert gc.get_freeze_count() < 10_000


def test_help_names_every_command(capsys):
    """The top page lists what there is."""
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in (
        "demo",
        "simulate",
        "reconstruct",
        "render",
        "export",
        "compare",
        "check",
        "doctor",
        "bench",
    ):
        assert f"\n  {name} " in text
        assert name in cli.COMMANDS
    assert set(options.command_parsers()) == set(cli.COMMANDS)


def test_module_and_script_are_the_same():
    """`python -m gftorf_warp` ends like `gftorf`."""
    done = subprocess.run(
        [sys.executable, "-m", "gftorf_warp", "--version"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"gftorf_warp {__version__}\n"
    wrong = subprocess.run(
        [sys.executable, "-m", "gftorf_warp", "nonsense"], check=False, stderr=subprocess.PIPE
    )
    assert wrong.returncode == 2


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("demo", "out", "gftorf-demo"),
        ("demo --device cuda", "device", "cuda"),
        ("simulate S --out Q --size 96x72", "size", (96, 72)),
        ("simulate S --out Q --frames 10 --seed 7 --format ftorf", "seed", 7),
        ("simulate --list", "list", True),
        ("simulate S --out Q --level L2", "level", "L2"),
        ("simulate S --out Q --ladder --format capture", "ladder", True),
        ("compare R --against static-phasor", "against", "static-phasor"),
        ("simulate S --out Q --engine mesh --bounces 2 --paths 8 --device cpu", "bounces", 2),
        (
            "simulate S --out Q --sync --no-noise --flow --exposure-samples 3 --fresh",
            "exposure_samples",
            3,
        ),
        (
            "reconstruct SEQ --out RUN --preset demo --images 100 --seed 2 --device cpu --fresh",
            "images",
            100,
        ),
        ("reconstruct SEQ --out RUN --frame-rate 60", "frame_rate", 60.0),
        ("reconstruct SEQ --out RUN --flow dis", "flow", "dis"),
        (
            "render RUN --out DIR --what distance,quads,phasor,colour",
            "what",
            ["distance", "quads", "phasor", "colour"],
        ),
        ("render RUN --out DIR --times 0.1,0.2", "times", [0.1, 0.2]),
        ("render RUN --out DIR", "times", None),
        ("export RUN --out DIR --format ply --every 2", "formats", ["ply"]),
        ("compare RUN --truth SEQ --json", "truth", "SEQ"),
        ("compare --json RUN", "runs", ["RUN"]),
        ("check SEQ", "sequence", "SEQ"),
        ("doctor", "command", "doctor"),
        ("bench", "parts", []),
        ("bench step render --quick --json FILE", "parts", ["step", "render"]),
        ("bench --sequence SEQ --run RUN --images 8 --device cpu", "images", 8),
        ("-q check SEQ", "quiet", True),
    ],
)
def test_options_as_documented(text, name, value):
    """The exact spellings that other tools rely on."""
    assert getattr(options.parse(text.split()), name) == value


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("simulat demo", "did you mean simulate?"),
        ("simulate demo --sise 3x4", "did you mean --size?"),
        ("simulate demo --out X --size 96", "96x72"),
        ("simulate demo --out X --size 0x4", "width and a height"),
        ("simulate demo --out X --frames 0", "at least 1"),
        ("simulate demo --out X --seed -1", "whole number"),
        ("simulate demo", "--out SEQ"),
        ("simulate", "SCENE"),
        ("reconstruct SEQ", "--out"),
        ("reconstruct SEQ --out R --frame-rate 0", "above 0"),
        ("render RUN --out D --times 0.1,soon", "not a number"),
        ("render RUN --out D --times nan", "not a number"),
        ("demo --device gpu", "cuda:N"),
        ("demo --out", "--out"),
        ("demo extra", "unknown argument extra"),
        ("demo -q -v", "not allowed with"),
        ("check", "SEQ"),
        ("", "gftorf --help"),
    ],
)
def test_wrong_options_end_with_2_and_a_hint(text, hint, capsys):
    """A slip of the finger costs three lines, and nothing is imported or written."""
    fails(text.split(), 2, capsys, hint)


# -- errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [UsageError, InputError, DivergedError, ResourceError, BusyError])
def test_our_errors_become_three_lines_and_their_code(kind, monkeypatch, capsys):
    """Each class has its exit code."""

    def command(_):
        raise kind("something", where="there", why="because", fix="do this")

    monkeypatch.setitem(cli.COMMANDS, "check", command)
    fails(["check", "SEQ"], kind.exit_code, capsys, "something - there", "because", "do this")


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), 5, "out of memory"),
        (
            RuntimeError(
                "DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"
            ),
            5,
            "out of memory",
        ),
        (OSError(errno.ENOSPC, "No space left on device", "run/a.npy"), 5, "run/a.npy"),
        (PermissionError(errno.EACCES, "Permission denied", "run"), 3, "Permission denied"),
    ],
)
def test_errors_of_the_machine_become_ours(error, code, words, monkeypatch, capsys):
    """A full disk or memory is nothing to be debugged."""

    def command(_):
        raise error

    monkeypatch.setitem(cli.COMMANDS, "check", command)
    fails(["check", "SEQ"], code, capsys, words)


def test_a_bug_is_one_line_unless_debug_is_on(monkeypatch, capsys):
    """An error that no user can cause says so, and where to look."""

    def command(_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setitem(cli.COMMANDS, "check", command)
    assert cli.main(["check", "SEQ"]) == 1
    out, err = lines_of(capsys)
    assert not out
    assert err == ["error: unexpected ZeroDivisionError: division by zero; --debug shows where"]
    assert cli.main(["check", "SEQ", "--debug"]) == 1
    _, err = lines_of(capsys)
    assert err[0].startswith("Traceback")
    assert err[-1].endswith("division by zero")


def test_interruption_ends_with_130(monkeypatch, capsys):
    """Ctrl-C is no error."""

    def command(_):
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.COMMANDS, "check", command)
    assert cli.main(["check", "SEQ"]) == 130
    _, err = lines_of(capsys)
    assert len(err) == 1
    assert err[0].startswith("interrupted")


@pytest.mark.parametrize(("stop", "code"), [(KeyboardInterrupt, 130), (Terminated, 143)])
def test_interruption_that_a_library_turns_into_an_error_is_one(monkeypatch, capsys, stop, code):
    """Warp makes a RuntimeError of what stops the assembly of an array of structs."""

    def command(_):
        try:
            raise stop
        except BaseException:
            raise RuntimeError("Invalid source data type for array of structs")  # noqa: B904

    monkeypatch.setitem(cli.COMMANDS, "check", command)
    assert cli.main(["check", "SEQ"]) == code
    _, err = lines_of(capsys)
    assert len(err) == 1
    assert err[0].endswith("the same command resumes it")


def test_cuda_asked_for_and_absent(monkeypatch, capsys):
    """`--device cuda` never falls back silently; `auto` does, and says why."""
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    fails(["doctor", "--device", "cuda"], 5, capsys, "cuda", "--device cpu")
    device, reason = cli.choose_device("auto")
    assert device == "cpu"
    assert reason
    with pytest.raises(ResourceError):
        cli.choose_device("cuda:0")


def test_missing_folders_are_bad_input(tmp_path, capsys):
    """Exit code 3, and nothing is written."""
    missing, out = str(tmp_path / "nowhere"), tmp_path / "out"
    fails(["check", missing], 3, capsys, missing)
    fails(["reconstruct", missing, "--out", str(out)], 3, capsys, missing)
    fails(["render", missing, "--out", str(out)], 3, capsys, missing)
    fails(["compare", missing], 3, capsys, missing)
    assert not out.exists()


def test_names_that_a_room_does_not_know(run, sequence, tmp_path, capsys):
    """Scenes, formats, presets, images and protocols are named by their rooms,
    and so are the hints; all end with 2.
    """
    out = str(tmp_path / "x")
    fails(["simulate", "slidin", "--out", out], 2, capsys, "slidin", "sliding")
    fails(["simulate", "demo", "--out", out, "--format", "zip"], 2, capsys, "zip", "ftorf")
    fails(
        ["reconstruct", str(sequence), "--out", out, "--preset", "dmeo"], 2, capsys, "dmeo", "demo"
    )
    fails(
        ["reconstruct", str(sequence), "--out", out, "--flow", "raft"],
        2,
        capsys,
        "raft",
        "deepflow",
    )
    fails(["render", str(run), "--out", out, "--what", "distance,quad"], 2, capsys, "quad", "quads")
    fails(["compare", str(run), "--frames", "some"], 2, capsys, "some", "ftorf13")
    assert not (tmp_path / "x").exists()


# -- commands --------------------------------------------------------------------------------------


def test_scenes_are_listed(capsys):
    """One line each under their heads, the demo's first: name, frames, error of the closed form,
    what it is.
    """
    assert cli.main(["simulate", "--list"]) == 0
    out, _ = lines_of(capsys)
    assert out[0].split()[0] == "scene"
    assert out[1].split()[:3] == ["demo", "44", "13.02"]
    assert {line.split()[0] for line in out} >= {
        "demo",
        "sliding",
        "axial",
        "arc",
        "arcing_cube",
        "fan",
        "cupboard",
    }
    assert "a chequered board" in next(line for line in out if line.startswith("target "))


def test_simulate_writes_a_sequence_and_prints_where(sequence, tmp_path, capsys):
    """The path is the result; the same seed gives the same bytes, another one does not,
    no noise neither.
    """
    arguments = ["simulate", "demo", "--size", SIZE, "--frames", FRAMES, "--out"]
    assert cli.main([*arguments, str(tmp_path / "same"), "--seed", "3"]) == 0
    out, err = lines_of(capsys)
    assert out == [str(tmp_path / "same")]
    assert err[0].startswith(f"gftorf_warp {__version__} - device cpu (")
    assert cli.main([*arguments, str(tmp_path / "clean"), "-q", "--seed", "3", "--no-noise"]) == 0
    assert lines_of(capsys) == ([str(tmp_path / "clean")], [])
    assert cli.main([*arguments, str(tmp_path / "other"), "-q", "--seed", "4"]) == 0
    quads = {
        name: (tmp_path / name / "tofType1/0005.npy").read_bytes()
        for name in ("same", "clean", "other")
    }
    measured = (sequence / "tofType1/0005.npy").read_bytes()
    assert quads["same"] == measured
    assert len({measured, quads["clean"], quads["other"]}) == 3


def test_simulate_sync_takes_a_quartet_at_one_instant(tmp_path):
    """The truth of all four raw frames of a quartet is the same."""
    path = tmp_path / "sync"
    assert (
        cli.main(
            ["simulate", "demo", "--size", SIZE, "--frames", "4", "--sync", "--out", str(path)]
        )
        == 0
    )
    first, *others = (np.load(path / f"synthetic_depth/{n:04d}.npy") for n in range(4))
    for other in others:
        np.testing.assert_array_equal(first, other)


def test_simulate_refuses_a_folder_that_is_not_empty(sequence, capsys):
    """Nothing is overwritten."""
    before = sorted(path.name for path in sequence.iterdir())
    fails(
        ["simulate", "arc", "--out", str(sequence), "--size", SIZE],
        2,
        capsys,
        str(sequence),
        "--fresh",
    )
    assert sorted(path.name for path in sequence.iterdir()) == before


def test_check_prints_what_it_found(sequence, capsys):
    """The report is the result."""
    assert cli.main(["check", str(sequence)]) == 0
    out, _ = lines_of(capsys)
    text = "\n".join(out)
    assert f"{FRAMES} of {FRAMES} measured" in text
    assert "19.9862 MHz" in text
    assert "cams/frame_times.npy" in text


def test_reconstruct_prints_the_run_and_goes_on(run, sequence, capsys):
    """The same command again finds everything done; other settings need --fresh."""
    arguments = [
        "reconstruct",
        str(sequence),
        "--out",
        str(run),
        "--images",
        "40",
        "--device",
        "cpu",
    ]
    assert cli.main([*arguments, "--seed", "1"]) == 0
    out, _ = lines_of(capsys)
    assert out == [str(run)]
    fails([*arguments, "--seed", "2"], 2, capsys, "--fresh", str(run))


def test_render_writes_what_was_asked_for(run, tmp_path, capsys):
    """Two times, two kinds of image."""
    out_folder = tmp_path / "images"
    arguments = [
        "render",
        str(run),
        "--out",
        str(out_folder),
        "--what",
        "distance,quads",
        "--times",
        "0.0,0.021",
    ]
    assert cli.main([*arguments, "--device", "cpu"]) == 0
    out, _ = lines_of(capsys)
    assert out == [str(out_folder)]
    for what in ("distance", "quads"):
        assert len(list((out_folder / what).glob("*.exr"))) == 2
    assert not (out_folder / "phasor").exists()
    fails(
        ["render", str(run), "--out", str(out_folder), "--times", "0.05"],
        2,
        capsys,
        str(out_folder),
        "--fresh",
    )
    fails(["render", str(run)], 2, capsys, "--out or --video")
    film = tmp_path / "film.webp"
    asked = ["render", str(run), "--video", str(film), "--times", "0.0,0.01", "--rate", "8"]
    assert cli.main([*asked, "--device", "cpu"]) == 0
    assert lines_of(capsys)[0] == [str(film)]
    assert film.read_bytes()[8:12] == b"WEBP"
    other = tmp_path / "other"
    fails(["render", str(run), "--out", str(other), "--video", "film.avi"], 2, capsys, ".webm")
    assert not other.exists(), "rendered for a video that cannot be"
    fails([*arguments, "--arrays"], 2, capsys, str(out_folder), "--fresh")
    assert cli.main([*arguments, "--arrays", "--fresh"]) == 0
    assert np.load(out_folder / "quads" / "quad_180.npy").shape[0] == 2


def test_export_prints_what_it_wrote(run, tmp_path, capsys):
    """A folder per format; the same command says that all is there, another one is refused."""
    out_folder = tmp_path / "exported"
    arguments = ["export", str(run), "--out", str(out_folder), "--device", "cpu", "--times"]
    said = f"{out_folder / 'ply'} is finished"
    for repeated in (False, True):
        assert cli.main([*arguments, "0.0,0.021"]) == 0
        out, err = lines_of(capsys)
        assert out == [str(out_folder / "ply")]
        assert (said in err) == repeated
        assert len(list((out_folder / "ply").glob("frame_*.ply"))) == 2
    fails([*arguments, "0.0"], 2, capsys, str(out_folder / "ply"), "--fresh")


def test_compare_prints_a_table_or_json(run, sequence, capsys):
    """--json prints exactly what metrics.json holds, and the table the same numbers."""
    assert cli.main(["compare", str(run), "--json", "--device", "cpu"]) == 0
    out, _ = lines_of(capsys)
    metrics = json.loads("\n".join(out))
    assert metrics == json.loads((run / "metrics.json").read_text())
    assert metrics["frames"] == int(FRAMES)
    assert (run / "report.html").stat().st_size > 1000
    assert cli.main(["compare", str(run), "--truth", str(sequence), "--device", "cpu"]) == 0
    out, _ = lines_of(capsys)
    row = next(line for line in out if line.startswith("moving")).split()
    keys = ("closed_form_mse_x100", "temporal_mse_x100", "d_mse_x100")
    for cell, key in zip(row[1:4], keys, strict=True):
        assert float(cell) == pytest.approx(metrics["moving"][key], rel=1e-3)


def test_table_without_truth():
    """What was not measured is a dash, not a zero."""
    nothing = dict.fromkeys(
        ("closed_form_mse_x100", "d_mse_x100", "d_normalised_mse_x100", "d_tof_mse_x100")
    )
    metrics = {
        "frames": 4,
        "protocol": "all",
        "quad_psnr_db": 20.0,
        **nothing,
        "moving": nothing,
        "static": nothing,
    }
    lines = table(metrics).splitlines()
    assert [line.split()[1:] for line in lines[1:4]] == [["-"] * 6] * 3
    assert "20.00 dB" in lines[-1]


def test_doctor_passes_here(capsys):
    """The self-test of the renderer, and a block to paste."""
    assert cli.main(["doctor", "--device", "cpu"]) == 0
    out, _ = lines_of(capsys)
    text = "\n".join(out)
    for word in ("python", "torch", "warp-lang", "kernel cache", "CPU threads", "self-test     ok"):
        assert word in text


def test_doctor_fails_if_the_renderer_is_wrong(monkeypatch, capsys):
    """A renderer that is off by a thousandth does not pass."""
    from dataclasses import replace

    from gftorf_warp.render import api

    right = api.rasterize

    def wrong(*arguments, **options_):
        rendering = right(*arguments, **options_)
        return replace(rendering, quads=rendering.quads * 1.001)

    monkeypatch.setattr(api, "rasterize", wrong)
    assert cli.main(["doctor", "--device", "cpu"]) == 1
    out, _ = lines_of(capsys)
    assert "FAILED" in out[-1]


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity"), reason="needs a system that can restrict a process"
)
def test_threads_restrict_the_process_while_it_runs(monkeypatch):
    """--threads is what every library sees, and only for this command."""
    seen = []

    def available():
        return len(os.sched_getaffinity(0))

    monkeypatch.setitem(cli.COMMANDS, "doctor", lambda _: seen.append(available()) or 0)
    before = available()
    assert cli.main(["doctor", "--threads", "1"]) == 0
    assert seen == [1]
    assert available() == before


@pytest.mark.parametrize("words", [["--preset", "nosuch"], ["--set", "no.such=1"]])
def test_wrong_settings_are_refused_before_compiling(words, tmp_path, monkeypatch, capsys):
    """Compiling takes seconds, and nothing is written."""
    compiled = []
    monkeypatch.setattr("gftorf_warp.terminal.kernels_are_cached", lambda: False)
    monkeypatch.setattr("gftorf_warp.doctor.compile_kernels", compiled.append)
    sequence = Path(__file__).parent / "data" / "ftorf_sample_box"
    out = tmp_path / "run"
    command = ["reconstruct", str(sequence), "--out", str(out), "--device", "cpu"]
    assert cli.main([*command, *words]) == 2
    assert words[1].partition("=")[0] in capsys.readouterr().err
    assert not compiled
    assert not out.exists()
