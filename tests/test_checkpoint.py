"""Checkpoints: nothing is lost, nothing damaged is taken, nothing is run."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_runs import advance, demo, same, small

from gftorf_warp.errors import InputError
from gftorf_warp.recon import checkpoint
from gftorf_warp.recon.observations import observe
from gftorf_warp.recon.state import FORMAT, from_dict, to_dict
from gftorf_warp.scene.initialise import Init

OLD_RUN = Path(__file__).parent / "data" / "run_format2"

STORED = {
    "format": 1,
    "images": 120,
    "field": {"mean": torch.arange(6.0).view(2, 3)},
    "queue": [3, 1],
    "seconds": 1.5,
    "sums": {},
}


def write(path, data):
    """Put bytes where a checkpoint belongs, with the right SHA-256."""
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    path.with_suffix(".pt.sha256").write_text(hashlib.sha256(data).hexdigest() + "  " + path.name)


def test_the_digest_is_that_of_the_file(tmp_path):
    """As it is written beside it; none of a checkpoint that was never written."""
    path = checkpoint.save(tmp_path, STORED)
    assert checkpoint.digest(tmp_path, 120) == hashlib.sha256(path.read_bytes()).hexdigest()
    assert checkpoint.digest(tmp_path, 121) is None


def test_what_is_written_is_read(tmp_path):
    """A stored state comes back to the bit; a run without checkpoints has none."""
    path = checkpoint.save(tmp_path, STORED)
    assert path.name == "0000000120.pt"
    assert same(checkpoint.load(path), STORED)
    assert same(checkpoint.last(tmp_path), STORED)
    assert checkpoint.last(tmp_path / "elsewhere") is None


def test_the_last_two_are_kept(tmp_path):
    """Older ones go, and so do those that the run has gone back behind."""
    for images in (20, 40, 1000):
        checkpoint.save(tmp_path, STORED | {"images": images})
    names = sorted(path.name for path in (tmp_path / "ckpt").iterdir())
    assert names == [
        "0000000040.pt",
        "0000000040.pt.sha256",
        "0000001000.pt",
        "0000001000.pt.sha256",
    ]
    checkpoint.save(tmp_path, STORED | {"images": 60})
    assert sorted(path.name for path in (tmp_path / "ckpt").glob("*.pt")) == [
        "0000000040.pt",
        "0000000060.pt",
    ]


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "no sidecar"])
def test_a_damaged_checkpoint_is_refused_and_the_one_before_is_used(tmp_path, damage):
    """Torch itself does not notice a flipped bit."""
    checkpoint.save(tmp_path, STORED)
    path = checkpoint.save(tmp_path, STORED | {"images": 240})
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 1
    path.write_bytes({"cut": bytes(data[:-100]), "empty": b""}.get(damage, bytes(data)))
    if damage == "no sidecar":
        path.with_suffix(".pt.sha256").unlink()
    with pytest.raises(InputError, match=r"damaged checkpoint.*240"):
        checkpoint.load(path)
    assert checkpoint.last(tmp_path)["images"] == 120


KILLED_WHILE_SAVING = """
import json, os, sys
from pathlib import Path
import torch
from gftorf_warp.recon import checkpoint

def killed_at(count):
    def counted(real):
        def call(*args, **named):
            calls[0] += 1
            if calls[0] == count:
                os._exit(9)
            return real(*args, **named)
        return call
    calls = [0]
    for name in ("replace", "rename", "unlink"):
        setattr(os, name, counted(getattr(os, name)))

for before, saved in (([20, 40], 60), ([40], 40), ([20, 40], 30)):
    for count in range(1, 40):
        run = Path(sys.argv[1]) / f"{saved}-{count}"
        run.mkdir()
        stored = {"format": 1, "images": 0, "values": torch.arange(3.0)}
        for images in before:
            checkpoint.save(run, stored | {"images": images})
        child = os.fork()
        if child == 0:
            killed_at(count)
            checkpoint.save(run, stored | {"images": saved, "again": True})
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        found = checkpoint.last(run)
        images = None if found is None else found["images"]
        strays = sorted(path.name for path in (run / "ckpt").glob(".*"))
        row = [saved, count, code, images, len(checkpoint.after(run, images or 0)), strays]
        print(json.dumps(row))
        if code == 0:
            break
"""


def test_a_kill_at_any_step_of_saving_leaves_the_old_state_or_the_new_one(tmp_path):
    """Whether the name is new, taken, or behind the last one; nothing is taken for damaged."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED_WHILE_SAVING, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert not done.stderr, "a checkpoint was taken for damaged"
    allowed = {60: {40, 60}, 40: {40}, 30: {30, 40}}
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    kills = {saved: sum(row[0] == saved and row[2] == 9 for row in rows) for saved in allowed}
    assert min(kills.values()) >= 2
    for saved, count, code, images, newer, strays in rows:
        assert images in allowed[saved], (saved, count)
        assert newer == 0, (saved, count)
        assert strays == [], (saved, count)
        assert code == 9 or images == saved


def test_if_all_are_damaged_that_is_an_error(tmp_path):
    """Starting over silently would hide the loss."""
    path = checkpoint.save(tmp_path, STORED)
    path.write_bytes(b"nonsense")
    with pytest.raises(InputError, match="damaged"):
        checkpoint.last(tmp_path)


class Gadget:
    """Runs a command when it is unpickled by a careless loader."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_no_code_of_a_checkpoint_is_run(tmp_path):
    """A pickle that would run a command is refused before it does."""
    trace = tmp_path / "ran"
    place = tmp_path / "ckpt" / "0000000007.pt"
    place.parent.mkdir()
    torch.save({"format": 1, "images": 7, "gadget": Gadget(f"touch {trace}")}, place)
    write(place, place.read_bytes())
    with pytest.raises(InputError, match="unsafe") as caught:
        checkpoint.load(place)
    assert not trace.exists()
    assert "system, which could run code" in str(caught.value)
    assert "weights_only" not in str(caught.value), "torch's advice is to switch safety off"


def test_a_newer_format_is_refused(tmp_path):
    """And the message says which formats this version reads."""
    path = checkpoint.save(tmp_path, STORED | {"format": FORMAT + 1})
    with pytest.raises(InputError, match=f"formats up to {FORMAT}, found {FORMAT + 1}"):
        checkpoint.load(path)


def test_what_a_killed_process_left_is_swept(tmp_path):
    """Temporary files of dead processes go, those of living ones stay."""
    checkpoint.save(tmp_path, STORED)
    process = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True
    )
    gone = tmp_path / "ckpt" / f".0000000999.pt.tmp-{int(process.stdout)}-0"
    living = tmp_path / "ckpt" / f".0000000999.pt.tmp-{os.getpid()}-0"
    for stray in (gone, living):
        stray.write_bytes(b"half")
    checkpoint.last(tmp_path)
    assert not gone.exists()
    assert living.exists()


def test_a_checkpoint_of_format_2_continues_as_it_did_then():
    """Written before torch's Adam and the generator of backgrounds went; two more steps gave these
    numbers then.

    Three quartets of ``small`` with twenty random Gaussians and four nodes, seed 77.
    """
    stored = checkpoint.last(OLD_RUN)
    assert stored["format"] == 2 < FORMAT
    assert "noise" in stored
    settings = demo(images=60, warm_up=0)
    settings = replace(
        settings, init=replace(settings.init, kind=Init.RANDOM, count=20, bounds=(2.0, 4.0))
    )
    settings = replace(settings, motion=replace(settings.motion, nodes=4))
    state = from_dict(stored, "cpu")
    assert (state.images, state.noise_seed, len(state.optimiser.field)) == (12, 77, 20)
    for number, leaf in enumerate(state.optimiser.leaves):
        step, first, second = state.optimiser.moments_of(leaf)
        assert float(step) == 3
        assert torch.equal(first, stored["adam"]["state"][number]["exp_avg"])
        assert torch.equal(second, stored["adam"]["state"][number]["exp_avg_sq"])
    state.sums = {}
    assert advance(state, observe(small(), settings, "cpu"), settings, 2) == 0
    assert float(state.sums["loss"]) == pytest.approx(1.6581509, rel=1e-5)
    assert float(state.sums["opacity"]) == pytest.approx(7.9760275, rel=1e-5)
    sums = [float(value.detach().double().sum()) for value in state.optimiser.leaves]
    want = [68.512140, -13.425526, 19.789170, 44.366207, -28.973786, 0.0609448]
    assert sums == pytest.approx(want, rel=1e-4, abs=1e-4)
    assert to_dict(state)["format"] == FORMAT
