"""The benchmark of scenes: fits in processes, results that are not repeated, failures as rows, and
what its tables say.
"""

import json
import multiprocessing
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import accuracy
import accuracy_jobs
import accuracy_table

from gftorf_warp import simulate
from gftorf_warp.data.flow import compute_flow
from gftorf_warp.data.read import read
from gftorf_warp.data.sequence import Flow
from gftorf_warp.sim.random_scene import random_scene
from gftorf_warp.sim.world import first_hit
from gftorf_warp.sweep import workers

PLACE = workers.Place("cpu")
TINY = ["--size", "40x30", "--frames", "8", "--images", "8", "--seeds", "0,1", "--workers", "1"]


def setup_in(folder):
    """A setup of tiny images."""
    return accuracy_jobs.Setup(
        out=folder, size=(40, 30), frames=8, images=8, device="cpu", keep=False
    )


def result(row, scene, seed, d, closed=(1.0, 1.0, 1.0), **more):
    """A result with errors of d on all, moving and static pixels."""
    scores = {}
    for part, error, other in zip(("all", "moving", "static"), d, closed, strict=True):
        named = {
            "d": error,
            "d_tof": error,
            "closed_form": other,
            "temporal": 0.5 * other,
            "d_fit": 2.0 * error,
        }
        scores[part] = {f"{name}_mse_x100": value for name, value in named.items()}
    interior = {"d_mse_x100": d[2], "temporal_mse_x100": 0.25}
    scores["static_throughout"] = {"d_mse_x100": d[2], "temporal_mean_mse_x100": 0.5}
    scores["source"] = {"fit": 0.8} if seed == 0 else None
    share = 0.01 if "attempts" not in more else 0.04
    ranges = {key: [0, 7] for key in ("columns", "rows", "frames")}
    others = dict.fromkeys(("changing_unexplained_share", "contradicted_share"))
    shares = {"reduced_chi_square": 2.0, "unexplained_share": share}
    scores["explained"] = shares | ranges | others
    classes = {"moving": {"edge": {"d_mse_x100": 3.0, "closed_form_mse_x100": 6.0}}}
    scores |= scores.pop("all") | {"classes": classes | {"static": {"interior": interior}}}
    return {"row": row, "scene": scene, "seed": seed, "scores": scores} | {
        "id": f"{row}/{scene}/{seed}",
        "seconds": 1.0,
        "gaussians": 7,
        "rise": 1.0 + seed,
        **more,
    }


@dataclass(frozen=True, kw_only=True)
class Endless(accuracy_jobs.Job):
    """A job that never ends."""

    def folder(self, setup):
        """Waits in any process but that of the test."""
        while multiprocessing.parent_process() is not None:
            time.sleep(1.0)
        return super().folder(setup)


@dataclass(frozen=True, kw_only=True)
class Deadly(accuracy_jobs.Job):
    """A job that kills its process, as a lack of memory does."""

    def folder(self, setup):
        """Ends any process but that of the test."""
        if multiprocessing.parent_process() is not None:
            os._exit(9)
        return super().folder(setup)


def test_a_benchmark_of_two_scenes(tmp_path, capsys):
    """Every fit is a line with its errors, none is repeated, a failed one is a row and is tried
    again; tables and picture exist.
    """
    shared = tmp_path / "others"
    simulate("random-3", shared / "axial", size=(40, 30), frames=8, engine="mesh")
    simulate("random-3", tmp_path / "fine" / "axial", size=(80, 60), frames=8, engine="mesh")
    rows = ["--row", "ctof", "--row", "short=demo,weights.ssim=0.1", "--row", "bad=demo,no.such=1"]
    command = [
        "--out",
        str(tmp_path / "acc"),
        *rows,
        *TINY,
        "--scenes",
        "1",
        "--shared",
        str(shared),
        "--finer",
        str(tmp_path / "fine"),
    ]
    assert accuracy.main(command) == 1
    first = capsys.readouterr()
    assert "## tuning: 1 scenes" in first.out
    assert "## shared: 1 scenes" in first.out
    lines = (tmp_path / "acc" / "results.jsonl").read_text().splitlines()
    assert len(lines) == 2 + 3 * 2 * 2
    results = {line["id"]: line for line in map(json.loads, lines)}
    floor = results["shared/axial@given"]["floor"]
    assert 0 < floor["static"] < floor["all"] < floor["moving"]
    fit = results["short/random-1@40x30x8/8/1"]
    assert fit["scores"]["images_optimised"] == 8
    assert fit["seconds"] > 0
    assert fit["rise"] >= 1
    closed = results["ctof/random-1@40x30x8/8/0"]["scores"]
    assert closed["d_mse_x100"] == pytest.approx(closed["closed_form_mse_x100"])
    assert "no.such" in results["bad/shared/axial@given/8/0"]["error"]
    assert "bad/shared/axial@given/8/0: UsageError" in first.out
    picture = cv2.imread(str(tmp_path / "acc" / "worst.png"))
    assert picture.shape[1] >= 4 * 40
    assert (tmp_path / "acc" / "table.md").read_text() in first.out
    assert not list((tmp_path / "acc" / "runs").glob("*/config.json")), "runs are not kept"

    assert accuracy.main(command) == 1
    again = (tmp_path / "acc" / "results.jsonl").read_text().splitlines()
    assert again[: len(lines)] == lines
    assert all("error" in json.loads(line) for line in again[len(lines) :])
    assert len(again) == len(lines) + 4
    title = "## tuning"
    assert capsys.readouterr().out.partition(title)[2] == first.out.partition(title)[2]


def test_a_limit_leaves_jobs_for_later(tmp_path, capsys):
    """With no time left nothing is done, and the command says what is left."""
    command = ["--out", str(tmp_path), "--row", "ctof", *TINY, "--scenes", "0-1", "--limit", "0"]
    assert accuracy.main(command) == 0
    assert "6 jobs are left" in capsys.readouterr().out


def test_rows_that_differ_after_the_fit_share_it(tmp_path):
    """One fit, scored with and without outlines; flow is in the sequence, as a fit computes it."""
    listed = tmp_path / "rows.txt"
    listed.write_text("# a comment\nbest\n\nplain=best,outlines=false  # another\n")
    command = ["--out", str(tmp_path), "--rows", str(listed), *TINY[:-3], "0", "--workers", "1"]
    assert accuracy.main([*command, "--scenes", "1", "--flow"]) == 0
    lines = map(json.loads, (tmp_path / "results.jsonl").read_text().splitlines())
    _, best, plain = lines
    assert (best["row"], plain["row"]) == ("best", "plain")
    assert best["seconds"] == plain["seconds"]
    assert best["scores"]["source"]["outline"] > plain["scores"]["source"]["outline"] == 0
    assert best["scores"]["d_mse_x100"] != plain["scores"]["d_mse_x100"]
    (folder,) = (tmp_path / "scenes").iterdir()
    sequence = read(folder)
    computed = compute_flow(replace(sequence, flow=Flow()))
    for n, image in computed.forward.items():
        np.testing.assert_array_equal(image, sequence.flow.forward[n])


def test_other_settings_or_data_are_another_key(tmp_path):
    """A result is kept only for the same settings, seed and data."""
    folder, setup = tmp_path, setup_in(tmp_path)
    first = accuracy_jobs.Job(scene="random-1")
    assert accuracy_jobs.result_of(first, setup, None)["floor"]["all"] > 0
    row = accuracy_jobs.Row.of("ctof")
    job = accuracy_jobs.Job(scene="random-1", row=row)
    key = accuracy_jobs.result_of(job, setup, None)["key"]
    assert accuracy_jobs.result_of(job, setup, key) is None
    assert accuracy_jobs.result_of(job, setup, "other")["key"] == key
    changed = accuracy_jobs.Job(
        scene="random-1", row=accuracy_jobs.Row.of("ctof=ctof,quad_scale=2")
    )
    assert accuracy_jobs.result_of(changed, setup, key)["key"] != key
    assert (folder / "scenes").is_dir()


def test_the_edge_floor_is_the_error_of_the_mean_over_a_pixel(tmp_path):
    """Against first hits in float64 of 4x4 rays per pixel, which share no code with the tracer."""
    setup, scene = setup_in(tmp_path), random_scene(1)
    found = accuracy_jobs.result_of(accuracy_jobs.Job(scene="random-1"), setup, None)
    times = np.array([0, 4]) / 120  # starts of quartets
    camera = scene.camera((40, 30))
    fine = [first_hit(scene.bodies, camera.finer(4), time).distance for time in times]
    mean = np.stack(fine).reshape(2, 30, 4, 40, 4).mean((2, 4))
    centre = np.stack([first_hit(scene.bodies, camera, time).distance for time in times])
    want = 100 * np.mean((mean - centre) ** 2)
    assert found["floor"]["all"] == pytest.approx(want, rel=1e-2)
    assert found["floor"]["static"] < want < found["floor"]["moving"]


def test_a_process_that_dies_is_a_failed_job(tmp_path):
    """The others are done by another process."""
    jobs = [Deadly(scene="random-1"), accuracy_jobs.Job(scene="random-2")]
    with workers.Workers([PLACE], accuracy_jobs.Work(setup_in(tmp_path))) as one:
        found = dict(one.outcomes([((job, None),) for job in jobs], tries=1))
    assert found[((jobs[0], None),)] == workers.Lost("its process ended with exit code 9")
    assert "error" not in found[((jobs[1], None),)][0]


def test_a_job_that_never_ends_is_left_after_the_limit(tmp_path, monkeypatch):
    """Its process is killed when the time is over."""
    monkeypatch.setattr(workers, "GRACE_S", 0.1)
    with workers.Workers([PLACE], accuracy_jobs.Work(setup_in(tmp_path))) as one:
        limit = time.monotonic() + 0.1
        assert list(one.outcomes([((Endless(scene="random-1"), None),)], deadline=limit)) == []


def test_rows_and_numbers_of_the_command_line(capsys):
    """Names, presets, changes, ranges; validation scenes need their option."""
    row = accuracy_jobs.Row.of("plane=fast,render.near=0.2,weights.ssim=0")
    assert (row.name, row.preset) == ("plane", "fast")
    assert row.changes == ("render.near=0.2", "weights.ssim=0")
    assert accuracy_jobs.Row.of("ctof") == accuracy_jobs.Row(name="ctof", preset="ctof")
    assert accuracy.numbers("0-2,7") == [0, 1, 2, 7]
    assert accuracy.numbers("none") == []
    for wrong in (["--scenes", "100"], ["--scenes", "1", "--validation"], ["--row", "ctof"]):
        with pytest.raises(SystemExit):
            accuracy.main(["--out", "unused", "--row", "ctof", *wrong])
    assert "name of its own" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        accuracy.main(["--out", "unused", "--row", "fats"])
    assert "'fats' names none of the presets best, demo, " in capsys.readouterr().err


def test_the_summary_is_means_over_scenes_and_seeds():
    """Geometric means, the worst scene, scenes and fits worse in any part, spread, failures."""
    results = [
        result("a", "one", 0, (0.1, 0.2, 0.5)),
        result("a", "one", 1, (0.4, 0.2, 1.5), attempts=2),
        result("a", "two", 0, (0.8, 0.4, 0.9)),
        result("a", "two", 1, (0.8, 0.4, 0.9)),
        {"row": "a", "scene": "two", "seed": 2, "id": "a/two/2", "error": "no memory"},
    ]
    floor = {"all": 0.1, "moving": None, "static": 0.05}
    scenes = [{"scene": "one", "about": "text", "floor": floor}, {"scene": "two"}]
    lines = accuracy_table.summary(["a", "b"], scenes, results).splitlines()
    assert lines[2].startswith(
        "| edge floor | 0.1 / - / 0.05 | - | - / - / - | - / - / - | 0.2 / - / 0.1 |"
    )
    line = lines[3].split(" | ")
    assert line[1] == "0.4 / 0.283 / 0.883"
    assert line[2] == "0.8 / 0.566 / 1.77, 10 %"
    assert line[5:8] == ["0.8 / 0.566 / 1.77", "- / 0.5, - / -", "3.53, 1.77"]
    assert line[8:10] == ["two 0.8", "1 of 2 scenes, 1 of 4 fits"]
    assert line[10:14] == ["2 of 2 scenes, 3 of 4 fits", "2, 4", "1.5, 2", "2, 1.8 %"]
    assert line[14] == "1, 1, 2"
    assert line[-1] == "1 |"
    assert lines[4].count("-") >= 9
    assert accuracy_table.worst_first(results[:4])[0]["id"] == "a/one/1"
    assert "a/two/2: no memory" in accuracy_table.failures(results)
    row = accuracy_table.details(["a"], scenes, results).splitlines()[2]
    assert row == "| one | text | 1 / 1 / 1 | 0.1 / - / 0.05 | 0.25 / 0.2 / 1 **worse** |"
