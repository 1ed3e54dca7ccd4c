"""What a terminal shows while something goes on: progress, and what Warp has to say."""

import logging
import subprocess
import sys

from gftorf_warp import terminal
from gftorf_warp.render.runtime import WarpLog


def test_progress_tells_the_time_left():
    """Half of the work took ten seconds; a resumed loop does not count what was there."""
    assert "10 s left" in terminal.progress_line("x", 50, 100, 0, 10.0, {})
    assert "5 s left" in terminal.progress_line("x", 75, 100, 50, 5.0, {"loss": 0.123456, "N": 7})
    line = terminal.progress_line("x", 100, 100, 0, 10.0, {"loss": 0.123456, "N": 7})
    assert line == "  x 100/100  loss 0.1235  N 7  10.0 s"


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
