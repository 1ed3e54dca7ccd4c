"""Sweeps of tiny scenes: plans, resumption, lost processes, failures, tables, a Dask cluster."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from moving_box import recording, with_colour
from sweep_work import Unloadable, die_once, pid, sleep

from gftorf_warp.cli import main
from gftorf_warp.data.lock import locked
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError, ResourceError, UsageError
from gftorf_warp.evaluate import pictures
from gftorf_warp.recon import checkpoint
from gftorf_warp.recon.observations import former_hash
from gftorf_warp.render.cuda import forget_peak_memory
from gftorf_warp.sweep import table
from gftorf_warp.sweep.command import read_results, sweep
from gftorf_warp.sweep.job import Task, do
from gftorf_warp.sweep.plan import Plan, Row, Scene, read_plan
from gftorf_warp.sweep.sheet import sheet
from gftorf_warp.sweep.workers import Lost, Place, Workers, places

TINY = """
scenes = ["demo", "box"]
presets = ["ctof", "demo"]
seeds = [0, 1]
images = 8
[simulate]
size = [16, 12]
frames = 8
[published]
others = { demo = [1.5, 0.5], box = 2 }
"""
JOBS = [
    "demo/simulated",
    *(f"{scene}/{row}-0" for scene in ("demo", "box") for row in ("ctof", "demo")),
    *(f"{scene}/demo-1" for scene in ("demo", "box")),
]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A folder with a plan, a sequence and the finished sweep; its results."""
    folder = tmp_path_factory.mktemp("sweep")
    write("ftorf", folder / "box", *recording(frames=8))
    (folder / "plan.toml").write_text(TINY)
    return folder, sweep(folder / "plan.toml", folder / "out", workers=1)


def test_every_job_has_a_result_and_a_run(swept):
    """Scenes x rows x seeds; a preset that fits nothing has no changes and one seed."""
    folder, results = swept
    assert list(results) == JOBS
    assert not [result["id"] for result in results.values() if "error" in result]
    for id in JOBS[1:]:
        assert (folder / "out" / "runs" / id / "config.json").is_file()
        assert results[id]["metrics"]["d_mse_x100"] > 0
    assert json.loads((folder / "out" / "sweep.json").read_text()) == list(results.values())
    kinds = {id: results[id]["metrics"]["seed"] for id in JOBS[1:]}
    assert kinds["box/demo-1"] == 1
    assert kinds["box/demo-0"] == 0


def test_what_is_done_is_not_done_again(swept):
    """The same call adds nothing; a lost result is made again from its finished run."""
    folder, results = swept
    store = folder / "out" / "results.jsonl"
    lines = store.read_text().splitlines()
    assert len(lines) == len(JOBS)
    assert sweep(folder / "plan.toml", folder / "out", workers=1).keys() == results.keys()
    assert store.read_text().splitlines() == lines
    cut = "\n".join(lines)[: -len(lines[-1]) // 2]  # a crash cut the last line off
    store.write_text(cut)
    again = sweep(folder / "plan.toml", folder / "out", workers=1)
    last = json.loads(lines[-1])["id"]
    assert again[last]["metrics"] == results[last]["metrics"]
    assert all(json.loads(line) for line in store.read_text().splitlines())


@pytest.mark.parametrize("damaged", ['{"id": "a"', "[]", '{"id": 3}', "{}", "null", "\x80"])
def test_a_damaged_result_is_named_by_its_line(tmp_path, damaged):
    """Not as if its job were not done; the last line, cut off by a crash, is."""
    store = tmp_path / "results.jsonl"
    good = '{"id": "box/ctof-0", "key": "k", "metrics": {}}\n'
    store.write_text(f"{good}{damaged}\n{good}", encoding="latin-1")
    with pytest.raises(InputError, match=r"(?s)results\.jsonl, line 2.*remove the line"):
        read_results(store)
    store.write_text(f"{good}{damaged}", encoding="latin-1")
    assert [*read_results(store)] == ["box/ctof-0"]


def test_a_result_with_the_former_hash_of_its_data_counts(tmp_path, monkeypatch):
    """It left out the lens of the colour camera."""
    write("capture", tmp_path / "box", with_colour(recording(frames=4)[0], size=(12, 9)))
    plan = Plan(scenes=(Scene(name="box", sequence=tmp_path / "box"),), rows=(Row(preset="ctof"),))
    task = Task(job=plan.fits[0], plan=plan, out=tmp_path / "out")
    with monkeypatch.context() as former:
        former.setattr("gftorf_warp.sweep.job.data_hash", former_hash)
        stored = do(task, Place("cpu"))
    again = do(replace(task, known=stored["key"]), Place("cpu"))
    assert again["key"] == stored["key"]
    assert "metrics" not in again
    assert do(replace(task, known="another"), Place("cpu"))["key"] != stored["key"]


def test_a_scene_that_a_lost_process_still_records_is_waited_for(swept, tmp_path):
    """Its parent was killed, and the sweep repeated: it ends, or its lock does."""
    plan = read_plan(swept[0] / "plan.toml")
    partial = tmp_path / "out" / "scenes" / "demo.partial"
    held = threading.Event()

    def hold():
        with locked(partial, ".lock", "sequence"):
            held.set()
            time.sleep(0.3)

    other = threading.Thread(target=hold)
    other.start()
    held.wait()
    result = do(Task(job=plan.recordings[0], plan=plan, out=tmp_path / "out"), Place("cpu"))
    other.join()
    assert "error" not in result, result
    assert (tmp_path / "out" / "scenes" / "demo").is_dir()


def test_the_table_has_means_spreads_and_what_others_published(swept):
    """Every number of the Markdown table from the results; the page shows all rows."""
    folder, results = swept
    rows = {}
    for line in (folder / "out" / "sweep.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        rows[tuple(cells[:2])] = cells[2:]
    errors = [results[f"box/demo-{seed}"]["metrics"]["d_mse_x100"] for seed in (0, 1)]
    low, high = sorted(errors)
    mean = f"{np.mean(errors):.3g}"
    given = rows["box", "demo"][0]
    assert given.startswith(mean)
    assert given in (mean, f"{mean} ({low:.3g} to {high:.3g})")
    assert rows["demo", "others (other data)"][:4] == ["1.5", "-", "-", "0.5"]
    closed = [
        results[f"{name}/ctof-0"]["metrics"]["closed_form_mse_x100"] for name in ("demo", "box")
    ]
    means = [
        np.mean([results[f"{name}/demo-{seed}"]["metrics"]["d_mse_x100"] for seed in (0, 1)])
        for name in ("demo", "box")
    ]
    ratio = np.exp(np.mean(np.log(np.divide(means, closed))))
    assert float(rows["over the closed form", "demo"][0]) == pytest.approx(ratio, rel=6e-3)
    short = {line[0]: line[1:] for line in table.overview(read_plan(folder / "plan.toml"), results)}
    assert short["d (d_ToF)"][:3] == ["demo", "box", "over the closed form"]
    tof = [results[f"demo/demo-{seed}"]["metrics"]["d_tof_mse_x100"] for seed in (0, 1)]
    assert short["demo"][0] == f"{means[0]:.3g} ({np.mean(tof):.3g})"
    assert short["demo"][2].startswith(rows["over the closed form", "demo"][0])
    assert [short["demo"][3], short["ctof"][3]] == ["4", "2"], "fits"
    assert short["others (other data)"][:3] == ["1.5 (0.5)", "2", "-"]
    assert (
        f"| {' | '.join(['demo', *short['demo']])} |" in (folder / "out" / "sweep.md").read_text()
    )
    page = (folder / "out" / "sweep.html").read_text()
    assert page.count("<img class") == 2, "a picture of each scene"
    assert "others (other data)" in page
    assert "Not as published" not in page, "nobody published these rows"


def test_a_picture_of_a_scene_has_all_rows_in_one_scale(swept):
    """Distances of truth, closed form and rows, errors below; a file, as on the page."""
    folder, results = swept
    plan = read_plan(folder / "plan.toml")
    for scene in plan.scenes:
        file = cv2.imread(str(folder / "out" / "pictures" / f"{scene.name}.png"))[..., ::-1]
        np.testing.assert_array_equal(file, sheet(plan, scene, folder / "out", results))
        with np.load(folder / "out" / "pictures" / scene.name / "demo-0.npz") as stored:
            distance, truth = stored["d"].astype(np.float32), stored["truth"].astype(np.float32)
        colours = pictures.colour_mapped(distance.copy(), pictures.distance_scale([truth]))
        factor = -(-320 // distance.shape[1])
        large = colours.repeat(factor, axis=0).repeat(factor, axis=1)
        assert shows(file, large), scene.name


def test_a_closed_form_that_is_nearly_right_does_not_hide_errors_of_others(swept, tmp_path):
    """Errors of a millimetre in a scene 1 m deep are dark, not the end of the scale."""
    folder, results = swept
    plan = read_plan(folder / "plan.toml")
    box = next(scene for scene in plan.scenes if scene.name == "box")
    truth = np.tile(np.linspace(1.0, 2.0, 320), (240, 1))
    right = {"truth": truth, "closed_form": truth, "closed_form_error": np.zeros_like(truth)}
    path = tmp_path / "pictures" / "box"
    path.mkdir(parents=True)
    np.savez(path / "demo-0.npz", d=truth, error=np.full_like(truth, 1e-3), **right)
    distances = pictures.distance_scale([truth])
    scale = pictures.error_scale([], least=0.05 * (distances.high - distances.low))
    assert scale.high > 0.04, "a millimetre is dark"
    dark = pictures.colour_mapped(np.full_like(truth, 1e-3), scale)
    assert shows(sheet(plan, box, tmp_path, results), dark)


def test_a_picture_of_a_job_that_fails_now_is_left_out(swept):
    """As its numbers are."""
    folder, results = swept
    plan, failed = read_plan(folder / "plan.toml"), {"error": "no memory", "exit_code": 5}
    box = next(scene for scene in plan.scenes if scene.name == "box")
    both, one, none = (
        sheet(plan, box, folder / "out", results | dict.fromkeys(ids, failed))
        for ids in ((), ("box/demo-0",), ("box/demo-0", "box/ctof-0"))
    )
    assert one.shape[1] < both.shape[1]
    assert none is None


def shows(picture, part):
    """Whether a picture has another one in it, at whatever place."""
    found = cv2.matchTemplate(picture, part, cv2.TM_SQDIFF)
    return found.min() < 1e-4 * found.mean()  # sums of 230,400 squares in float32


def test_what_is_assumed_is_named_below_the_table(swept):
    """With a mark at the row, in Markdown and on the page; a row that failed has neither."""
    plan = Plan(scenes=(Scene(name="demo"),), rows=(Row(preset="ftorf"), Row(preset="best")))
    scored = swept[1]["demo/demo-0"]
    found = {"demo/ftorf-0": scored | {"assumed": ["one guess", "another"]}, "demo/best-0": scored}
    text = table.markdown(plan, found)
    assert "| demo | ftorf * |" in text
    assert "| demo | best |" in text
    assert text.count("\n* ftorf: ") == 2
    both = table.markdown(plan, found | {"demo/best-0": found["demo/ftorf-0"]})
    assert "\n* ftorf, best: one guess" in both
    assert "another" in table.html(plan, found, {})
    failed = {"demo/ftorf-0": {"id": "demo/ftorf-0", "error": "none", "exit_code": 2}}
    assert "guess" not in table.markdown(plan, failed)


def test_the_command_prints_the_table_and_lists_jobs(swept, capsys):
    """The exit code is 0, and --dry-run does nothing."""
    folder, _ = swept
    assert main(["sweep", str(folder / "plan.toml"), "--dry-run"]) == 0
    assert capsys.readouterr().out.split() == JOBS
    assert main(["sweep", str(folder / "plan.toml"), "--out", str(folder / "out"), "-q"]) == 0
    assert "| box | demo |" in capsys.readouterr().out


def test_a_job_that_fails_is_a_row_with_its_error(tmp_path):
    """The others are done, the exit code is that of the error."""
    write("ftorf", tmp_path / "box", *recording(frames=8))
    plan = Plan(
        scenes=(Scene(name="box", sequence=tmp_path / "box"),),
        rows=(Row(preset="ctof"), Row(preset="demo", changes=("render.zoom=2",), label="zoom")),
    )
    results = sweep(plan, tmp_path / "out", workers=1)
    assert "error" not in results["box/ctof-0"]
    assert "zoom" in results["box/demo+zoom-0"]["error"]
    assert table.exit_code(results.values()) == 2
    assert "failed: box/demo+zoom-0" in (tmp_path / "out" / "sweep.md").read_text()
    assert "What failed" in (tmp_path / "out" / "sweep.html").read_text()


def test_a_fit_that_cannot_be_scored_is_not_begun(tmp_path):
    """ftorf13 leaves out the first and the last quartet."""
    write("ftorf", tmp_path / "box", *recording(frames=8))
    scenes = (Scene(name="box", sequence=tmp_path / "box"),)
    plan = Plan(scenes=scenes, rows=(Row(preset="demo"),), images=1, frames="ftorf13")
    result = do(Task(job=plan.fits[0], plan=plan, out=tmp_path / "out"), Place("cpu"))
    assert result["error"].startswith("protocol ftorf13 leaves no frame")
    assert result["exit_code"] == 2
    assert not (tmp_path / "out").exists()


WRONG = {
    "scenes = []": "not empty",
    'scenes = ["demo"]': "presets",
    'scenes = ["demi"]\npresets = ["best"]': "did you mean demo",
    'scenes = ["demo"]\npresets = ["bets"]': "did you mean best",
    'scenes = ["demo", "demo"]\npresets = ["best"]': "two are called demo",
    'scenes = ["demo"]\npresets = ["best"]\nseeds = [-1]': "whole numbers",
    'scenes = ["demo"]\npresets = ["best"]\nseeds = true': "list of whole numbers",
    'scenes = ["demo"]\npresets = ["best"]\nimages = 0': "at least 1",
    'scenes = ["demo"]\npresets = ["best"]\nimage = 4': "did you mean images",
    'scenes = ["demo"]\npresets = ["best"]\n[simulate]\nsized = 3': "did you mean size",
    'scenes = ["demo"]\npresets = ["best"]\n[changes]\na = "b=1"': "list of settings",
    'scenes = ["demo"]\npresets = ["best"]\n[changes]\n"../x" = ["b=1"]': "letters",
    'scenes = ["demo"]\npresets = ["best"]\n[published]\nx = 3': "expected a table",
    'scenes = ["demo"]\npresets = ["best"]\n[published]\nx = {demo = "3"}': "error of d",
    'scenes = ["demo"]\nrows = {a = 3}': "table with a preset",
    'scenes = ["demo"]\nrows = {"a b" = {preset = "best"}}': "letters",
    'scenes = ["demo"]\nrows = {a = {preset = "bets"}}': "did you mean best",
    'scenes = ["demo"]\nrows = {a = {preset = "best", inputs = "quads"}}': "did you mean input",
    'scenes = ["demo"]\nrows = {a = {preset = "best", images = 0}}': "from 1 on",
    'scenes = ["demo"]\npresets = ["best"]\nrows = {best = {preset = "fast"}}': "this name",
    'scenes = ["demo"]\npresets = ["best"]\none_seed = ["bst"]': "did you mean best",
    'scenes = ["demo"]\npresets = ["best"]\nframes = "ftorf31"': "all or ftorf13",
    "scenes = [": "Invalid",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_plan_is_a_named_error(tmp_path, text):
    """Before any work, with the key."""
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(InputError, match="(?s)plan.toml.*" + WRONG[text]):
        read_plan(tmp_path / "plan.toml")


@pytest.mark.parametrize(("deaths", "outcome"), [(1, (1, "cpu")), (9, None)])
def test_a_lost_process_costs_a_try(tmp_path, deaths, outcome):
    """The task is done by another one, at most three times."""
    with Workers([Place("cpu")], die_once) as workers:
        ((_, found),) = workers.outcomes([(str(tmp_path), deaths)])
    if outcome is None:
        assert found == Lost("its process was ended by a signal (Killed), as when memory is short")
        assert len(list(tmp_path.iterdir())) == 3
    else:
        assert found == outcome


def test_a_process_that_is_killed_while_it_is_idle_is_replaced():
    """The next task is done by another one."""
    with Workers([Place("cpu")], pid) as workers:
        ((_, first),) = workers.outcomes([0])
        os.kill(first, signal.SIGKILL)
        ((_, second),) = workers.outcomes([0])
    assert second != first


def test_a_process_whose_parent_was_killed_notices(tmp_path):
    """It works on nothing that a repeated sweep would wait for."""
    program = f"""
import multiprocessing, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from gftorf_warp.sweep.workers import Place, Workers
from sweep_work import until_parent_ends
with Workers([Place("cpu")], until_parent_ends) as workers:
    multiprocessing.set_forkserver_preload([])  # it would import torch
    [*workers.outcomes([{str(tmp_path)!r}])]
"""
    with subprocess.Popen([sys.executable, "-c", program]) as parent:
        assert appears(tmp_path / "begun")
        assert not (tmp_path / "noticed").exists()
        parent.kill()
    assert appears(tmp_path / "noticed")


def test_a_job_whose_parent_was_killed_stops(swept, tmp_path, monkeypatch):
    """With a checkpoint of what it has done."""
    monkeypatch.setattr("gftorf_warp.sweep.job.parent_lives", lambda: False)
    plan = read_plan(swept[0] / "plan.toml")
    job = next(job for job in plan.fits if job.id == "box/demo-0")
    with pytest.raises(KeyboardInterrupt):
        do(Task(job=job, plan=plan, out=tmp_path), Place("cpu"))
    assert checkpoint.last(tmp_path / "runs" / job.id)["images"] == 8


def appears(path, patience_s=30.0):
    """Whether a file is made in time."""
    end = time.monotonic() + patience_s
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.01)
    return path.exists()


def test_a_process_that_cannot_import_its_work_says_so():
    """As one with too little memory: it is not tried again, and its place is free for others."""
    with Workers([Place("cpu")], Unloadable()) as workers:
        found = [outcome for _, outcome in workers.outcomes([0, 1])]
    assert found == [Lost("its process could not begin: libtorch: failed to map segment")] * 2


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, "no memory"),
        cv2.error("std::bad_alloc"),
    ],
    ids=["array", "thread", "process", "opencv"],
)
def test_a_job_without_memory_says_so(swept, tmp_path, monkeypatch, error):
    """It is no bug of ours: the exit code is 5."""

    def fails(*_, **__):
        raise error

    monkeypatch.setattr("gftorf_warp.sweep.job.reconstruct", fails)
    plan = read_plan(swept[0] / "plan.toml")
    job = next(job for job in plan.fits if job.scene.sequence is not None)
    result = do(Task(job=job, plan=plan, out=tmp_path), Place("cpu"))
    assert result["error"].startswith("out of memory")
    assert result["exit_code"] == 5


def test_a_scene_that_could_not_be_simulated_is_named_by_its_fits(swept, tmp_path):
    """They are not tried; the other scene is done, and the exit code is that of memory."""
    settings = {"size": (30_000, 30_000), "frames": 8}  # refused before any work
    plan = replace(read_plan(swept[0] / "plan.toml"), rows=(Row(preset="ctof"),), simulate=settings)
    results = sweep(plan, tmp_path / "out", workers=1)
    assert results["demo/ctof-0"]["error"].startswith("without its scene: not enough memory")
    assert "error" not in results["box/ctof-0"]
    assert table.exit_code(results.values()) == 5


def test_processes_end_with_their_owner():
    """A job that goes on when the loop is left is told to end."""
    begun = time.monotonic()
    with Workers([Place("cpu"), Place("cpu")], sleep) as workers:
        assert next(workers.outcomes([0.0, 600.0])) == (0.0, None)
    assert time.monotonic() - begun < 60.0


def test_places_share_gpus_and_cpus():
    """One process per GPU; more of them take turns; all CPUs are used once."""
    found = places(["cuda:0", "cuda:1"])
    assert [place.device for place in found] == ["cuda:0", "cuda:1"]
    found = places(["cuda:0"], 2)
    assert [place.device for place in found] == ["cuda:0"] * 2
    used = [cpu for place in found for cpu in place.cpus]
    assert len(used) == len({*used})
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1:
        assert {*used} == os.sched_getaffinity(0)


def test_rows_are_presets_with_and_without_changes(tmp_path):
    """Changes are for presets that fit something; one_seed keeps expensive ones to the first."""
    text = 'scenes = ["demo"]\npresets = ["ctof", "best", "fast"]\nseeds = [3, 4]\n'
    text += 'one_seed = ["fast"]\n[changes]\nwide = ["render.low_pass=0.3"]\n'
    (tmp_path / "plan.toml").write_text(text)
    plan = read_plan(tmp_path / "plan.toml")
    first = ["ctof-3", "best-3", "best+wide-3", "fast-3", "fast+wide-3"]
    wanted = [*first, "best-4", "best+wide-4"]
    assert [job.id for job in plan.fits] == [f"demo/{name}" for name in wanted]
    assert plan.rows[2].changes == ("render.low_pass=0.3",)


def test_a_cluster_does_the_same_jobs(tmp_path, monkeypatch):
    """On a Dask worker, a thread here behind TCP; without a scheduler a named error."""
    distributed = pytest.importorskip("distributed", reason="extra cluster is not installed")
    (tmp_path / "plan.toml").write_text(
        'scenes = ["demo"]\npresets = ["ctof", "temporal"]\n'
        "[simulate]\nsize = [16, 12]\nframes = 8\n"
    )
    one = {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    where = {"host": "127.0.0.1", "protocol": "tcp", "dashboard_address": None}
    with distributed.LocalCluster(**one, **where) as cluster:
        address = cluster.scheduler_address
        there = sweep(tmp_path / "plan.toml", tmp_path / "there", scheduler=address)
    here = sweep(tmp_path / "plan.toml", tmp_path / "here", workers=1)
    assert not [result for result in there.values() if "error" in result]
    for id in ("demo/ctof-0", "demo/temporal-0"):
        assert there[id]["metrics"]["d_mse_x100"] == here[id]["metrics"]["d_mse_x100"]
    monkeypatch.setattr("gftorf_warp.sweep.cluster.CONNECT_S", 1.0)
    with pytest.raises(ResourceError, match="no Dask scheduler answers"):
        sweep(tmp_path / "plan.toml", tmp_path / "nowhere", scheduler="tcp://127.0.0.1:9")


def test_the_memory_of_a_job_is_not_that_of_the_one_before(monkeypatch):
    """A process does several jobs; CUDA's peak is reset where there is a GPU in use only."""
    forgotten = []
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", forgotten.append)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: False)
    forget_peak_memory("cuda:1")
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    forget_peak_memory("cpu")
    assert forgotten == []
    forget_peak_memory("cuda:1")
    assert forgotten == ["cuda:1"]


def test_rows_are_described_one_by_one(tmp_path):
    """With input, row of the ablation table and length of their own, also without presets."""
    text = 'scenes = ["demo"]\nseeds = [0, 1]\nimages = 8\none_seed = ["bright"]\n'
    text += '[rows.phasors]\npreset = "released"\ninput = "phasor"\n'
    text += '[rows.bright]\npreset = "paper"\nablation = "h1"\nimages = 4\n'
    (tmp_path / "plan.toml").write_text(text)
    plan = read_plan(tmp_path / "plan.toml")
    assert [job.id for job in plan.fits] == [
        f"demo/{name}" for name in ("phasors-0", "bright-0", "phasors-1")
    ]
    given = [row.arguments(plan.images) for row in plan.rows]
    assert [(g["input"], g["ablation"], g["images"]) for g in given] == [
        ("phasor", None, 8),
        ("auto", "h1", 4),
    ]
    assert [row.name for row in plan.only(["bright"]).rows] == ["bright"]
    with pytest.raises(UsageError, match="did you mean bright"):
        plan.only(["brigt"])


def test_what_a_method_cannot_do_is_said_in_its_row(tmp_path):
    """A camera that moves, no colour: no error, and the rows that were not asked for stay."""
    sequence, images = recording(frames=8)
    write("ftorf", tmp_path / "box", sequence, images)
    plan = Plan(
        scenes=(Scene(name="box", sequence=tmp_path / "box"),),
        rows=(Row(preset="ctof"), Row(preset="dgs", title="from-colour")),
        images=4,
    )
    first = sweep(plan, tmp_path / "out", rows=["ctof"], workers=1)
    assert [*first] == ["box/ctof-0"]
    results = sweep(plan, tmp_path / "out", rows=["from-colour"], workers=1)
    assert [*results] == ["box/ctof-0", "box/from-colour-0"]
    assert results["box/from-colour-0"]["refused"] == "no colour"
    assert table.exit_code(results.values()) == 0
    text = (tmp_path / "out" / "sweep.md").read_text()
    assert "| box | from-colour | not applied: no colour | - |" in text
    assert "not applied: box, from-colour: no colour: preset dgs compares colour alone" in text
    assert f"| box | ctof | {first['box/ctof-0']['metrics']['d_mse_x100']:.3g} |" in text
    assert "What cannot be applied" in (tmp_path / "out" / "sweep.html").read_text()
