"""``gftorf bench`` at small sizes: every part measures something,
and what it writes says on what.
"""

import json

import pytest
import torch

from gftorf_warp import Sequence, cli
from gftorf_warp.bench import command, motion, renderer, states, step, timing
from gftorf_warp.errors import DivergedError, InputError, ResourceError, UsageError
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Batch
from gftorf_warp.render import launch, stages
from gftorf_warp.render.cublas import CublasLayers
from gftorf_warp.render.tensor_cores import FusedLayers
from gftorf_warp.scene.motion import MotionSettings, Products
from gftorf_warp.scene.network import Network

DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The quick sequence in a folder."""
    return states.simulated(tmp_path_factory.mktemp("bench") / "sequence", quick=True)


@pytest.fixture(scope="module")
def fitted(recorded):
    """The quick state."""
    sequence = Sequence.open(recorded)
    settings = states.settings_of(sequence, "released", [], DEVICE)
    return states.from_phase(sequence, settings, DEVICE, quick=True)


def test_quick_bench_writes_everything_it_prints(tmp_path, capsys):
    """All parts but the reconstruction, which has a test of its own; tables on stdout,
    the same rows in the file.
    """
    path = tmp_path / "bench.json"
    names = ["renderer", "motion", "step", "render"]
    assert cli.main(["bench", *names, "--quick", "--device", "cpu", "--json", str(path)]) == 0
    printed = capsys.readouterr().out
    found = json.loads(path.read_text())
    assert list(found["parts"]) == names
    for name in ("device", "driver", "warp", "torch", "commit", "cpus", "python", "gftorf_warp"):
        assert name in found
    assert found["quick"] is True
    for part in found["parts"].values():
        assert part["seconds"] > 0
        assert part["rows"]
    for row in found["parts"]["renderer"]["rows"]:
        assert row["pairs"] > row["N"] > 0
        eager = row["forward_backward"]["eager"]
        assert 0 < eager["p10"] <= eager["median"] <= eager["p90"]
        assert f"{eager['median']:.3f} (" in printed
    for row in found["parts"]["render"]["rows"]:
        assert row["images_per_s"] > 0
        assert f"{row['images_per_s']:.1f}" in printed
    assert [row["way"] for row in found["parts"]["render"]["rows"]] == [
        "render",
        "renderer",
        "unchecked",
        "series",
        "host",
        "files",
        "stored",
    ]
    ways = {row["batch"] for row in found["parts"]["step"]["rows"]}
    assert ways == {str(batch) for batch in Batch}
    assert all(row["pairs"] > row["N"] > 0 for row in found["parts"]["step"]["rows"])
    assert all(row["skipped"] == 0 for row in found["parts"]["step"]["rows"])


def test_reconstruction_with_both_kernel_caches(tmp_path, monkeypatch):
    """The same run twice: the same end, and a curve from image 0 to the last."""
    monkeypatch.setattr("gftorf_warp.bench.reconstruction.QUICK_IMAGES", 8)
    wanted = command.Wanted(device="cpu", quick=True, preset="demo")
    seen = []
    path = tmp_path / "bench.json"
    found = command.bench(
        ["reconstruction"],
        wanted,
        json=path,
        progress=lambda _: lambda *a, **_: seen.append(a),
        say=lambda _: None,
    )
    cold, warm = found["parts"]["reconstruction"]["rows"]
    assert (cold["kernels"], warm["kernels"]) == ("cold", "warm")
    assert cold["images"] == warm["images"] == 8
    assert cold["d_mse_x100"] == warm["d_mse_x100"] > 0
    assert cold["wall_s"] > cold["seconds"] > 0
    assert [look["images"] for look in warm["curve"]][:: len(warm["curve"]) - 1] == [0, 8]
    assert warm["curve"][-1]["seconds"] <= warm["seconds"]
    assert seen[-1] == (16, 16)
    assert json.loads(path.read_text())["parts"].keys() == found["parts"].keys()


def test_a_reconstruction_that_fails_says_why(recorded):
    """The exit code of the other process decides the error; its words are in it."""
    wanted = command.Wanted(device="cpu", quick=True, sequence=recorded, changes=("no.such=1",))
    with pytest.raises(UsageError, match=r"no\.such"):
        command.bench(["reconstruction"], wanted, say=lambda _: None)


@pytest.mark.parametrize(
    ("words", "code", "hint"),
    [
        (["rendere"], 2, "unknown part rendere"),
        (["step", "--sequence", "nowhere"], 2, "--sequence"),
        (["step", "--run", "nowhere"], 2, "--run"),
        (["motion", "--json", "nowhere/bench.json"], 2, "its folder does not exist"),
        (["motion", "--json", "."], 2, "--json names a folder"),
        (["step", "--sequence", "."], 3, "error:"),
        (["motion", "--device", "cuda"], 5, "cuda"),
    ],
)
def test_mistakes_are_named_before_anything_is_measured(
    words, code, hint, tmp_path, monkeypatch, capsys
):
    """Unknown parts, missing folders, files that cannot be written, no GPU."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    # measuring would fail
    monkeypatch.setattr(command, "PARTS", dict.fromkeys(command.PARTS, (None, None)))
    device = [] if "--device" in words else ["--device", "cpu"]
    assert cli.main(["bench", *words, *device]) == code
    assert hint in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_what_was_measured_before_an_interruption_is_kept(tmp_path, monkeypatch):
    """The file is whole after every part."""

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setitem(command.PARTS, "motion", (interrupted, motion.table))
    path = tmp_path / "bench.json"
    with pytest.raises(KeyboardInterrupt):
        command.bench(
            ["renderer", "motion"],
            command.Wanted(device="cpu", quick=True),
            json=path,
            say=lambda _: None,
        )
    assert list(json.loads(path.read_text())["parts"]) == ["renderer"]


def test_times_are_those_of_the_runs():
    """Warm-up does not count, order does not matter, and nothing waits between two runs."""
    clock = iter([*range(0, 100, 10), *range(0, 100, 10)])
    calls = []

    class Watch(timing.HostWatch):
        def mark(self):
            return next(clock) * 1e-3

    found = timing.timed(lambda: calls.append(0), Watch(), 5)
    assert len(calls) == timing.WARM_UP + 5
    assert found.median == pytest.approx(10)
    assert timing.timed(lambda: None, Watch(), 5, within=5).median == pytest.approx(2)
    assert timing.Timing.of([3.0, 1.0, 2.0]).median == 2.0


def test_what_cannot_be_captured_is_reported(caplog):
    """The table goes on without the graph, and says why."""

    class Watch(timing.HostWatch):
        def captured(self, function):  # noqa: ARG002
            raise RuntimeError("operation not permitted\nmore")

    found = timing.both_ways(lambda: None, Watch(), 2)
    assert found["graph"] is None
    assert found["graph_error"] == "operation not permitted"
    assert "operation not permitted" in caplog.text


def test_stages_are_those_of_a_rendering():
    """Every stage that launch.py asks for, in its order; repeated,
    they leave the image as it was.
    """
    import warp as wp

    case = renderer.Case("surface", 300, 0.03, 0.6, "training", wp.get_device(DEVICE))
    case.both()
    want, gradient = case.images.quads.numpy(), case.wanted.mean.numpy()
    case.wanted.mean.zero_()
    found = case.stages()
    assert launch.stages is stages
    assert list(found)[:2] == ["project", "sort_by_depth"]
    assert list(found)[-1] == "project_backward"
    case.images.quads.zero_()
    case.wanted.mean.zero_()
    for function in found.values():
        function()
    assert (case.images.quads.numpy() == want).all()
    assert abs(gradient).max() > 0


def test_the_families_hold_what_they_say():
    """Distance of the wavy surface within 1 .. 5 m; training has no colour and one quad."""
    import warp as wp

    case = renderer.Case("volume", 300, 0.03, 0.1, "training", wp.get_device("cpu"))
    assert case.inputs.colour_sh is None
    assert case.cotangents.quads.shape[0] == 1
    assert case.cotangents.distance is None
    depth = renderer.scene_of("surface", 1000, 0.03, 0.6)["mean"][:, 2]
    assert 1.0 <= depth.min() < depth.max() <= 5.02
    with pytest.raises(ValueError, match="form"):
        renderer.Case("surface", 3, 0.03, 0.6, "some", wp.get_device("cpu"))


def test_the_state_is_in_its_middle(fitted, tmp_path):
    """As many Gaussians as asked for, a network that moves them, past the warm-up;
    as a folder it is a run.
    """
    low, high = states.QUICK_COUNT
    assert low <= fitted.gaussians <= high
    assert (
        fitted.settings.schedule.warm_up
        < fitted.stored["images"]
        < 0.6 * fitted.settings.schedule.images
    )
    assert fitted.observations.flow
    run = Run.open(states.as_run(fitted, tmp_path / "run", DEVICE), DEVICE)
    assert run.gaussians == fitted.gaussians
    rendering = run.render(0.0)
    assert float(rendering.opacity.mean()) > 0.9


def test_every_way_of_a_step_is_timed_once(fitted):
    """What is set stays set; a CPU has one precision and no graphs."""
    every = step.ways(fitted.settings, [], "cpu")
    assert len(every) == len(Batch)
    assert {way.motion.products for way in every} == {Products.FLOAT32}
    on_gpu = step.ways(fitted.settings, [], "cuda:0")
    assert {way.motion.products for way in on_gpu} == set(Products)
    assert {way.graph for way in on_gpu} == {False, True}
    assert len({(w.graph, w.schedule.batch, w.motion.products) for w in on_gpu}) == len(on_gpu)
    assert {way.graph for way in step.ways(fitted.settings, ["graph=true"], "cuda:0")} == {
        fitted.settings.graph
    }


def test_a_run_without_checkpoint_is_refused(fitted, tmp_path):
    """Named by --run, it has to hold one."""
    with pytest.raises(InputError, match="no checkpoint"):
        states.from_run(tmp_path, fitted.sequence, fitted.settings, DEVICE)


def test_errors_of_another_process_keep_their_class():
    """By exit code; an unknown one is a matter of resources."""
    from gftorf_warp.bench.reconstruction import error_of

    assert isinstance(error_of("", 4), DivergedError)
    assert isinstance(error_of("", -9), ResourceError)


def test_half_precision_has_a_row_of_torch_where_steps_have_kernels(monkeypatch):
    """There are two ways then; elsewhere a second row would measure the same again."""
    assert motion.kinds("cpu") == [str(kind) for kind in Products]
    fitting = lambda form, device: (form.width, device.type) == (256, "cpu")  # noqa: E731
    monkeypatch.setattr(motion, "fits", fitting)
    monkeypatch.setattr("gftorf_warp.render.network.fits", fitting)
    assert motion.kinds("cpu") == [*map(str, Products), motion.BY_TORCH]
    assert {motion.products_of(kind) for kind in motion.kinds("cpu")} == set(Products)
    assert motion.products_of(motion.BY_TORCH) == Products.HALF
    for kind, layers in ((str(Products.HALF), FusedLayers), (motion.BY_TORCH, CublasLayers)):
        settings = MotionSettings(products=motion.products_of(kind))
        made = Network(torch.arange(3.0), settings, duration=1.0, length=7.5)
        motion.set_backend(made, kind)
        assert isinstance(made.backend.layers, layers)


def test_a_timeline_is_of_the_device_in_its_order():
    """Times count from the first of what a GPU did, copies and zeros included;
    what the host did is no part of it.
    """
    kernel = {
        "cat": "kernel",
        "ts": 1_012.5,
        "dur": 3.25,
        "name": "composite",
        "args": {"stream": 7},
    }
    zeros = {
        "cat": "gpu_memset",
        "ts": 1_000.0,
        "dur": 1.0,
        "name": "Memset",
        "args": {"stream": 144},
    }
    copy = {"cat": "gpu_memcpy", "ts": 1_020.0, "dur": 0.5, "name": "Memcpy HtoD", "args": {}}
    host = {"cat": "cpu_op", "ts": 900.0, "dur": 200.0, "name": "aten::mm", "args": {}}
    lines = [line.split() for line in step.lines_of_trace([kernel, copy, host, zeros])]
    assert lines == [
        ["0.0", "1.0", "144", "Memset"],
        ["12.5", "3.2", "7", "composite"],
        ["20.0", "0.5", "-", "Memcpy", "HtoD"],
    ]
    assert step.lines_of_trace([host]) == []
