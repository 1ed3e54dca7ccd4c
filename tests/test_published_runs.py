"""The published presets from end to end, small: they run on every device, learn, stop, go on,
and say what they did.
"""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_box import recording
from small_runs import advance, rows, same, stored
from test_inputs import as_phasors, with_colour

from gftorf_warp.data.write import write
from gftorf_warp.errors import InputError
from gftorf_warp.evaluate.compare import compare
from gftorf_warp.recon import presets
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.presets import Recorded
from gftorf_warp.recon.run import Run
from gftorf_warp.recon.settings import Input
from gftorf_warp.recon.state import begin, from_dict, to_dict
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.initialise import Init
from gftorf_warp.scene.motion import Products

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    ),
]


def small(name, images, **recorded):
    """A preset with few Gaussians, a narrow network, larger steps, and its course in few images."""
    s = presets.preset(name, Recorded(**recorded))
    warm_up = images // 4
    motion = replace(s.motion, layers=3, width=32, skip_after=2)
    init = replace(s.init, count=400, opacity=0.3, reflectivity=0.4, bounds=(1.5, 5.0))
    rates = replace(s.rates, mean=5e-3, reflectivity_sh=2e-3, log_scale=1e-2)
    schedule = replace(
        s.schedule,
        images=images,
        log_every=10,
        warm_up=warm_up,
        flow_from=warm_up,
        pause_after_reset=2,
    )
    colour_from = warm_up if s.weights.quads > 0 else 0
    densify = replace(
        s.densify,
        every=20,
        start=20,
        reset_every=max(images // 3, 1),
        reset_faster=None,
        gaussians_max=600,
    )
    densify = replace(densify, scale_range=(0.0, 10.0), clone_scale_max=0.1)
    schedule = replace(schedule, colour_from=colour_from, motion_decay_from=0, sh_degree_every=10)
    last = replace(s.rates_last, reflectivity_sh=2e-3)
    return replace(
        s,
        init=init,
        motion=motion,
        rates=rates,
        rates_last=last,
        densify=densify,
        schedule=schedule,
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["paper", "released"])
def test_quads(tmp_path, name, device):
    """Warm-up, densification, resets, flow, freeze: all of it happens, and the error falls."""
    settings = small(name, 180)
    run = reconstruct(recording(frames=12)[0], tmp_path / "run", settings, device=device)
    found = rows(run.path)
    assert found[-1]["quads"] < 0.8 * found[0]["quads"]
    assert any("flow" in row for row in found[1:])
    assert "flow" not in found[0], "not in the warm-up"
    assert len({row["gaussians"] for row in found}) > 2, "densified and pruned"
    assert (run.config["motion"], run.config["init"], run.config["input"]) == (
        "network",
        "random",
        "quads",
    )
    assert run.render(0.03).distance.isfinite().all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["paper", "released", "dgs_depth"])
def test_phasors_with_colour(tmp_path, name, device):
    """From the camera's own phasors, colour joins after the warm-up."""
    sequence = with_colour(as_phasors(recording(frames=12)[0]))
    settings = small(name, 160, input=Input.PHASOR)
    run = reconstruct(sequence, tmp_path / "run", settings, device=device)
    found = rows(run.path)
    term = "depth" if name == "dgs_depth" else "quads"
    assert found[-1][term] < 0.8 * found[0][term]
    assert any("colour" in row for row in found)
    assert run.field.colour_sh is not None
    seen = run.render(0.03)
    assert seen.colour.isfinite().all()
    assert float(seen.colour.max()) > 3.0, (
        "in the units of the recording, whose brightest value is 36"
    )
    if name != "dgs_depth":
        assert run.config["input"] == "phasor"
        assert "colour" not in found[0]


@pytest.mark.parametrize("products", [Products.FLOAT32, Products.HALF])
def test_a_run_with_a_network_stops_and_goes_on_to_the_same_bytes(tmp_path, products):
    """Across a densification and a reset; scored in between, it says how far it was."""
    path = write("ftorf", tmp_path / "seq", *recording(frames=12))
    settings = small("released", 48)
    settings = replace(settings, schedule=replace(settings.schedule, checkpoint_every_s=0.0))
    settings = replace(settings, motion=replace(settings.motion, products=products))
    whole = reconstruct(path, tmp_path / "whole", settings)

    def stop(images, *_, **__):
        if images >= 24:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(path, tmp_path / "run", settings, progress=stop)
    half = compare(Run.open(tmp_path / "run"), report=False)
    assert 20 <= half["images_optimised"] < 31
    assert half["seconds_reconstruct"] > 0
    again = reconstruct(path, tmp_path / "run", settings)
    assert same(stored(again.path), stored(whole.path))
    assert rows(again.path) == rows(whole.path)
    assert (again.path / "diagnostics.jsonl").read_text() == (
        whole.path / "diagnostics.jsonl"
    ).read_text()


def test_a_step_beyond_the_range_of_halves_changes_nothing():
    """And the next one, within it, does."""
    settings = small("released", 80)
    settings = replace(settings, motion=replace(settings.motion, products=Products.HALF))
    settings = replace(settings, schedule=replace(settings.schedule, warm_up=0))
    observations = observe(recording(frames=12)[0], settings, "cpu")
    state = begin(observations, settings, seed=0, device="cpu")
    weights = [layer.weight for layer in state.motion.layers]

    def scaled(factor):
        with torch.no_grad():
            weights[0] *= factor
            weights[1] /= factor
        return [leaf.detach().clone() for leaf in state.optimiser.leaves]

    before = scaled(2.0**20)
    assert advance(state, observations, settings) == 1
    assert all(map(torch.equal, before, state.optimiser.leaves))
    scaled(2.0**-20)
    before = [weight.detach().clone() for weight in weights]
    for _ in range(2):
        assert advance(state, observations, settings) == 0
    assert not any(map(torch.equal, before, weights))


def test_a_run_that_could_not_start_can_be_started_again(tmp_path):
    """Its folder holds a log and nothing else."""
    sequence = recording(frames=12)[0]
    with pytest.raises(InputError, match="no colour"):
        reconstruct(sequence, tmp_path / "run", small("dgs", 8))
    settings = small("paper", 4)
    assert settings.init.kind == Init.RANDOM
    assert reconstruct(sequence, tmp_path / "run", settings).config["images"] == 4


def test_a_constant_part_that_calibration_denies_is_warned_of(tmp_path, caplog):
    """Unipolar quads fitted without their DC."""
    sequence = recording(frames=12)[0]
    reconstruct(sequence, tmp_path / "right", small("paper", 2))
    assert "constant part" not in caplog.text
    shifted = sequence.quads + np.abs(sequence.quads).max()
    reconstruct(replace(sequence, quads=shifted), tmp_path / "wrong", small("paper", 2))
    assert "constant part" in caplog.text
    caplog.clear()
    phasors = replace(small("paper", 2), input=Input.PHASOR)
    reconstruct(replace(sequence, quads=shifted), tmp_path / "phasors", phasors)
    assert "constant part" not in caplog.text


def test_too_short_a_run_is_warned_of(tmp_path, caplog):
    """Nothing moves before the warm-up is over."""
    settings = small("paper", 60)
    run = replace(settings, schedule=replace(settings.schedule, images=1, warm_up=2))
    reconstruct(recording(frames=12)[0], tmp_path / "run", run)
    assert "nothing will move" in caplog.text


def test_an_earlier_run_continues_with_its_seed_of_backgrounds():
    """Formats 1 and 2 stored a generator, whose state has another length on a GPU;
    both hold the seed.
    """
    settings = small("paper", 8)
    observations = observe(recording(frames=12)[0], settings, "cpu")
    kept = to_dict(begin(observations, settings, seed=0, device="cpu"))
    kept.pop("noise_seed")
    on_cpu = torch.Generator().manual_seed(77).get_state()
    on_gpu = torch.tensor(
        [*(77).to_bytes(8, "little"), *(12).to_bytes(8, "little")], dtype=torch.uint8
    )
    for noise in (on_cpu, on_gpu):
        state = from_dict(copy.deepcopy(kept | {"noise": noise}), "cpu")
        assert state.noise_seed == 77
        assert advance(state, observations, settings) == 0
