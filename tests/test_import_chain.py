"""A recording of every kind, through the commands that a user types: import, check, reconstruct,
compare, export, view.
"""

import json
import re
import urllib.request

import numpy as np
import pytest
from browser import collect_sockets
from simulated_recordings import FITTED, WRITERS

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.importers.kinds import KINDS

CPU = ("--device", "cpu", "-q")


@pytest.fixture
def typed(capsys):
    """Runs a command that has to end well; what it printed, and its warnings."""

    def run(*words):
        assert main([*map(str, words)]) == 0, words
        return capsys.readouterr()

    return run


def look_at(folder, typed, monkeypatch):
    """What ``gftorf view`` serves to a browser, and says of the first raw frame."""
    from gftorf_warp.view import window

    seen = []

    def look(found):
        assert found.step(0.0), "something is drawn"
        with urllib.request.urlopen(found.address, timeout=60) as answer:
            seen.extend([answer.read(), found.controls.about.content])
        raise KeyboardInterrupt

    monkeypatch.setattr(window.Window, "run", look)
    assert "open http://127.0.0.1:" in typed("view", folder, *CPU).out
    collect_sockets()
    return seen


@pytest.mark.parametrize("name", WRITERS)
def test_a_recording_goes_the_whole_way(name, tmp_path, typed, monkeypatch):
    """Raw frames are equal to the bit, and the scene is where it was in all that follows."""
    recorded = WRITERS[name](tmp_path)
    sequence, run, exported = (tmp_path / part for part in ("sequence", "run", "exported"))
    config = []
    if recorded.keys:
        (tmp_path / "keys.toml").write_text(recorded.keys)
        config = ["--config", tmp_path / "keys.toml"]
    typed("import", recorded.kind, recorded.source, "--out", sequence, "-q", *config)
    found = Sequence.open(sequence)
    if recorded.exact:
        np.testing.assert_array_equal(found.quads, recorded.quads)
    else:
        apart = np.abs(found.quads - recorded.quads).max()
        assert apart < 0.01 * np.abs(recorded.quads).max()
    assert (found.truth() is not None) == recorded.has_truth

    named = re.findall(r"^warning: .* \[([\w ]+)\]$", typed("check", sequence).out, re.MULTILINE)
    assert tuple(named) == recorded.warnings

    typed("reconstruct", sequence, "--out", run, *recorded.reconstruct, *CPU)
    truth = ["--truth", recorded.truth] if recorded.truth else []
    typed("compare", run, *truth, *CPU)
    scores = json.loads((run / "metrics.json").read_text())
    if recorded.has_truth or truth:
        assert scores["d_mse_x100"] < scores["closed_form_mse_x100"] + 5.0
    else:
        assert scores["d_mse_x100"] is None

    fitted = recorded.reconstruct[-len(FITTED) :] == FITTED
    formats = "npz,tum" + ",ply" * fitted
    typed("export", run, "--out", exported, "--format", formats, "--times", "0", *CPU)
    with np.load(exported / "npz" / "frame_0000.npz") as arrays:
        away = np.abs(arrays["distance"] - recorded.distance)
    assert np.nanmedian(away) < (0.1 if fitted else 0.05), "m"
    assert len((exported / "poses.txt").read_text().splitlines()) == 2
    if fitted:
        assert b"f_dc_0" in (exported / "ply" / "frame_0000.ply").read_bytes()

    page, about = look_at(run, typed, monkeypatch)
    assert b"<html" in page
    assert f"raw frame 0 of {found.frames}" in about


def test_every_kind_goes_the_whole_way():
    """A new kind needs a recording."""
    found = {name.partition(",")[0].removesuffix("_hdf5") for name in WRITERS}
    assert found - {"colour", "phasors"} == {*KINDS}
