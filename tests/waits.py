"""Counts of what costs a host time where a GPU computes: operations, and those that wait for it."""

from collections import Counter

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

VIEWS = {"view", "slice", "select", "unsqueeze", "detach", "alias", "expand", "split", "unbind"}
WAITS = {
    "nonzero",
    "masked_select",
    "_local_scalar_dense",
    "index by mask",
    "index_put_ by mask",
    "equal",
}
READS = {torch.Tensor.tolist, torch.Tensor.item, torch.Tensor.numpy}
READS |= {
    torch.Tensor.__bool__,
    torch.Tensor.__int__,
    torch.Tensor.__float__,
    torch.Tensor.__index__,
}


class Operations(TorchDispatchMode):
    """Counts operations by name; on a GPU each is a launch or more."""

    def __init__(self):
        super().__init__()
        self.found = Counter()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        name = operation.__name__.split(".")[0]
        if name not in VIEWS:
            masks = (
                [index for index in args[1] if index is not None]
                if name in ("index", "index_put_")
                else []
            )
            self.found[
                f"{name} by mask" if any(index.dtype == torch.bool for index in masks) else name
            ] += 1
        return operation(*args, **(kwargs or {}))


class Reads(TorchFunctionMode):
    """Counts what makes the host wait for a GPU."""

    found = 0

    def __torch_function__(self, function, types, args=(), kwargs=None):
        self.found += function in READS
        return function(*args, **(kwargs or {}))
