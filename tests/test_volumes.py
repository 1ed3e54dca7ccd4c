"""Runs of neural volumes at toy size: they learn, resume, move, and refuse what they cannot do."""

import gc
import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_box import as_phasors, recording, turned, with_colour
from torch.testing import assert_close
from volume_steps import Recorded, terms_of
from waits import Operations

from gftorf_warp.data.write import write
from gftorf_warp.errors import DivergedError, InputError, UsageError
from gftorf_warp.evaluate import provenance
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.export.command import export
from gftorf_warp.recon import checkpoint, folder, presets
from gftorf_warp.recon.observations import observe, reduced
from gftorf_warp.recon.record import Metrics
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.runs.volume import VolumeRun
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.recon.volume import fit
from gftorf_warp.recon.volume.choice import Inputs
from gftorf_warp.recon.volume.loop import VolumeLoop
from gftorf_warp.recon.volume.models import VOLUMES, new_volume
from gftorf_warp.recon.volume.network import Light
from gftorf_warp.recon.volume.rays import Depths
from gftorf_warp.recon.volume.settings import NetworkSettings
from gftorf_warp.recon.volume.state import begin, from_dict
from gftorf_warp.recon.volume.step import VolumeStep
from gftorf_warp.recon.volume.targets import Draw, Targets
from gftorf_warp.recon.volume.volume import NOTED
from gftorf_warp.scene.motion import Products
from gftorf_warp.view.controls import about
from gftorf_warp.view.subject import Subject

NAMES = ("torf", "ftorf", "volume")
NOWHERE = Path("neither rows nor checkpoints are written")


def toy(name, images=40, **changes):
    """Settings of a preset, with a network and rays that take milliseconds."""
    settings = presets.PRESETS[name]()
    network = replace(
        settings.volume.network,
        layers=3,
        width=24,
        skip_after=2,
        position_octaves=4,
        direction_octaves=1,
        time_values=4,
    )
    grid = settings.volume.grid
    if grid is not None:
        levels = {"levels": 4, "moving_levels": 3, "flow_levels": 2, "rows_log2": 10}
        occupancy = replace(grid.occupancy, cells=16, update_every=4, warm_up=20)
        grid = replace(grid, **levels, coarsest=4, width=16, values=8, occupancy=occupancy)
    volume = replace(settings.volume, network=network, grid=grid, samples=16, rays=48)
    volume = replace(volume, **({"accumulated": 1, "rate": 5e-3} | changes))
    schedule = replace(settings.schedule, images=images, log_every=10)
    return replace(settings, volume=volume, schedule=schedule)


def small(frames=12):
    """The box at rest, in 16x12 pixels, without noise."""
    quads = np.tile(at_rest(), (frames // 4, 1, 1))
    return reduced(replace(recording(frames=frames)[0], quads=quads), 16)


def at_rest():
    """Quads of raw frame 0 at all four shifts, [4, H, W]."""
    quads = [recording(frames=1, order=(k, k, k, k), noise=0.0)[0].quads[0] for k in range(4)]
    return np.stack(quads)


def decoded(quads):
    """Distances of quads in the order of the recording's shifts [m]."""
    phase = np.arctan2(quads[2] - quads[3], quads[0] - quads[1]) % (2 * np.pi)
    return phase * 15 / (4 * np.pi)


def d_tof_error(run, truth_distance):
    """Mean squared error of the distance decoded from rendered quads [m^2]."""
    re, im = run.render(0.02).phasor[:2]
    decoded = torch.atan2(im, re) % (2 * np.pi) / run.sensor.phase_slope
    return float(torch.mean((decoded - truth_distance).square()))


WORSE = {"torf": 5.0, "ftorf": 1.0, "volume": 10.0}
"""[1] of d over d_ToF at least; ftorf comes to 1.5 to 5 in so few steps."""
FLOWS = {"torf": 0.0, "ftorf": 1.0, "volume": 0.01}
"""[m] of the mean flow at most where nothing moves; the network of ftorf is far from its end."""


@pytest.mark.parametrize("name", NAMES)
def test_a_noisy_scene_at_rest_is_learnt(name, tmp_path):
    """Its d_ToF ends below the closed form of every quartet, since noise is averaged over time; d
    is several times worse, because quads do not say where along a ray their light is from. Nothing
    is explained by flow, which makes a noise of its own of every raw frame.
    """
    sequence, draw = small(12), np.random.default_rng(0)
    known = torch.tensor(decoded(sequence.quads[:4]))
    noise = 0.08 * np.abs(sequence.quads).max() * draw.standard_normal(sequence.quads.shape)
    sequence = replace(sequence, quads=(sequence.quads + noise).astype(np.float32))
    quartets = torch.tensor(decoded(sequence.quads.reshape(3, 4, 12, 16).swapaxes(0, 1)))
    closed_form = float((quartets - known).square().mean())
    settings = toy(name, images=100, samples=12)
    run = reconstruct(sequence, tmp_path / name, settings)
    assert isinstance(run, VolumeRun)
    d_tof = d_tof_error(run, known)
    targets = Targets(observe(sequence, settings, "cpu"))
    fresh = new_volume(settings.method, settings.volume, targets, 0, torch.device("cpu"))
    assert d_tof < 0.6 * closed_form
    assert d_tof < 0.1 * d_tof_error(replace(run, volume=fresh), known)
    assert float((run.render(0.02).distance - known).square().mean()) > WORSE[name] * d_tof
    rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    assert [row["images"] for row in rows] == list(range(10, 101, 10))
    assert rows[-1]["quad_psnr_db"] > rows[0]["quad_psnr_db"] + 5.0
    flowing = {"quads", "size", "kinetic", "round_trip", "flow"}
    expected = {"torf": {"quads"}, "ftorf": flowing, "volume": flowing | {"at_rest"}}[name]
    assert expected <= rows[-1].keys()
    flow = rows[-1].get("size", 0.0) / settings.volume.scene_flow.size
    assert flow <= FLOWS[name]


@pytest.mark.parametrize("name", NAMES)
def test_an_interrupted_run_goes_on_to_the_same_bytes(name, tmp_path):
    """Stopped by SIGTERM; weights, moments and random numbers are stored."""
    sequence = small()
    settings = toy(name, images=20)
    reconstruct(sequence, tmp_path / "whole", settings, seed=3)

    def stop(images, _, **__):
        if images == 10:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        reconstruct(sequence, tmp_path / "parts", settings, seed=3, progress=stop)
    halfway = Run.open(tmp_path / "parts")
    assert halfway.config["images_optimised"] == 10
    reconstruct(sequence, tmp_path / "parts", settings, seed=3)
    whole, parts = (
        checkpoint.last(tmp_path / folder)["volume"]["weights"] for folder in ("whole", "parts")
    )
    for key, value in whole.items():
        assert torch.equal(value, parts[key]), key
    lines = [(tmp_path / folder / "metrics.jsonl").read_text() for folder in ("whole", "parts")]
    losses = [[json.loads(row)["loss"] for row in text.splitlines()] for text in lines]
    assert losses[0] == losses[1]


def test_a_run_is_rendered_compared_and_reported(tmp_path):
    """From its folder; at any time and pose; what is assumed is in config.json and in the log."""
    write("ftorf", tmp_path / "box", *recording(frames=8))
    run = reconstruct(tmp_path / "box", tmp_path / "run", toy("ftorf", images=12))
    opened = Run.open(run.path)
    here, there = opened.render(0.03), opened.render(0.03, opened.camera.at(turned(10.0)))
    assert here.quads.shape == (4, 36, 48)
    assert here.distance.isfinite().all()
    assert (here.distance - there.distance).abs().max() > 1e-3
    assert torch.equal(opened.render(-1.0).quads, opened.render(0.0).quads)
    assert torch.equal(opened.render(9.0).quads, opened.render(8 / 120).quads)
    assert here.colour is None
    extra = opened.render(0.0, opened.camera.resized(8, 6), extra=torch.zeros(0, 2)).extra
    assert extra.shape == (2, 6, 8)
    assert "a neural volume, image 12 of 12" in about(Subject.open(run.path), 0)
    got = compare(opened)
    assert (got["method"], got["gaussians"], got["input"]) == ("ftorf", 0, "quads")
    assert got["flow_source"] == "file"
    assert got["explained"]["unexplained_share"] > 0
    config = json.loads((run.path / "config.json").read_text())
    assert config["images_optimised"] == 12
    assert config["faithful"]
    assert any("not published" in sentence for sentence in config["assumed"])
    assert config["assumed"][0] in (run.path / "run.log").read_text()
    page = (run.path / "report.html").read_text()
    assert "neural volume" in page
    assert "Gaussians start" not in page


def test_phasors_of_a_camera_change_halfway_between_two():
    """Their raw frames are of one instant, not around the middle of a quartet."""
    settings, period = toy("torf"), 4 / 120
    targets = Targets(observe(as_phasors(recording(frames=8)[0]), settings, "cpu"))
    volume = begin(settings, targets, 0, torch.device("cpu")).volume
    rays = targets.views.rays(0, torch.arange(4))
    depths = volume.depths(rays)
    times = (0.0, 0.4 * period, 0.6 * period, period)
    first, before, after, second = (volume.samples_at(t, rays, depths).alpha for t in times)
    assert not torch.equal(first, second)
    assert torch.equal(before, first)
    assert torch.equal(after, second)


@pytest.mark.parametrize("name", ["ftorf", "volume"])
def test_a_report_says_what_was_fitted_with_which_flow(name):
    """Raw frames and optical flow, of both methods that read them."""
    config = {"settings": {"method": name}, "input": "quads", "flow_source": "file"}
    assert provenance.fact(config, "input") == "quads"
    assert provenance.fact(config, "flow_source") == "file"


def test_colour_is_fitted_in_every_other_step(tmp_path):
    """With colour images, odd steps compare them; the rendering has the units of the file, and is
    exported.
    """
    sequence = with_colour(recording(frames=8)[0], size=(12, 9))
    path = write("capture", tmp_path / "seq", sequence)
    run = reconstruct(path, tmp_path / "run", toy("torf", images=60))
    rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["colour"] < 0.5 * rows[0]["colour"]
    assert rows[-1]["loss"] == pytest.approx(0.5 * (rows[-1]["colour"] + rows[-1]["quads"]))
    colour = run.render(0.0).colour
    assert colour.shape == (3, 36, 48)
    assert 5.0 < colour.mean() < 40.0  # of images between 4 and 36
    (folder,) = export(run, tmp_path / "out", "npz", times=[0.0])
    with np.load(folder / "frame_0000.npz") as stored:
        np.testing.assert_allclose(stored["colour"], colour.numpy(), rtol=1e-4)
    export(run, tmp_path / "out", "points", times=[0.0], colour="colour")


SPEED = 0.3  # [m] per quartet, along x


class Sliding(torch.nn.Module):
    """A network that knows the truth: what slides along x, as functions of x at quartet 0."""

    def __init__(self, volume, density, reflectivity, speed=SPEED):
        super().__init__()
        near, far = volume.box.bounds
        self.volume, self.scale, self.speed = volume, (far - near) / 2.0, speed
        self.functions = density, reflectivity
        self.density_head = torch.nn.Linear(1, 1)

    def trunk(self, points, codes):
        """Where a point of each row was at quartet 0."""
        quartet = (codes[:, 0] * self.volume.box.frames - 1.0) / self.volume.box.cycle
        x = (points[..., :1] / 2.0 + 0.5) * self.scale
        return x - SPEED * quartet[:, None, None]

    def density(self, trunk):
        """As given."""
        return self.functions[0](trunk[..., 0])

    def light(self, trunk, _):
        """As given, and white."""
        return Light(self.functions[1](trunk[..., 0]), torch.ones(*trunk.shape[:-1], 3))

    def flow(self, trunk, _):
        """Forward and backward, everywhere."""
        step = trunk.new_tensor([[self.speed, 0.0, 0.0], [-self.speed, 0.0, 0.0]])
        return step.expand(*trunk.shape[:-1], 2, 3)


def volume_of(sequence, settings):
    """A random volume and what it is compared with."""
    targets = Targets(observe(sequence, settings, "cpu"))
    volume = new_volume(settings.method, settings.volume, targets, 0, torch.device("cpu"))
    return volume, targets


@pytest.mark.parametrize("quartets", [0.0, 0.25, 1.0, 1.5, 1.75, 2.5, 3.0])
def test_scene_flow_moves_what_is_seen_between_quartets(quartets):
    """A slab with exact flow is where it has to be at any time, beyond the last start too."""
    volume, targets = volume_of(recording(frames=12)[0], toy("ftorf", bounds=(2.0, 4.0)))
    slab = lambda x: torch.where(x.abs() < 0.1, 100.0, -1.0)  # noqa: E731
    volume.moving = Sliding(volume, slab, torch.ones_like)
    rays = targets.views.rays(0, torch.arange(18 * 48, 19 * 48))
    z = torch.tensor([[3.0, 3.5]]).expand(48, 2)
    samples = volume.samples_at(quartets * 4 / 120, rays, Depths.between(z))
    away = (rays.at(z)[:, 0, 0] - SPEED * quartets).abs()
    seen, clear = samples.alpha[:, 0] > 0, (away - 0.1).abs() > 1e-4
    assert seen.any()
    assert torch.equal(seen[clear], away[clear] < 0.1)


@pytest.mark.parametrize(("speed", "low", "high"), [(SPEED, 0.0, 1e-6), (0.0, 1e-4, 1.0)])
def test_raw_frames_agree_with_the_true_flow_only(speed, low, high):
    """A wall whose pattern slides: with exact light and flow every raw frame around a quartet is
    explained, without flow none but the first.
    """
    sequence = recording(frames=12)[0]

    def pattern(x):
        return 0.6 + 0.25 * torch.sin(9.0 * x)

    settings = toy("ftorf", bounds=(2.9999, 3.0001), density_noise=0.0, falloff=2.0)
    settings = replace(settings, quad_scale=1.0)
    volume, targets = volume_of(sequence, settings)
    rays = targets.views.rays(0)
    x, distance = 3.0 * rays.direction[:, 0], 3.0 * rays.length
    n = torch.arange(12)[:, None]
    shifts = torch.tensor(sequence.shifts)[:, None]
    phase = 4.0 * np.pi / 15.0 * distance - shifts
    targets.quads = (pattern(x - SPEED * n / 4) / distance**2 * torch.cos(phase)).float()
    volume.moving = Sliding(volume, lambda x: torch.full_like(x, 1e9), pattern, speed)
    terms = terms_of(volume, targets, 30, settings, Draw(0, torch.device("cpu")))
    assert terms.keys() == {"quads", "size", "kinetic", "round_trip", "flow", *NOTED}
    assert low <= terms["quad_mse"] < high
    assert terms["kinetic"] == terms["round_trip"] == 0.0
    assert terms["size"].item() == pytest.approx(1e-3 * speed / 3.0, rel=1e-5)
    first = terms_of(volume, targets, 1, settings, Draw(0, torch.device("cpu")))
    assert first.keys() == {"quads", *NOTED}, "the first steps know no flow"


def test_optical_flow_pulls_on_the_scene_flow():
    """Its term is the distance to the measured flow in pixels: f v / z at an opaque wall."""
    sequence = recording(frames=12)[0]
    settings = toy("ftorf", bounds=(2.9999, 3.0001), density_noise=0.0)
    volume, targets = volume_of(sequence, settings)
    pixels = sequence.intrinsics.fx * SPEED / 3.0
    forward = torch.tensor([[pixels, 0.0], [-pixels, 0.0]])[..., None]
    volume.moving = Sliding(volume, lambda x: torch.full_like(x, 1e9), torch.ones_like)
    for error in (0.0, 1.5):
        targets.flow = (forward + error).expand(len(targets.flow), 2, 2, targets.views.pixels)
        terms = terms_of(volume, targets, 30, settings, Draw(0, torch.device("cpu")))
        assert terms["flow"].item() == pytest.approx(0.01 * error, abs=1e-5)


def test_rates_and_weights_change_as_published(tmp_path):
    """A tenth of the rate after so many steps; a tenth of the weight of phasors."""
    sequence = small()
    settings = toy("torf", images=8, rate_tenth_after=4, quads_fall_at=6)
    targets = Targets(observe(sequence, settings, "cpu"))
    state = begin(settings, targets, 0, torch.device("cpu"))
    loop = loop_of(state, targets, settings, tmp_path)
    for _ in range(4):
        loop.step()
    assert state.optimiser.param_groups[0]["lr"] == pytest.approx(0.1 * settings.volume.rate)
    for step, weight in ((0, 8.0), (5, 8.0), (6, 0.8)):
        terms = terms_of(state.volume, targets, step, settings, state.draw)
        assert terms["quads"].item() == pytest.approx(weight * terms["quad_mse"].item())


def test_accumulated_steps_make_one_update(tmp_path):
    """Parameters change after the last of them only."""
    sequence = small()
    settings = toy("ftorf", images=8)
    settings = replace(settings, volume=replace(settings.volume, accumulated=3))
    targets = Targets(observe(sequence, settings, "cpu"))
    state = begin(settings, targets, 0, torch.device("cpu"))
    loop = loop_of(state, targets, settings, tmp_path)
    before = state.volume.moving.density_head.weight.clone()
    changed = []
    for _ in range(4):
        loop.step()
        changed.append(not torch.equal(before, state.volume.moving.density_head.weight))
    assert changed == [False, False, True, True]


def test_a_volume_that_diverged_is_not_stored(tmp_path):
    """A checkpoint that is due before the next row of metrics is not written: the one before stays
    the last.
    """
    settings = toy("ftorf", images=10, rate=1e38, rays=8)
    targets = targets_of(settings)
    state = begin(settings, targets, 0, torch.device("cpu"))
    with pytest.raises(DivergedError, match="not finite"):
        loop_of(state, targets, settings, tmp_path).run()
    stored = checkpoint.last(tmp_path)
    assert stored["images"] == 0
    assert all(bool(value.isfinite().all()) for value in stored["volume"]["weights"].values())


def emptied(monkeypatch, starts, density):
    """Makes the first so many starts volumes whose densities are all about the same [1/m]."""
    made = []

    def begun(*args):
        state = begin(*args)
        made.append(args[2])
        if len(made) <= starts:
            with torch.no_grad():
                state.volume.moving.density_head.weight.zero_()
                state.volume.moving.density_head.bias.fill_(density)
        return state

    monkeypatch.setattr(fit, "begin", begun)
    return made


@pytest.mark.parametrize("density", [-4.0, -1e3])
def test_an_empty_volume_begins_again_with_another_seed(monkeypatch, tmp_path, caplog, density):
    """Where hardly any ray meets anything hardly anything has a gradient, so more steps would be in
    vain; the noise on densities, of 1/m, lets a few samples be seen.
    """
    seeds = emptied(monkeypatch, starts=2, density=density)
    run = reconstruct(small(), tmp_path / "run", toy("ftorf", images=60))
    assert len(seeds) == len({*seeds}) == 3
    assert caplog.text.count("hardly any ray meets anything") == 2
    assert run.config["restarts"] == 2
    rows = Metrics(tmp_path / "run" / "metrics.jsonl").rows()
    assert [row["images"] for row in rows] == [10, 20, 30, 40, 50, 60]
    assert all(row["opacity"] > 0.5 for row in rows)


def test_a_volume_that_stays_empty_is_an_error(monkeypatch, tmp_path):
    """It is not a result: the first start and every other one were empty."""
    seeds = emptied(monkeypatch, starts=99, density=-1e3)
    with pytest.raises(DivergedError, match="the volume is empty"):
        reconstruct(small(), tmp_path / "run", toy("ftorf", images=60))
    assert len(seeds) == 1 + presets.PRESETS["ftorf"]().restarts_max


def unfit(kind):
    """A recording that a volume cannot be fitted to."""
    sequence, _ = recording(frames=8)
    if kind == "phasors":
        return as_phasors(sequence)
    if kind == "moving camera":
        return replace(sequence, camera_from_world=np.stack([turned(n) for n in range(8)]))
    measured = sequence.measured.copy()
    measured[[1, 6]] = False
    return replace(sequence, measured=measured)


@pytest.mark.parametrize(
    ("name", "kind", "what"),
    [
        ("ftorf", "phasors", "no raw frames"),
        ("volume", "phasors", "no raw frames"),
        ("ftorf", "moving camera", "the camera moves"),
        ("volume", "moving camera", "the camera moves"),
        ("torf", "incomplete", "no complete quartet"),
    ],
)
def test_what_cannot_be_fitted_is_refused(tmp_path, name, kind, what):
    """By name and with a way out, before any work."""
    sequence = unfit(kind)
    with pytest.raises(InputError, match=what) as error:
        reconstruct(sequence, tmp_path / "run", toy(name))
    assert error.value.fix
    assert not (tmp_path / "run" / "config.json").exists()


def test_presets_have_the_published_shape():
    """8 layers of 256: 0.6 million parameters, with the flow and blend that all networks have."""
    settings = presets.ftorf().volume
    assert settings.network == NetworkSettings()
    assert {kind.method.value for kind in VOLUMES.values()} == set(NAMES)
    assert presets.torf().volume.network.static
    assert not presets.ftorf().volume.network.static


def test_a_volume_is_not_edited(tmp_path):
    """There are no Gaussians to edit or to store."""
    run = reconstruct(small(), tmp_path / "run", toy("ftorf", images=2))
    with pytest.raises(UsageError, match="no Gaussians"):
        run.save(tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize("name", NAMES)
def test_contradictions_are_refused(tmp_path, name):
    """Another input, an ablation, no weight of quads, what corrects or repeats Gaussians."""
    sequence, other = recording(frames=8)[0], "quads" if name == "torf" else "phasor"
    for given, what in (
        ({"input": other}, "another input"),
        ({"changes": [f"input={other}"]}, "another input"),
        ({"ablation": "h1"}, "no ablations"),
        ({"changes": ["weights.quads=0"]}, "weights.quads"),
        ({"changes": ["volume.samples=1"]}, "volume.samples"),
        ({"changes": ["fallback=True"]}, "fallback"),
        ({"changes": ["outlines=True"]}, "outlines"),
        ({"changes": ["attempts_max=2"]}, "attempts_max"),
        ({"settings": "ctof", "changes": ["restarts_max=0"]}, "restarts_max"),
        ({"changes": ["failures_max=2"]}, "failures_max"),
        ({"changes": ["rollbacks_max=2"]}, "rollbacks_max"),
        ({"settings": "ftorf", "changes": ["weights.colour=1"]}, "weights.colour"),
        ({"changes": [f"volume.network.static={name != 'torf'}"]}, "volume.network.static"),
    ):
        with pytest.raises(UsageError, match=what):
            reconstruct(sequence, tmp_path / "run", **({"settings": name, "images": 1} | given))
    assert not (tmp_path / "run").exists()


def test_a_damaged_run_is_named(tmp_path):
    """Settings that are none, networks of another shape, parameters that are not finite."""
    run = reconstruct(small(), tmp_path / "run", toy("ftorf", images=2))
    text = json.dumps(folder.read_config(run.path), indent=2)  # without its sum

    def opened(old, new, what):
        assert old in text
        (run.path / "config.json").write_text(text.replace(old, new))
        with pytest.raises(InputError, match=what):
            Run.open(run.path)

    opened('"time_code": "positional"', '"time_code": "none"', "not the config of a run")
    opened('"samples": 16', '"samples": 1', "not the config of a run")
    opened('"width": 24,\n        "skip', '"width": 25,\n        "skip', "does not fit")
    opened('"method": "ftorf"', '"method": "torf"', "does not fit")
    (run.path / "config.json").write_text(text)
    stored = checkpoint.last(run.path)
    stored["volume"]["weights"]["moving.density_head.bias"][0] = float("nan")
    checkpoint.save(run.path, stored)
    with pytest.raises(InputError, match="not finite"):
        Run.open(run.path)


@pytest.mark.parametrize("name", NAMES)
def test_half_precision_is_near_single(name, tmp_path):
    """The loss of one step, and what it changes, within the rounding of float16."""
    found = {}
    for products in Products:
        settings = toy(name, products=products)
        targets = Targets(observe(small(), settings, "cpu"))
        state = begin(settings, targets, 0, torch.device("cpu"))
        state.images = 30
        head = "field.trunk_head.weight" if name == "volume" else "moving.density_head.weight"
        watched = state.volume.get_parameter(head)
        before = watched.detach().clone()
        loop_of(state, targets, settings, tmp_path).step()
        moved = watched.detach() - before
        found[products] = float(state.sums["loss"]), moved
    (loss, moved), (half_loss, half_moved) = found.values()
    assert moved.abs().max() > 1e-3
    assert half_loss == pytest.approx(loss, rel=5e-3)
    assert (torch.sign(moved) == torch.sign(half_moved)).float().mean() > 0.9


@pytest.mark.parametrize("name", NAMES)
def test_no_step_uploads_anything(name):
    """Numbers of the host are on the device before the second step that needs them."""
    settings = toy(name)
    state = begin(settings, targets := targets_of(settings), 0, torch.device("cpu"))
    for step in (0, 35):
        choice = state.volume.choice(targets, step, settings, state.draw)
        inputs = Inputs(choice.numbers, torch.device("cpu"))
        inputs.send(choice.numbers)
        given = targets, choice.key, inputs.given, settings, state.draw
        state.volume.terms(*given)
        with Operations() as operations:
            state.volume.terms(*given)
        assert operations.found["mul"] > 0
        uploads = {"lift_fresh", "arange", "_to_copy"}
        if name == "volume":  # numbers of cells are cast on the device
            uploads.remove("_to_copy")
        assert not operations.found.keys() & uploads


def stepped(name, products, replayed, steps=30, device="cpu", **changes):
    """A state after some steps of both kinds, and its loop."""
    rays = 24 if device == "cpu" else 48  # there half precision is slow
    settings = toy(name, images=steps, accumulated=2, products=products, rays=rays)
    flowing = replace(settings.volume.scene_flow, simultaneous_share=0.3)
    settings = replace(settings, volume=replace(settings.volume, scene_flow=flowing), **changes)
    sequence = reduced(with_colour(recording(frames=16)[0], size=(12, 9)), 16)
    targets = Targets(observe(sequence, settings, device))
    state = begin(settings, targets, 0, torch.device(device))
    step = VolumeStep(state, targets, settings, replayed=replayed)
    loop = VolumeLoop(step, NOWHERE, Metrics(NOWHERE), lambda: 0.0, None)
    for _ in range(steps):
        loop.step()
    return state


@pytest.mark.parametrize("products", Products)
@pytest.mark.parametrize("name", NAMES)
def test_what_a_graph_replays_is_a_step(name, products, monkeypatch):
    """Operations and memory of the second step of a key, repeated, are those of any later one; in
    place of a CUDA graph a recording that runs on a CPU.
    """
    recordings = []

    def recorded():
        recordings.append(Recorded(monkeypatch))
        return recordings[-1]

    eager, graph = (stepped(name, products, each) for each in (None, recorded))
    assert sum(one.replays for one in recordings) >= 12
    assert len(recordings) >= 2
    before = eager.sums["loss"].item()
    assert before > 0.0
    assert eager.counts == graph.counts
    for key, value in eager.sums.items():
        assert torch.equal(value, graph.sums[key]), key
    for key, value in eager.volume.state_dict().items():
        assert torch.equal(value, graph.volume.state_dict()[key]), key


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("products", Products)
@pytest.mark.parametrize("name", NAMES)
def test_a_cuda_graph_is_the_eager_step(name, products):
    """The same random numbers; sums and parameters as far as atomic sums allow."""
    eager, graph = (
        stepped(name, products, None, steps=20, device="cuda", graph=graph)
        for graph in (False, True)
    )
    drawn = [state.draw.pixels(64, 1 << 20) for state in (eager, graph)]
    assert torch.equal(*drawn), "a graph goes on with the random numbers of the step before"
    assert eager.counts == graph.counts
    for key, value in eager.sums.items():
        assert_close(value, graph.sums[key], rtol=2e-3, atol=1e-5, msg=key)
    for key, value in eager.volume.named_parameters():
        apart = (value - graph.volume.get_parameter(key)).abs().mean()
        assert apart <= 0.05 * eager.optimiser.defaults["lr"], key


def test_no_autograd_graph_outlives_a_step():
    """A node that adds up gradients and is kept from an eager step would bring its stream into the
    capture of another one, which fails.
    """

    def results():
        gc.collect()
        tensors = [one for one in gc.get_objects() if issubclass(type(one), torch.Tensor)]
        return {id(one) for one in tensors if one.grad_fn is not None}

    before = results()
    state = stepped("ftorf", Products.HALF, None, steps=12)
    assert state.images == 12
    assert not results() - before


def test_a_checkpoint_of_a_gpu_goes_on_elsewhere(tmp_path):
    """A GPU's generator has 16 bytes of state; its numbers go on as others, the same every time."""
    settings = toy("ftorf")
    state = begin(settings, targets_of(settings), 0, torch.device("cpu"))
    stored = state.to_dict()
    stored["draw"]["device"] = torch.zeros(16, dtype=torch.uint8)
    drawn = [
        from_dict(tmp_path, settings, stored, torch.device("cpu")).draw.pixels(64, 1000)
        for _ in range(2)
    ]
    assert torch.equal(*drawn)
    assert not torch.equal(drawn[0], state.draw.pixels(64, 1000))


def test_a_checkpoint_without_moments_is_named(tmp_path):
    """A run that cannot go on is an error of the user's files, no traceback."""
    run = reconstruct(small(), tmp_path / "run", toy("ftorf", images=2))
    stored = checkpoint.last(run.path)
    stored["adam"]["param_groups"] = []
    checkpoint.save(run.path, stored)
    with pytest.raises(InputError, match="parts of the checkpoint do not fit"):
        reconstruct(small(), tmp_path / "run", toy("ftorf", images=4))


def test_pixels_without_light_have_no_bounds():
    """Nothing is decoded there: a sample at distance 0 would be infinitely bright."""
    sequence, settings = small(), toy("torf")
    dark = sequence.quads.copy()
    dark[:, :, :3] = 0.0
    found = Targets(observe(replace(sequence, quads=dark), settings, "cpu")).bounds()
    assert found == pytest.approx(targets_of(settings).bounds(), rel=0.2)


def targets_of(settings):
    """What a volume of the small recording is compared with."""
    return Targets(observe(small(), settings, "cpu"))


def loop_of(state, targets, settings, folder):
    """Training of a state that writes no rows."""
    step = VolumeStep(state, targets, settings)
    return VolumeLoop(step, folder, Metrics(folder / "rows"), lambda: 0.0, None)
