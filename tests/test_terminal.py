"""What a terminal shows while something goes on: progress, and what Warp has to say."""

import errno
import logging
import subprocess
import sys

import pytest

from gftorf_warp import terminal
from gftorf_warp.errors import InputError, ResourceError
from gftorf_warp.recon.record import log_to
from gftorf_warp.render.runtime import WarpLog


def test_progress_tells_the_time_left():
    """Half of the work took ten seconds; a resumed loop does not count what was there."""
    assert "10 s left" in terminal.progress_line("x", 50, 100, 0, 10.0, {})
    assert "5 s left" in terminal.progress_line("x", 75, 100, 50, 5.0, {"loss": 0.123456, "N": 7})
    line = terminal.progress_line("x", 100, 100, 0, 10.0, {"loss": 0.123456, "N": 7})
    assert line == "  x 100/100  loss 0.1235  N 7  10.0 s"


def test_large_rates_have_plain_digits():
    """81,180 images per second, not 8.118e+04."""
    line = terminal.progress_line("x", 9, 9, 0, 4.0, {"images/s": 81_180.4, "loss": 12.3456})
    assert line == "  x 9/9  images/s 81180  loss 12.35  4.0 s"


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("Failed to find backward kernel 'blend' from module 'm' for device 'cpu'"),
        Exception("Failed to load CPU module 'm' (build)"),
        RuntimeError("Failed to allocate 2343168 bytes on device 'cpu'"),
        RuntimeError("can't start new thread"),
        ImportError("libtorch.so: failed to map segment from shared object"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
    ],
    ids=["kernel", "module", "array", "thread", "library", "process"],
)
def test_too_little_memory_is_no_bug(error):
    """Whoever could not have it: exit code 5 and what to do, not the name of an exception."""
    known = terminal.as_known_error(error)
    assert isinstance(known, ResourceError)
    assert "memory" in str(known)
    assert terminal.as_known_error(RuntimeError("Failed to do something else")) is None


def test_endless_paths_are_shortened(capsys):
    """Of five kilobytes the two ends are shown; the rest of the message stays."""
    path = "/start/" + 5000 * "x" + "/end.npy"
    error = InputError("not a file", where=path, why=f"expected a file at {path}", fix="look")
    assert terminal.print_error(error, debug=False) == 3
    err = capsys.readouterr().err
    assert len(err) < 700
    assert "/start/x" in err
    assert "x/end.npy" in err
    assert err.splitlines()[2] == "  fix: look"


def test_quiet_means_quiet_although_the_log_file_has_more(tmp_path, capsys):
    """`reconstruct -q` prints its result, and run.log every line."""
    with terminal.logging_to_stderr(logging.WARNING), log_to(tmp_path / "run.log"):
        terminal.LOG.info("starts")
        terminal.LOG.warning("looks odd")
    assert capsys.readouterr().err == "warning: looks odd\n"
    assert "INFO starts" in (tmp_path / "run.log").read_text()


def test_progress_is_plain_and_rare_without_a_terminal(capsys):
    """No control codes, one line at the end of a short loop, none at all if quiet."""
    for quiet in (False, True):
        progress = terminal.Progress("x", quiet=quiet)
        for done in range(1, 6):
            progress(done, 5)
    assert [line.partition("  ")[2][:5] for line in capsys.readouterr().err.splitlines()] == [
        "x 5/5"
    ]


def test_progress_counts_per_second_what_has_a_unit(capsys, monkeypatch):
    """From the first report on: eight images in four seconds."""
    now = iter([0.0, 10.0, 14.0])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    progress = terminal.Progress("render", unit="images")
    progress(1, 9)
    progress(9, 9)
    assert capsys.readouterr().err.splitlines()[-1] == "  render 9/9  images/s 2  4.0 s"


def test_warp_speaks_through_our_log(caplog):
    """Compilations and cache hits are details; warnings stay warnings."""
    log = WarpLog()
    with caplog.at_level(logging.DEBUG, logger="gftorf_warp"):
        log.info("Module kernels.tiles 123 load on device 'cpu' took 2.00 ms  (compiled)\n")
        log.info("Module kernels.tiles 123 load on device 'cpu' took 2.00 ms  (cached)")
        log.warning("old driver")
    levels = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert levels[0] == ("DEBUG", "  compiled kernels.tiles 123 load on device 'cpu' took 2.00 ms")
    assert levels[1][0] == "DEBUG"
    assert levels[2] == ("WARNING", "warp: old driver")


def test_start_drops_only_the_line_about_the_driver():
    """In a fresh process nothing of Warp's greeting or of its native warning is seen."""
    code = "from gftorf_warp import terminal; terminal.start_warp()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    assert terminal.NO_DRIVER not in done.stderr
