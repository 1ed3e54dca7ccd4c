"""Runs whose checkpoint is damaged, and runs whose sequence moved or changed: never another result
without a word.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from moving_box import recording

from gftorf_warp.cli import main
from gftorf_warp.data.write import write
from gftorf_warp.evaluate.caveats import caveats
from gftorf_warp.recon import checkpoint, folder

IMAGES, LATE = 40, 36


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a sequence of a few raw frames and a short run of it."""
    place = tmp_path_factory.mktemp("made")
    write("ftorf", place / "seq", *recording(frames=12))
    options = ["--preset", "demo", "--images", str(IMAGES), "--device", "cpu", "-q"]
    assert main(["reconstruct", str(place / "seq"), "--out", str(place / "run"), *options]) == 0
    return place


@pytest.fixture
def place(made, tmp_path):
    """A copy of it to spoil, in which the run knows its sequence."""
    shutil.copytree(made, tmp_path / "made")
    change_config(tmp_path / "made" / "run", sequence=str(tmp_path / "made" / "seq"))
    return tmp_path / "made"


def change_config(run: Path, **values):
    """Other values in config.json."""
    folder.write_config(run, folder.read_config(run) | values)


def cut(run: Path, images: int):
    """Truncate a checkpoint."""
    path = run / "ckpt" / f"{images:010d}.pt"
    path.write_bytes(path.read_bytes()[:5000])


def compare(place: Path, *more: str) -> int:
    """Exit code of a comparison."""
    return main(["compare", str(place / "run"), "--device", "cpu", *more])


def reconstruct(place: Path, *more: str) -> int:
    """Exit code of the same reconstruction again."""
    words = ["reconstruct", str(place / "seq"), "--out", str(place / "run"), "--device", "cpu"]
    return main([*words, "--preset", "demo", "--images", str(IMAGES), *more])


def reported(place: Path) -> dict:
    """metrics.json."""
    return json.loads((place / "run" / "metrics.json").read_text())


def render(place: Path, *more: str) -> int:
    """Exit code of a rendering of one instant."""
    words = ["render", str(place / "run"), "--out", str(place / "out"), "--times", "0.02"]
    return main([*words, "--device", "cpu", *more])


def test_a_short_run_has_a_checkpoint_shortly_before_its_end(made):
    """A minute is not over, but the start would be no replacement."""
    names = sorted(path.name for path in (made / "run" / "ckpt").glob("*.pt"))
    assert names == [f"{LATE:010d}.pt", f"{IMAGES:010d}.pt"]


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_scored(place, capsys):
    """In the log, in metrics.json and on the page."""
    cut(place / "run", IMAGES)
    assert compare(place) == 0
    assert "SHA-256" in capsys.readouterr().err
    found = reported(place)
    assert found["images_optimised"] == LATE
    (caveat,) = found["caveats"]
    assert f"{IMAGES:010d}.pt" in caveat
    assert f"image {LATE} of {IMAGES}" in caveat
    assert caveat in (place / "run" / "report.html").read_text()


def test_reconstruct_says_so_and_makes_the_lost_images_again(place, capsys):
    """With the bytes of the undisturbed run."""
    whole = (place / "run" / "ckpt" / f"{IMAGES:010d}.pt").read_bytes()
    before = checkpoint.last(place / "run")
    cut(place / "run", IMAGES)
    assert reconstruct(place) == 0
    assert f"checkpoint before it is used, of image {LATE}" in capsys.readouterr().err
    assert "SHA-256" in (place / "run" / "run.log").read_text()
    again = checkpoint.last(place / "run")
    assert again["images"] == IMAGES
    assert len((place / "run" / "ckpt" / f"{IMAGES:010d}.pt").read_bytes()) == len(whole)
    assert (again["field"]["mean"] == before["field"]["mean"]).all()
    assert compare(place) == 0
    assert reported(place)["caveats"] == []


def test_the_start_never_takes_the_place_of_a_result(made, place, capsys):
    """It is refused by every command, and what was reported stays."""
    ckpt = place / "run" / "ckpt"
    assert compare(place) == 0
    good = (place / "run" / "report.html").read_bytes()
    start = checkpoint.load(ckpt / f"{LATE:010d}.pt") | {"images": 0}
    checkpoint.save(place / "run", start)  # which drops the later ones
    for name in (f"{IMAGES:010d}.pt", f"{IMAGES:010d}.pt.sha256"):
        shutil.copy(made / "run" / "ckpt" / name, ckpt)
    cut(place / "run", IMAGES)
    for command in (compare, render, reconstruct):
        capsys.readouterr()
        assert command(place) == 3
        err = capsys.readouterr().err
        assert f"{IMAGES:010d}.pt" in err
        assert "--fresh" in err
    assert (place / "run" / "report.html").read_bytes() == good
    assert not (place / "out").exists()


def test_a_report_of_a_later_state_is_not_replaced(place, capsys):
    """Nor are images of one."""
    assert compare(place) == 0
    assert render(place) == 0
    before = {path: path.read_bytes() for path in place.rglob("*.*") if path.is_file()}
    cut(place / "run", IMAGES)
    assert compare(place) == 3
    assert "metrics.json" in capsys.readouterr().err
    assert render(place) == 2
    assert "more optimised images" in capsys.readouterr().err
    for path, data in before.items():
        assert path.suffix == ".pt" or path.read_bytes() == data, path
    assert render(place, "--fresh") == 0


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("a factor of all quads", '\n  "quad_scale": ', '\n  "quad_scale": 1'),
        ("a digit of the camera", '"fx": ', '"fx": 1'),
        ("a setting that a rendering reads", '"low_pass": 0.3', '"low_pass": 0.8'),
        ("a number that JSON lacks", '"fx": ', '"fx": NaN, "was": '),
        ("the sum itself", '"config_sha256": "', '"config_sha256": "f'),
    ],
)
def test_a_changed_value_of_a_config_is_noticed(place, capsys, name, old, new):
    """Although it is one that could be; older configs have no sum and are read as ever."""
    path = place / "run" / "config.json"
    text = path.read_text()
    assert text.count(old) == 1, name
    path.write_text(text.replace(old, new))
    for command in (compare, render, reconstruct):
        assert command(place, "-q") == 3
        assert "SHA-256" in capsys.readouterr().err
    change = json.loads(text)
    del change["config_sha256"]
    path.write_text(json.dumps(change, indent=4))
    assert render(place, "-q") == 0


def test_another_sequence_is_not_scored(place, capsys):
    """The data hash of the run decides, whatever the folder is called."""
    shutil.rmtree(place / "seq")
    write("ftorf", place / "seq", *recording(frames=12, noise=0.001))
    for command in (compare, render):
        assert command(place) == 3
        assert "not the sequence of the run" in capsys.readouterr().err
    assert not (place / "run" / "metrics.json").exists()


def test_a_moved_sequence_is_found_again(place, capsys):
    """--sequence names it once, and the run remembers it; another one is refused."""
    (place / "seq").rename(place / "moved")
    assert compare(place) == 3
    assert "--sequence" in capsys.readouterr().err
    write("ftorf", place / "other", *recording(frames=12, noise=0.001))
    assert compare(place, "--sequence", str(place / "other")) == 3
    assert "not the sequence of the run" in capsys.readouterr().err
    assert compare(place, "--sequence", str(place / "moved")) == 0
    assert render(place) == 0


def test_reconstruct_finds_a_moved_sequence_again(place):
    """The same command with the new place resumes, and remembers it in a finished run too."""
    change_config(place / "run", sequence=str(place / "gone"))
    assert reconstruct(place) == 0
    assert compare(place) == 0


def test_distances_beyond_the_range_are_announced(place, capsys):
    """A sensor of 60 MHz repeats after 2.5 m; the wall is at 3.6 m."""
    sequence, truth = recording(frames=12, f_mod_hz=60e6)
    write("ftorf", place / "fast", sequence, truth)
    out = str(place / "ctof")
    words = ["reconstruct", str(place / "fast"), "--out", out, "--preset", "ctof", "-q"]
    assert main([*words, "--device", "cpu"]) == 0
    assert main(["compare", out, "--device", "cpu"]) == 0
    (caveat,) = json.loads((Path(out) / "metrics.json").read_text())["caveats"]
    assert "beyond the unambiguous range of 2.498 m" in caveat
    assert caveat in capsys.readouterr().err


def test_unknown_distances_are_no_share_of_the_true_ones():
    """All known distances lie beyond the range, also where half of the truth is unknown."""
    sequence, truth = recording(frames=4, f_mod_hz=60e6)
    distance = np.full_like(truth.distance, 3.6)
    distance[:, ::2] = np.nan
    (caveat,) = caveats({}, sequence, replace(truth, distance=distance))
    assert caveat.startswith("100 %")
