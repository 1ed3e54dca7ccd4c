"""Training steps of neural volumes, and a stand-in for CUDA graphs on a CPU."""

import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gftorf_warp.recon.volume.choice import Inputs

READS = {"_local_scalar_dense", "equal", "nonzero", "masked_select"}
UPLOADS = {"lift_fresh"}


def terms_of(volume, targets, step, settings, draw):
    """Terms of the loss of a step."""
    choice = volume.choice(targets, step, settings, draw)
    inputs = Inputs(choice.numbers, volume.device)
    inputs.send(choice.numbers)
    return volume.terms(targets, choice.key, inputs.given, settings, draw)


class Recorded(TorchDispatchMode):
    """Replays the operations of the first call, of torch and Warp, on the memory that they had.

    Like a CUDA graph: whatever Python decided or computed in the first call stays as it was. What
    the host would read from the device or upload to it is an error.
    """

    def __init__(self, monkeypatch):
        super().__init__()
        self._patch, self._operations, self.replays = monkeypatch, [], 0

    def __call__(self, work):
        """Run and record, then replay."""
        if self._operations:
            self.replays += 1
            with torch.no_grad():
                for operation in self._operations:
                    operation()
            return
        launch = wp.launch

        def launched(*args, **kwargs):
            self._operations.append(lambda: launch(*args, **kwargs))
            return launch(*args, **kwargs)

        with self._patch.context() as patch, self:
            patch.setattr(wp, "launch", launched)
            work()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = operation.__name__.split(".")[0]
        if name in READS | UPLOADS:
            raise AssertionError(f"{name} makes the host wait: it cannot be captured")
        found = operation(*args, **kwargs)
        kept = [one for one in tree_leaves(found) if isinstance(one, torch.Tensor)]

        def again():
            new = tree_leaves(operation(*args, **kwargs))
            for old, one in zip(kept, (n for n in new if isinstance(n, torch.Tensor)), strict=True):
                if old.data_ptr() != one.data_ptr():
                    old.copy_(one)

        self._operations.append(again)
        return found
