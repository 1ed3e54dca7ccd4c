"""The demo at a reduced size, without a time limit: its order, its files, what it prints,
and that it goes on.
"""

import json

import pytest

from gftorf_warp import cli, demo
from gftorf_warp.errors import UsageError

SMALL = ["--size", "48x36", "--frames", "12", "--images", "160", "--device", "cpu"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small demo, run once."""
    out = tmp_path_factory.mktemp("demo") / "out"
    assert cli.main(["demo", "--out", str(out), *SMALL]) == 0
    return out


def test_demo_leaves_sequence_run_numbers_and_report(folder):
    """What the README promises to find."""
    assert {path.name for path in folder.iterdir()} == {
        "demo.json",
        "seq",
        "run",
        "metrics.json",
        "report.html",
    }
    assert (folder / "metrics.json").read_bytes() == (folder / "run" / "metrics.json").read_bytes()
    assert (folder / "report.html").read_bytes() == (folder / "run" / "report.html").read_bytes()
    assert len(list((folder / "seq").glob("tofType*/*.npy"))) == 12


def test_demo_beats_the_closed_form_where_something_moves(folder):
    """Even this small; the full size does better, and the benchmark says by how much."""
    moving = json.loads((folder / "metrics.json").read_text())["moving"]
    assert moving["closed_form_mse_x100"] > 1.0, "nothing moved: the comparison would be empty"
    assert moving["d_mse_x100"] < 0.6 * moving["closed_form_mse_x100"]


def test_demo_goes_on_and_prints_the_numbers_of_its_metrics(folder, capsys):
    """A second call repeats nothing, and its last lines are those of metrics.json."""
    written = (folder / "seq" / "tofType0" / "0000.npy").stat().st_mtime_ns
    assert cli.main(["demo", "--out", str(folder), *SMALL]) == 0
    captured = capsys.readouterr()
    assert (folder / "seq" / "tofType0" / "0000.npy").stat().st_mtime_ns == written
    moving, static, report = captured.out.splitlines()
    metrics = json.loads((folder / "metrics.json").read_text())
    for line, name in ((moving, "moving"), (static, "static")):
        assert line.startswith(f"{name} pixels: ")
        assert (
            f"closed form {metrics[name]['closed_form_mse_x100']:.3f} -> ours "
            f"{metrics[name]['d_mse_x100']:.3f}" in line
        )
    assert str(folder / "report.html") in report
    steps = [line[:5] for line in captured.err.splitlines() if line.startswith("[")]
    assert steps == [f"[{n}/4]" for n in (1, 1, 2, 2, 3, 3, 4, 4)]


def test_demo_with_other_settings_names_fresh(folder, capsys):
    """Exit code 2, and what differs."""
    before = (folder / "demo.json").read_bytes()
    assert cli.main(["demo", "--out", str(folder), *SMALL, "--seed", "5"]) == 2
    err = capsys.readouterr().err
    assert "--fresh" in err
    assert "another seed" in err
    assert (folder / "demo.json").read_bytes() == before


def test_demo_leaves_foreign_folders_alone(tmp_path):
    """A folder with somebody's files is refused, with and without fresh."""
    (tmp_path / "run").mkdir()
    for fresh in (False, True):
        with pytest.raises(UsageError, match="choose another"):
            demo.prepare(tmp_path, {"seed": 0}, fresh=fresh)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_fresh_moves_the_old_demo_aside(tmp_path):
    """Nothing is deleted, however often one starts over."""
    for seed in range(3):
        demo.prepare(tmp_path, {"seed": seed, "size": (3, 4)}, fresh=True)
        (tmp_path / "seq").mkdir()
    demo.prepare(tmp_path, {"seed": 2, "size": (3, 4)}, fresh=False)
    assert [
        json.loads((tmp_path / f"old-{n}" / "demo.json").read_text())["seed"] for n in (1, 2)
    ] == [0, 1]
    assert (tmp_path / "old-2" / "seq").is_dir()


def test_summary_says_none_for_pixels_that_do_not_exist():
    """A still scene has no moving pixel."""
    nothing = {"closed_form_mse_x100": None, "d_mse_x100": None}
    still = {"closed_form_mse_x100": 0.2, "d_mse_x100": 0.1}
    lines = demo.summary({"moving": nothing, "static": still})
    assert lines[0] == "moving pixels: none in this scene"
    assert "closed form 0.200 -> ours 0.100" in lines[1]
    assert "0.50" in lines[1]
