"""Nothing is left by a round of work: no memory that only the garbage collector finds, and no
growth that benchmarks/soak.py would not see.
"""

import gc
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gftorf_warp import compare, reconstruct, simulate
from gftorf_warp.recon.stepper import Stepper

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import soak


def test_a_finished_run_leaves_no_tensors_to_the_garbage_collector(tmp_path):
    """Nor the stepper, which holds the padded parameters and all images of a run."""
    sequence = simulate("demo", tmp_path / "seq", size=(32, 24), frames=8)
    compare(reconstruct(sequence, tmp_path / "first", "demo", images=16))  # fills caches
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        compare(reconstruct(sequence, tmp_path / "run", "demo", images=16))
        gc.collect()
        left = [type(thing).__name__ for thing in gc.garbage if isinstance(thing, KEPT)]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert left == []


KEPT = (torch.Tensor, Stepper)


def states(count=20, **values):
    """States of so many rounds, constant but for functions of the round."""
    usual = dict.fromkeys([*soak.MEMORY, *soak.NUMBERS], lambda _: 100)
    made = []
    for n in range(count):
        found = {name: value(n) for name, value in (usual | values).items()}
        made.append(soak.State(round=n + 1, hours=n / 10, **found))
    return made


def test_slope_of_a_line_with_noise():
    """The textbook's formulas, by hand: residuals -0.2, 0.6, -0.6, 0.2."""
    steep, error = soak.slope([0, 1, 2, 3], [1, 3, 3, 5])
    assert steep == pytest.approx(1.2)
    assert error == pytest.approx((0.8 / 2 / 5) ** 0.5)


def test_growth_is_found_and_noise_is_not():
    """Memory by its slope, numbers by the last tenth of the rounds."""

    def noise(n):
        return 100 + 3 * (n % 3)

    def hops(n):
        return 100 + 3 * (n > 9 and n % 9 > 0)  # up in round 10, down for round 18

    assert soak.grown(states()) == []
    assert soak.grown(states(resident_mib=noise, threads=noise)) == []
    assert soak.grown(states(anonymous_mib=lambda n: noise(n) + 0.7 * n)) == ["anonymous_mib"]
    assert soak.grown(states(resident_mib=hops)) == []
    assert soak.grown(states(temporary=lambda n: n)) == ["temporary"]
    assert soak.grown(states(descriptors=lambda n: 5 + (n > 11))) == []
    late = states()
    late[-2:] = [replace(state, working=101) for state in late[-2:]]
    assert soak.grown(late) == ["working"]


def test_a_round_leaves_no_file(tmp_path, monkeypatch):
    """Neither in TMPDIR nor in the working folder, nor in that of the caller."""
    monkeypatch.setattr(soak, "PRESETS", ("temporal",))
    monkeypatch.setattr(tempfile, "tempdir", tempfile.gettempdir())  # rounds have their own
    monkeypatch.setenv("TMPDIR", os.environ.get("TMPDIR", tempfile.gettempdir()))
    before = set(Path.cwd().iterdir())
    found = soak.rounds(1.0, 2, tmp_path / "table.csv")
    assert [(state.temporary, state.working) for state in found] == [(0, 0)] * 2
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 3
    assert set(Path.cwd().iterdir()) == before
