"""Several runs of one sequence side by side: numbers are those of each alone, other sequences are
refused.
"""

import json
import re

import numpy as np
import pytest
from analytic_run import AnalyticRun, sequence, truth
from browser import DESKTOP, PHONE, browser

from gftorf_warp import cli, reconstruct
from gftorf_warp.data.read import read
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.evaluate.runs import compare_runs, names_of, table_of_runs
from gftorf_warp.evaluate.runs_page import differing

FARTHER = 0.5  # [m] that the second run's distances are too long


class Farther(AnalyticRun):
    """The analytic run, with longer distances."""

    def render(self, time, camera=None, *, extra=None):
        """As the first, but for the distance."""
        rendering = super().render(time, camera, extra=extra)
        rendering.distance[:] += FARTHER
        return rendering


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two runs of one sequence, their folder of results, and what was returned."""
    folder = tmp_path_factory.mktemp("runs")
    runs = AnalyticRun(folder / "near"), Farther(folder / "far")
    for run in runs:
        run.config["data_sha256"] = "0123456789abcdef"
    runs[1].config["seed"] = 8
    runs[1].config["settings"] = {"rates": {"mean": 0.5, "motion": 1.0}}
    runs[0].config["settings"] = {"rates": {"mean": 0.25, "motion": 1.0}}
    seen = []
    result = compare_runs(runs, folder / "out", progress=lambda *at: seen.append(at))
    of_one = [4, 8, 12, *range(13, 25)]  # residuals by quartet, then every raw frame
    assert seen == [(before + k, 48) for before in (0, 24) for k in of_one]
    return runs, folder / "out", result


def test_each_run_has_the_numbers_that_it_has_alone(two):
    """And its folder stays as it was."""
    runs, out, result = two
    assert json.loads((out / "comparison.json").read_text()) == result
    assert result["data_sha256"] == "0123456789abcdef"
    assert [*result["runs"]] == ["near/run", "far/run"]
    for run, metrics in zip(runs, result["runs"].values(), strict=True):
        assert not (run.path / "metrics.json").exists()
        assert compare(run, report=False) == metrics
        (run.path / "metrics.json").unlink()
    near, far = (metrics["d_mse_x100"] for metrics in result["runs"].values())
    assert near < far


def test_the_page_shows_every_run(two):
    """Every number of the tables, the best one in the verdict, what differs, and pictures of all;
    nothing in it can run.
    """
    _, out, result = two
    page = (out / "comparison.html").read_text()
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page.partition("<body>")[2]))
    assert "near/run has the least error on moving pixels" in text
    for metrics in result["runs"].values():
        for group in ("moving", "static"):
            assert f"{metrics[group]['d_mse_x100']:.3f}" in text
    assert "rates.mean 0.25 0.5" in text
    assert "seed 7 8" in text
    assert "rates.motion" not in text.partition("How it was made")[0]
    alternatives = re.findall(r'<img[^>]* alt="([^"]*)"', page)
    for name in ("near/run", "far/run"):
        for title in (name, f"slider: {name}", f"film: {name}", f"error of {name}"):
            assert title in alternatives
    assert not re.search(r"<script|https?:|\son\w+=", re.sub(r"base64,[\w+/=]*", "", page))


def test_the_page_fits_a_phone(two):
    """Nothing is cut off at either size."""
    _, out, _ = two
    with browser() as tab:
        for size in (DESKTOP, PHONE):
            tab.resize(size)
            tab.open((out / "comparison.html").absolute().as_uri())
            assert tab.value("document.documentElement.scrollWidth") <= size[0]
        assert not tab.problems


def test_the_table_has_a_line_per_run(two):
    """Closed form, temporal, both runs and a line on what was scored."""
    lines = table_of_runs(two[2]).splitlines()
    starts = ["MSE x100", "closed form", "temporal", "near/run", "far/run", "12 raw frames"]
    assert [line[: len(start)] for line, start in zip(lines, starts, strict=True)] == starts
    moving = two[2]["runs"]["far/run"]["moving"]["d_mse_x100"]
    assert f"{moving:.4g}" in lines[4]


def test_other_data_are_refused(two, tmp_path):
    """By the hash, and without one by the folder; and a run twice."""
    near, far = two[0]
    other = AnalyticRun(tmp_path)
    with pytest.raises(InputError, match="runs of different sequences"):
        compare_runs([near, other], tmp_path / "out")
    other.config["data_sha256"] = "another"
    with pytest.raises(InputError, match="runs of different sequences") as caught:
        compare_runs([near, far, other], tmp_path / "out")
    assert caught.value.where == str(other.path)
    with pytest.raises(UsageError, match="named twice"):
        compare_runs([near, near], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_names_are_as_short_as_they_differ(tmp_path):
    """One part where that is enough."""
    assert names_of([tmp_path / "a", tmp_path / "b"]) == ["a", "b"]
    assert names_of([tmp_path / "a" / "run", tmp_path / "b" / "run"]) == ["a/run", "b/run"]
    above = tmp_path.name  # a run named truth would take its picture's place
    assert names_of([tmp_path / "truth", tmp_path / "b"]) == [f"{above}/truth", f"{above}/b"]


def test_what_differs_is_found_at_every_depth():
    """Absent is None; what is the same is left out."""
    configs = {
        "a": {"seed": 1, "settings": {"init": {"kind": "phase"}, "width_max": 160}},
        "b": {"seed": 1, "settings": {"init": {"kind": "random", "count": 5}, "width_max": 160}},
    }
    assert differing(configs) == {"init.kind": ["phase", "random"], "init.count": [None, 5]}


def test_the_command_compares_one_or_several(tmp_path, capsys, monkeypatch):
    """Two methods without Gaussians; one run as ever; --out is for several."""
    monkeypatch.chdir(tmp_path)
    write("ftorf", tmp_path / "seq", sequence(), truth())
    for preset in ("ctof", "temporal"):
        reconstruct(read(tmp_path / "seq"), tmp_path / preset, preset)
    capsys.readouterr()
    assert cli.main(["compare", "ctof", "temporal", "-q", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [*result["runs"]] == ["ctof", "temporal"]
    errors = [run["d_mse_x100"] for run in result["runs"].values()]
    assert np.isfinite(errors).all()
    assert (tmp_path / "gftorf-compare" / "comparison.html").is_file()
    assert cli.main(["compare", "ctof", "-q"]) == 0
    assert "closed form" in capsys.readouterr().out
    assert cli.main(["compare", "ctof", "-q", "--out", "elsewhere"]) == 2
    assert "--out is for several runs" in capsys.readouterr().err
