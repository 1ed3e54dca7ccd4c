"""A disk that fills up, and folders that may only be read: a named error, what there was is kept,
and the same command goes on when there is space again.
"""

import json
import os
import resource
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
from moving_box import recording

from gftorf_warp.cli import main
from gftorf_warp.data.write import write
from gftorf_warp.errors import GftorfError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.evaluate.views import render_to_folder
from gftorf_warp.recon import checkpoint, folder
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.train import reconstruct as fit
from gftorf_warp.terminal import as_known_error

NOBODY = 65534
DEVICE = ["--device", "cpu", "-q"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A sequence and a run of it, which compiled every kernel."""
    place = tmp_path_factory.mktemp("made")
    write("ftorf", place / "seq", *recording(frames=8))
    assert main(reconstruct(place / "seq", place / "run")) == 0
    assert main(["compare", str(place / "run"), *DEVICE]) == 0
    assert main(["render", str(place / "run"), "--out", str(place / "out"), *DEVICE]) == 0
    return place


def reconstruct(sequence, run, images=8):
    """A short reconstruction."""
    words = ["reconstruct", str(sequence), "--out", str(run), "--preset", "demo"]
    return [*words, "--images", str(images), *DEVICE]


@contextmanager
def no_file_above(limit):
    """No file of this process can grow beyond so many bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fails_for_space(command, limit, capsys):
    """It ends with exit code 5 and three lines."""
    capsys.readouterr()
    with no_file_above(limit):
        code = main(command)
    err = capsys.readouterr().err
    assert code == 5, err
    lines = err.splitlines()[-3:]
    assert [line[:7] for line in lines] == ["error: ", "  why: ", "  fix: "], err
    assert "space" in lines[2]


def temporary(place):
    """Files that no reader knows."""
    return [path for path in place.rglob("*") if ".tmp-" in path.name]


def test_simulate_goes_on_when_there_is_space(tmp_path, capsys):
    """Raw frames that were finished are kept, in no sequence; the result is the same."""
    words = ["simulate", "demo", "--size", "24x18", "--frames", "4", "-q", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    fails_for_space([*words, str(tmp_path / "seq")], 1_000, capsys)
    assert not (tmp_path / "seq").exists()
    assert main([*words, str(tmp_path / "seq")]) == 0
    for path in (tmp_path / "whole").rglob("*.npy"):
        other = tmp_path / "seq" / path.relative_to(tmp_path / "whole")
        assert other.read_bytes() == path.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seq", "whole"]


@pytest.mark.parametrize("limit", [0, 20_000])
def test_the_last_checkpoint_survives_a_full_disk(made, tmp_path, capsys, limit):
    """A longer run of the same stops, loses nothing, and goes on later."""
    shutil.copytree(made / "run", tmp_path / "run")
    before = checkpoint.last(tmp_path / "run")
    longer = reconstruct(made / "seq", tmp_path / "run", images=16)
    fails_for_space(longer, limit, capsys)
    after = checkpoint.last(tmp_path / "run")
    assert (after["images"], after["field"].keys()) == (before["images"], before["field"].keys())
    assert (after["field"]["mean"] == before["field"]["mean"]).all()
    assert not temporary(tmp_path)
    assert main(longer) == 0
    assert checkpoint.last(tmp_path / "run")["images"] == 16


def test_a_report_is_the_old_one_or_the_new_one(made, tmp_path, capsys):
    """Never a part of one."""
    shutil.copytree(made / "run", tmp_path / "run")
    before = (tmp_path / "run" / "report.html").read_bytes()
    fails_for_space(["compare", str(tmp_path / "run"), *DEVICE], 3_000, capsys)
    assert (tmp_path / "run" / "report.html").read_bytes() == before
    json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert not temporary(tmp_path)


@pytest.mark.parametrize("more", [[], ["--arrays"]], ids=["pictures", "arrays"])
def test_images_that_do_not_fit_are_not_left_in_parts(made, tmp_path, capsys, more):
    """What is there is complete, and the same command completes it."""
    words = ["render", str(made / "run"), "--out", str(tmp_path / "out"), *more, *DEVICE]
    fails_for_space(words, 2_000, capsys)
    assert not temporary(tmp_path)
    assert main(words) == 0


@contextmanager
def read_only(place):
    """A folder whose files this process may read but not write, also if it is root's."""
    user = os.geteuid()
    for path in [place, *place.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    if user == 0:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(user)
        for path in [place, *place.rglob("*")]:
            path.chmod(0o755 if path.is_dir() else 0o644)


@pytest.fixture
def shared(made):
    """A copy in a folder that everybody may enter, and one to write to."""
    with tempfile.TemporaryDirectory(dir="/tmp") as parent:
        place = Path(parent)
        place.chmod(0o755)
        shutil.copytree(made, place / "made")
        run = place / "made" / "run"
        here = {"sequence": str(place / "made" / "seq")}
        folder.write_config(run, folder.read_config(run) | here)
        (place / "mine").mkdir()
        (place / "mine").chmod(0o777)
        yield place


def test_a_run_that_may_only_be_read_can_be_rendered(shared):
    """Calls that write into it are refused by name, and leave it as it is."""
    run, sequence = shared / "made" / "run", shared / "made" / "seq"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with read_only(shared / "made"):
        render_to_folder(Run.open(run), shared / "mine" / "out", "distance", [0.01])
        for refused in (
            lambda: compare(run),
            lambda: fit(sequence, run, "demo", images=16),
            lambda: fit(sequence, shared / "made" / "new", "demo", images=16),
        ):
            with pytest.raises((GftorfError, OSError)) as caught:
                refused()
            known = as_known_error(caught.value)
            assert known is not None
            assert str(shared / "made") in known.where
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert (shared / "mine" / "out" / "distance" / "000000.exr").is_file()
