"""Memory through which images leave the device while it renders the next ones: torch only, neither side waits."""

from __future__ import annotations

import weakref
from collections import deque

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

HOST_BYTES = 1 << 28  # of page-locked memory at most: the system cannot use it for anything else
PAGE = 4096  # [bytes] copies start at such addresses on the host, of which a disk takes them as they are


class Outgoing:
    """Slots on the device and on the host, between which a second stream copies.

    ``send`` copies a memory that the next rendering overwrites, ``arrived`` waits until that copy is on the host. At
    most ``ahead`` + 1 copies are on their way at a time. On a CPU there is nothing to wait for.
    """

    def __init__(self, like: Tensor, *, ahead: int, kept: int, tail: int | None = None):
        """Reserve all memory: nothing is allocated later.

        Args:
            like: [L] what will be sent, where it is.
            ahead: Copies that may be on their way when the next one is sent.
            kept: Copies that others may hold while more are sent; fewer if they would take more than 256 MiB.
            tail: Only so many of the last elements go to the host; None: all.
        """
        self._remote, self._tail = like.is_cuda, len(like) if tail is None else tail
        near = like if self._remote or tail is not None else like[:0]
        self._near = [torch.empty_like(near) for _ in range(ahead + 2)]  # one is being looked at
        self._idle = deque(range(len(self._near)))
        page = PAGE // like.element_size()
        room = -(-self._tail // page) * page
        self._moving = ahead + 1
        count = self._moving + min(kept, max(1, HOST_BYTES // (room * like.element_size())))
        far = torch.empty(count * room + page, dtype=like.dtype, pin_memory=self._remote)
        start = -far.data_ptr() % PAGE // like.element_size()
        self._far = far[start : start + count * room].view(count, room)[:, : self._tail]
        self._free = deque(range(count))  # of ``_far``; others may put back at any time, from any thread
        if self._remote:
            self._stream = torch.cuda.Stream(like.device)
            self._ready = [torch.cuda.Event() for _ in self._near]
            self._done = [torch.cuda.Event() for _ in self._near]

    def send(self, memory: Tensor) -> tuple[int, int]:
        """Copy a memory [L], in the order of the current stream; a ticket for it."""
        near, far = self._idle.popleft(), self._free.popleft()
        here, there = self._near[near], self._far[far]
        if len(here):
            here.copy_(memory)
        if not self._remote:
            there.copy_(memory[-self._tail :])
            return near, far
        self._ready[near].record()
        self._stream.wait_event(self._ready[near])
        with torch.cuda.stream(self._stream):
            there.copy_(here[-self._tail :], non_blocking=True)
        self._done[near].record(self._stream)
        return near, far

    def arrived(self, ticket: tuple[int, int]) -> np.ndarray:
        """Wait for a copy: its last elements [tail], until its ticket is given back or kept."""
        near, far = ticket
        if self._remote:
            self._done[near].synchronize()
        return self._far[far].numpy()

    def near(self, ticket: tuple[int, int]) -> Tensor:
        """[L] a copy on the device, until its ticket is given back or kept."""
        return self._near[ticket[0]]

    def give_back(self, ticket: tuple[int, int]) -> None:
        """Nobody looks at an arrived copy any more."""
        self._idle.append(ticket[0])
        self._free.append(ticket[1])

    def keep(self, ticket: tuple[int, int]) -> Float[np.ndarray, " tail"]:
        """An arrived copy as an array that is the caller's for as long as anything refers to it.

        Its memory comes back when nothing does. While too many are held to go on with the rest, the array is an
        ordinary one, which costs a copy.
        """
        near, far = ticket
        self._idle.append(near)
        array, moving = self._far[far].numpy(), len(self._near) - len(self._idle)
        if len(self._free) + moving < self._moving:
            array = array.copy()
            self._free.append(far)
        else:
            weakref.finalize(array, self._free.append, far).atexit = False  # parts of it refer to it
        return array

    def close(self) -> None:
        """Wait for what is under way, so that nothing writes to memory that is let go."""
        if self._remote:
            self._stream.synchronize()
