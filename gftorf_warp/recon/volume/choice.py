"""What differs between the training steps of a volume: which operations, and numbers.

The host decides it before each step. Operations follow from a key; one CUDA graph replays all steps
of a key, so their numbers are at the same addresses of the device each time.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...render.cuda import DeviceUpload

Given = Mapping[str, Tensor]
"""The numbers of a choice on the device, by name: vectors of int32 or float32."""


class Choice(NamedTuple):
    """What one step works on."""

    key: Hashable
    """Which operations it consists of."""
    numbers: dict[str, Sequence[int] | Sequence[float]]
    """What they read, by name; all choices of a key have the same names and lengths."""


class Inputs:
    """Numbers of the steps of one key on the device."""

    def __init__(self, numbers: Mapping[str, Sequence[float]], device: torch.device):
        """Allocate for numbers like these."""
        kinds = [_kind_of(values) for values in numbers.values()]
        lengths = [
            (len(values), kind) for values, kind in zip(numbers.values(), kinds, strict=True)
        ]
        self._upload = DeviceUpload(lengths, device)
        self.given: Given = dict(zip(numbers, self._upload.parts, strict=True))
        """They, undefined before the first :meth:`send`."""

    def send(self, numbers: Mapping[str, Sequence[float]]) -> None:
        """Upload those of the next step, without waiting for the device.

        Raises:
            ValueError: If names or lengths are not those that were allocated.
        """
        lengths = {name: len(values) for name, values in numbers.items()}
        wanted = {name: len(memory) for name, memory in self.given.items()}
        if lengths != wanted:
            raise ValueError(f"numbers of one key have the lengths {wanted}, got {lengths}")
        self._upload.send(*(numbers[name] for name in self.given))


def _kind_of(values: Sequence[float]) -> torch.dtype:
    whole = len(values) > 0 and all(isinstance(value, int) for value in values)
    return torch.int32 if whole else torch.float32
