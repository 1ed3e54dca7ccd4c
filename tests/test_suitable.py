"""What a preset cannot be applied to is refused before any work, and `gftorf check` says so."""

from dataclasses import replace

import numpy as np
import pytest
from moving_box import as_phasors, recording, turned, with_colour

from gftorf_warp.cli import main
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError
from gftorf_warp.recon import presets
from gftorf_warp.recon.settings import Method
from gftorf_warp.recon.suitable import ASSUMED, FAITHFUL, about_preset, check_sequence
from gftorf_warp.recon.train import reconstruct


def unsuitable(kind):
    """A recording in which something is missing."""
    sequence, _ = recording(frames=8)
    if kind == "phasors":
        return as_phasors(sequence)
    if kind == "moving":
        return replace(sequence, camera_from_world=np.stack([turned(n) for n in range(8)]))
    if kind == "gaps":
        measured = sequence.measured.copy()
        measured[[1, 6]] = False
        return replace(sequence, measured=measured)
    return sequence


@pytest.mark.parametrize(
    ("preset", "kind", "what"),
    [
        ("dgs", "no colour", "no colour"),
        ("dgs_depth", "no colour", "no colour"),
        ("ctof", "gaps", "no complete quartet"),
        ("temporal", "gaps", "no complete quartet"),
        ("flow2d", "phasors", "no raw frames"),
        ("flow2d", "gaps", "no complete quartet"),
        ("temporal", "moving", "the camera moves"),
        ("torf", "gaps", "no complete quartet"),
        ("ftorf", "phasors", "no raw frames"),
        ("ftorf", "moving", "the camera moves"),
        ("volume", "phasors", "no raw frames"),
        ("volume", "moving", "the camera moves"),
    ],
)
def test_what_is_missing_is_named_before_any_work(tmp_path, preset, kind, what):
    """With a way out, and without a folder."""
    with pytest.raises(InputError, match=what) as error:
        reconstruct(unsuitable(kind), tmp_path / "run", preset)
    assert error.value.fix
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", presets.PRESETS)
def test_what_fits_is_not_refused(name):
    """Raw frames of a resting camera, with colour."""
    check_sequence(with_colour(recording(frames=8)[0], size=(12, 9)), presets.preset(name))


def test_methods_of_others_say_what_is_theirs():
    """Each in sentences; our own names nothing as published."""
    assert ASSUMED.keys() == FAITHFUL.keys()
    assert ASSUMED.keys() == {Method.FLOW2D, Method.TORF, Method.FTORF, Method.VOLUME}
    assert not FAITHFUL[Method.VOLUME]
    for method, sentences in ASSUMED.items():
        assert sentences
        about = about_preset(recording(frames=8)[0], presets.preset(str(method)))
        assert all(sentence in about for sentence in (*sentences, *FAITHFUL[method]))


def test_check_names_what_is_assumed(tmp_path, capsys):
    """After its report; a preset that cannot be applied ends with its error, after it too."""
    write("ftorf", tmp_path / "box", *recording(frames=8))
    assert main(["check", str(tmp_path / "box"), "--preset", "ftorf"]) == 0
    said = capsys.readouterr().out
    assert "preset ftorf can be applied" in said
    assert "assumed         optical flow" in said
    assert main(["check", str(tmp_path / "box"), "--preset", "dgs"]) == 3
    found = capsys.readouterr()
    assert "sequence" in found.out
    assert "no colour" in found.err


def test_check_says_that_there_is_no_closed_form(tmp_path, capsys):
    """Of three raw frames no distance can be decoded."""
    write("capture", tmp_path / "three", recording(frames=3, with_flow=False)[0])
    assert main(["check", str(tmp_path / "three"), "--preset", "ctof"]) == 3
    assert "no complete quartet" in capsys.readouterr().err
