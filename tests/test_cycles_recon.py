"""From the simulator to the report with cycles that are not four shifts at one frequency:
closed form and Gaussians.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import OneStep

from gftorf_warp import Sequence, cli
from gftorf_warp.constants import SPEED_OF_LIGHT
from gftorf_warp.data.decode import decode_quartet, unambiguous_range
from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.optimiser import betas_of
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Batch, BatchRule, Weights
from gftorf_warp.recon.state import begin
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.render.reference import rasterize as oracle
from gftorf_warp.scene.initialise import Init, from_phase
from gftorf_warp.scene.measured import sensor_of
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sim.simulate import simulate

SIZE = (48, 36)
SENSORS = {
    "three shifts": {"shifts": (0.0, 2.1, 4.2)},
    "eight shifts": {"shifts": tuple(math.tau * k / 8 for k in (3, 0, 5, 1, 7, 2, 4, 6))},
    "two frequencies": {"shifts": (0.0, 2.1, 4.2), "f_mod_hz": 60e6, "further_hz": (40e6,)},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The demo scene, 2 to 4 m away, without noise, once with each sensor:
    three cycles and one raw frame.
    """
    root = tmp_path_factory.mktemp("cycles")
    for name, changes in SENSORS.items():
        sensor = replace(SCENES["demo"].sensor, **changes)
        scene = replace(SCENES["demo"], sensor=sensor, closed_form=None)
        frames = 3 * len(sensor.cycle) + 1
        simulate(
            scene, root / name, frames=frames, size=SIZE, noise=False, flow=True, format="capture"
        )
    return root


@pytest.mark.parametrize("name", SENSORS)
def test_what_was_simulated_is_read_and_decoded(folders, name):
    """The cycle is stated, flow spans it, and static pixels decode to their true distance."""
    sequence = Sequence.open(folders / name)
    truth, sensor = sequence.truth(), replace(SCENES["demo"].sensor, **SENSORS[name])
    assert sequence.cycle == sequence.calibration.cycle_length == len(sensor.cycle)
    assert sorted(sequence.flow.forward) == [0, sequence.cycle, 2 * sequence.cycle]
    decoded = decode_quartet(sequence, 1).distance
    frames = sequence.quartet_frames(1)
    still = np.ptp(truth.distance[frames], axis=0) < 1e-3
    assert still.mean() > 0.5
    error = np.abs(decoded - truth.distance[frames.start])[still]
    assert np.median(error) < 0.01
    assert decoded.max() > 3.0
    assert (folders / name / "contact_sheet.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", SENSORS)
def test_the_command_line_decodes_and_compares(folders, name, tmp_path, capsys):
    """Reconstruct with preset ctof, compare, check, render;
    the page shows both frequencies and the range.
    """
    run, sequence = tmp_path / "run", folders / name
    assert cli.main(["reconstruct", str(sequence), "--preset", "ctof", "--out", str(run)]) == 0
    assert cli.main(["compare", str(run)]) == 0
    printed = capsys.readouterr().out
    metrics, page = (
        json.loads((run / "metrics.json").read_text()),
        (run / "report.html").read_text(),
    )
    for row in (metrics, metrics["moving"], metrics["static"]):
        for key in ("d_mse_x100", "d_tof_mse_x100"):
            assert row[key] == pytest.approx(row["closed_form_mse_x100"], rel=1e-3)
    assert 3 * metrics["static"]["closed_form_mse_x100"] < metrics["moving"]["closed_form_mse_x100"]
    cycle = Sequence.open(sequence).cycle
    assert metrics["frames"] == 3 * cycle
    several = name == "two frequencies"
    assert ("60 MHz alone" in page) == ("confidence of the turn" in page) == several
    assert ("unambiguous to 7.495 m" in printed) == several
    assert metrics["unambiguous_range_m"] == pytest.approx(SPEED_OF_LIGHT / 4e7 if several else 7.5)
    assert (metrics["ambiguous_share"] is not None) == several
    assert cli.main(["check", str(sequence)]) == 0
    assert f"cycle           {cycle} raw frames" in capsys.readouterr().out
    assert cli.main(["render", str(run), "--out", str(tmp_path / "images"), "--times", "0.01"]) == 0
    if several:
        with pytest.raises(InputError, match="static-phasor distance of one frequency"):
            compare(run, against="static-phasor")


def observed(folder, **changes):
    """The demo preset's settings, observations and first state."""
    settings = replace(presets.demo(), flow="file", **changes)
    seen = observe(Sequence.open(folder), settings, "cpu")
    return settings, seen, begin(seen, settings, seed=0, device="cpu")


@pytest.mark.parametrize("name", SENSORS)
def test_every_raw_frame_is_rendered_with_its_own_shift_and_frequency(folders, name):
    """Loss and gradient of single raw frames against the oracle of the same light, in float64."""
    settings, seen, state = observed(folders / name)
    settings = replace(settings, weights=Weights(ssim=0.0), background=0.0)
    settings = replace(settings, schedule=replace(settings.schedule, warm_up=100))
    field = state.optimiser.field
    stated = SENSORS[name]
    frequencies = (
        stated.get("f_mod_hz", SCENES["demo"].sensor.f_mod_hz),
        *stated.get("further_hz", ()),
    )
    losses = []
    for frame in range(seen.sequence.cycle):
        set_, slot = divmod(frame, len(stated["shifts"]))
        sensor = seen.sensor_at(frame)
        assert (sensor.shifts, sensor.f_mod_hz) == ((stated["shifts"][slot],), frequencies[set_])
        found = OneStep(state, seen, settings, frame)
        mean = field.mean.detach().double().requires_grad_()
        exact = replace(
            field.map(
                lambda value: value.detach().double() if value.is_floating_point() else value
            ),
            mean=mean,
        )
        seen_by = replace(
            sensor, f_mod_hz=frequencies[set_], shifts=(stated["shifts"][slot],), further_hz=()
        )
        rendered = oracle(exact, seen.cameras[frame], seen_by, settings.render).quads
        want = (rendered - seen.quads[frame][None].double()).square().mean()
        assert found.terms["quads"] == pytest.approx(want.item(), rel=1e-3)
        got = found.gradients["mean"]
        (grad,) = torch.autograd.grad(want, mean)
        assert grad.abs().max() > 1e-8, "a vanished gradient would pass any tolerance"
        torch.testing.assert_close(
            got.double(), grad, rtol=2e-2, atol=2e-3 * float(grad.abs().max())
        )
        losses.append(want.item())
    assert len(set(losses)) == len(losses)


@pytest.mark.parametrize("name", SENSORS)
def test_the_start_is_at_the_unwrapped_distance(folders, name):
    """Gaussians of the static layer lie on what the truth has there,
    beyond the range of one frequency too.
    """
    sequence = Sequence.open(folders / name)
    truth = sequence.truth()
    start = from_phase(sequence, presets.demo().init)
    distance = start.field.mean.norm(dim=1)[start.field.layer == 0].numpy()
    far = truth.distance.max(axis=0)
    assert np.median(distance) == pytest.approx(np.median(far), abs=0.1)
    alone = sensor_of(sequence).unambiguous_range
    if name == "two frequencies":
        assert (distance > alone).mean() > 0.5
    assert np.isin(np.unique(start.field.layer.numpy()), (0, 1)).all()


@pytest.mark.parametrize("name", SENSORS)
def test_gaussians_are_fitted_to_it(folders, name, tmp_path):
    """A short run of the demo preset: fits better than it began,
    and what moves better than the closed form.
    """
    run = reconstruct(
        folders / name, tmp_path / "run", "demo", images=160, changes=["schedule.log_every=20"]
    )
    rows = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["quad_psnr_db"] > rows[0]["quad_psnr_db"] + 1.0
    looked = [
        json.loads(line) for line in (run.path / "diagnostics.jsonl").read_text().splitlines()
    ]
    assert looked[-1]["d_minus_dtof_static_m"] < 0.1
    metrics = compare(run, report=False)
    assert metrics["moving"]["d_mse_x100"] < 0.7 * metrics["moving"]["closed_form_mse_x100"]
    assert metrics["static"]["d_mse_x100"] < 3.0
    again = Run.open(run.path)
    assert again.sensor.further_hz == SENSORS[name].get("further_hz", ())
    assert (
        json.loads((run.path / "config.json").read_text())["settings"]["cycle"]
        == run.sequence().cycle
    )


def test_a_batch_is_a_cycle_and_rates_know(folders):
    """The raw frames of one cycle pull at once; Adam forgets as much per image as in a batch of
    four.
    """
    _, seen, _ = observed(folders / "eight shifts")
    assert [len(batch) for batch in seen.batches] == [8, 8, 8, 1]
    released = presets.preset("released")
    joint = replace(
        released,
        schedule=replace(released.schedule, batch=Batch.QUARTET, batch_rule=BatchRule.ROOT),
    )
    assert betas_of(replace(joint, cycle=8))[0] == pytest.approx(betas_of(joint)[0] ** 2)


def test_phasors_of_each_frequency_are_compared(folders, tmp_path):
    """One image per cycle and frequency, at the mean time of its raw frames; it runs."""
    settings = replace(presets.demo(), input="phasor", flow="none")
    seen = observe(Sequence.open(folders / "two frequencies"), settings, "cpu")
    assert sorted(seen.phasors.rows) == [0, 3, 6, 9, 12, 15]
    assert [seen.time_at(n) * 120 for n in (0, 3, 6)] == pytest.approx([1.0, 4.0, 7.0])
    assert [seen.sensor_at(n).f_mod_hz for n in (0, 3)] == [60e6, 40e6]
    run = reconstruct(
        folders / "two frequencies", tmp_path / "run", "demo", images=60, input="phasor"
    )
    assert np.isfinite(compare(run, report=False)["d_mse_x100"])


def test_random_gaussians_fill_the_range_of_all_frequencies(folders):
    """Bounds of the published presets follow what distances are known modulo, not one frequency."""
    sequence = Sequence.open(folders / "two frequencies")
    recorded = presets.Recorded(unambiguous_range=unambiguous_range(sequence))
    paper = presets.preset("paper", recorded)
    assert paper.init.kind == Init.RANDOM
    assert paper.init.bounds[1] > 2.9 * sensor_of(sequence).unambiguous_range


def test_frequencies_without_a_common_range_stop_by_name(folders, tmp_path):
    """Before anything is written."""
    sequence = Sequence.open(folders / "two frequencies")
    odd = np.where(sequence.frequencies_hz == 40e6, 60e6 / math.sqrt(2), 60e6)
    folder = write("capture", tmp_path / "odd", replace(sequence, frequencies_hz=odd, path=None))
    for preset in ("demo", "ctof"):
        with pytest.raises(InputError, match="frequencies without a common range"):
            reconstruct(folder, tmp_path / "run", preset, images=4)
    assert not (tmp_path / "run").exists()
