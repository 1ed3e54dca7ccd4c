"""Streams, events and graphs of CUDA: the only module that uses them.
On a CPU everything runs in order, at once.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from ..errors import ResourceError
from . import runtime

SLOTS = 8  # uploads, or readbacks, that may be in flight
HOST_BYTES = 1 << 28  # of page-locked memory at most: the system cannot use it for anything else
PAGE = 4096  # [bytes] alignment of readback buffers, which a disk then writes without a copy


@contextlib.contextmanager
def stream_of(tensor: Tensor) -> Iterator[None]:
    """Context in which Warp launches on torch's current stream of the tensor's device, while other
    threads of the program wait; on a CPU there is no stream, and nothing to wait for.

    Raises:
        ResourceError: If this process was forked from one that had used CUDA.
    """
    runtime.start()
    if not tensor.is_cuda:
        yield
        return
    with runtime.LAUNCHING:
        if torch.cuda._is_in_bad_fork():
            raise ResourceError(
                "CUDA cannot be used after a fork",
                where=tensor.device,
                why="this process was forked from one that had used CUDA",
                fix="start processes with the method spawn, or render on the CPU in them",
            )
        stream = _warp_stream(torch.cuda.current_stream(tensor.device))
        with on_device(tensor.device), wp.ScopedStream(stream, sync_enter=False):
            yield


def on_device(device: torch.device | str) -> contextlib.AbstractContextManager[object]:
    """Context in which a GPU is torch's current one, where its events and graphs are made."""
    device = torch.device(device)
    return contextlib.nullcontext() if device.type == "cpu" else torch.cuda.device(device)


@functools.cache
def _warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """The Warp stream over a torch stream, cached: Warp releases it with its first wrapper."""
    return wp.stream_from_torch(stream)


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Disable cyclic garbage collection: freeing an older graph would invalidate a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextlib.contextmanager
def capture(
    graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream | None = None, pool: Any = None
) -> Iterator[None]:
    """Capture torch's and Warp's work inside the block in a graph that torch replays.

    The same work must have run before on ``stream``, to load modules and libraries. A rendering
    needs a pair capacity. What the graph reads and writes must outlive it.

    Args:
        graph: An empty one.
        stream: Where to capture, not the default stream; None: one of torch's own.
        pool: Memory shared with graphs that are replayed one after the other, see
            :func:`graph_pool`; None: its own.
    """
    runtime.start()
    mode = "thread_local"  # Warp's own assumption
    _warp_stream(torch.cuda.current_stream())  # Warp's first use of a GPU must not be captured
    with (  # no runtime.LAUNCHING: autograd's thread launches the backward pass, and would wait
        without_garbage_collection(),
        torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode=mode),
    ):
        with wp.ScopedCapture(stream=_warp_stream(torch.cuda.current_stream()), external=True):
            yield


def graph_pool(device: torch.device) -> Any:
    """Memory for graphs that are replayed one after the other; None on a CPU."""
    return torch.cuda.graph_pool_handle() if device.type != "cpu" else None


class CapturedGraph:
    """A CUDA graph of a function, captured at the first call and replayed.

    The function must not synchronise, and what it reads and writes must keep its addresses. What it
    allocates is valid until the next graph of its pool is replayed. It is an argument of every
    call, not kept: an object that keeps its graph would otherwise refer to itself.
    """

    def __init__(
        self,
        ready: Callable[[], None] | None = None,
        pool: Any = None,
        generators: Sequence[torch.Generator] = (),
    ):
        """Nothing is captured yet.

        Args:
            ready: Called between the capture and the first replay.
            pool: Memory shared with other graphs, see :func:`graph_pool`; None: its own.
            generators: Those of the device that the function draws from, besides torch's default
                one: every replay goes on where the last draw ended.
        """
        self._ready, self._pool, self._generators = ready, pool, generators
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, work: Callable[[], object]) -> None:
        """Replay the graph of ``work``, the same in all calls; the first one captures it."""
        if self._graph is None:
            graph = torch.cuda.CUDAGraph()
            for generator in self._generators:
                graph.register_generator_state(generator)
            with capture(graph, pool=self._pool):
                work()
            self._graph = graph
            if self._ready is not None:
                self._ready()
        self._graph.replay()


class SideStreams:
    """Streams that fork from torch's current one and join it again, for independent work.

    A backward pass runs on the stream of its forward operation. Earlier streams have priority: the
    first one should have the most work.
    """

    def __init__(self, count: int, device: torch.device, *, fewest: int = 2):
        """Create streams.

        Args:
            count: How many.
            device: Of the streams; on a CPU there are none.
            fewest: With fewer, work stays on the current stream.
        """
        self._device, self._streams = device, []
        if device.type != "cpu" and count >= fewest:
            self._streams = [
                torch.cuda.Stream(device, priority=n + 1 - count) for n in range(count)
            ]
        self._open: set[torch.cuda.Stream] = set()

    @contextlib.contextmanager
    def fork(self, number: int = 0, *, wait: bool = True) -> Iterator[None]:
        """Run the block on stream ``number``; with ``wait`` after the current stream's work."""
        if not self._streams:
            yield
            return
        stream = self._streams[number]
        self._open.add(stream)
        if wait:
            stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            yield

    def join(self) -> None:
        """The current stream waits for all streams that were forked."""
        for stream in self._open:
            torch.cuda.current_stream(self._device).wait_stream(stream)
        self._open.clear()


def free_memory(device: torch.device | str) -> float | None:
    """Free memory of a GPU [B]; None for a CPU."""
    device = torch.device(device)
    return None if device.type == "cpu" else float(torch.cuda.mem_get_info(device)[0])


def forget_peak_memory(device: torch.device | str) -> None:
    """Let :func:`peak_memory` count from here on."""
    if torch.device(device).type != "cpu" and torch.cuda.is_initialized():
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory(device: torch.device | str) -> float | None:
    """Largest memory of a GPU that torch has held in this process since
    :func:`forget_peak_memory` [B]; None for a CPU.
    """
    device = torch.device(device)
    return None if device.type == "cpu" else float(torch.cuda.max_memory_allocated(device))


@functools.cache
def side_stream(device: torch.device) -> SideStreams:
    """One side stream, always the same one: cuBLAS keeps a workspace for every stream."""
    return SideStreams(1, device, fewest=1)


class DeviceUpload:
    """32-bit numbers that the host writes before each step, uploaded in one asynchronous copy."""

    def __init__(self, lengths: Sequence[tuple[int, torch.dtype]], device: torch.device):
        """Allocate.

        Args:
            lengths: Largest number of elements of each part, and its dtype, of 32 bits.
            device: Which reads them.
        """
        remote, sizes = device.type != "cpu", [length for length, _ in lengths]

        def parts_of(memory: Tensor) -> list[Tensor]:
            parts = zip(memory.split(sizes), lengths, strict=True)
            return [part.view(dtype) for part, (_, dtype) in parts]

        self._memory = torch.zeros(sum(sizes), dtype=torch.int32, device=device)
        self.parts = parts_of(self._memory)
        """Device memory, in the order of ``lengths``."""
        self._slots = []
        for _ in range(SLOTS if remote else 1):
            slot = torch.zeros(sum(sizes), dtype=torch.int32, pin_memory=remote)
            self._slots.append((slot, parts_of(slot)))
        self._uploaded: list[torch.cuda.Event | None] = [None] * len(self._slots)
        self._next = 0

    def send(self, *numbers: Sequence[float] | np.ndarray) -> None:
        """Upload the first elements of every part, in stream order; the rest is undefined."""
        (slot, parts), event = self._slots[self._next], self._uploaded[self._next]
        if event is not None:
            event.synchronize()  # of ``SLOTS`` uploads ago
        for part, values in zip(parts, numbers, strict=True):
            part[: len(values)] = torch.as_tensor(values, dtype=part.dtype)
        self._memory.copy_(slot, non_blocking=True)
        if self._memory.is_cuda:
            self._uploaded[self._next] = event = event or torch.cuda.Event()
            event.record()
        self._next = (self._next + 1) % len(self._slots)


class DeviceReadback:
    """A few numbers of the device that the host reads some steps later; neither waits."""

    def __init__(self, source: Tensor):
        self._source = source
        self._slots = [
            torch.zeros_like(source, device="cpu", pin_memory=source.is_cuda) for _ in range(SLOTS)
        ]
        # from the oldest to the newest
        self._requested: list[tuple[Tensor, torch.cuda.Event | None]] = []
        self._next = 0

    def request(self) -> None:
        """Read the numbers back in stream order, unless ``SLOTS`` readbacks are in flight."""
        if len(self._requested) == SLOTS:
            return
        slot, event = self._slots[self._next], None
        slot.copy_(self._source, non_blocking=True)
        if self._source.is_cuda:
            event = torch.cuda.Event()
            event.record()
        self._requested.append((slot, event))
        self._next = (self._next + 1) % SLOTS

    def latest(self, *, wait: bool = False) -> list[int] | None:
        """The newest numbers since the last call, or None; ``wait``: for all requests."""
        newest = None
        while self._requested:
            slot, event = self._requested[0]
            if event is not None and wait:
                event.synchronize()
            elif event is not None and not event.query():
                break
            newest = slot
            del self._requested[0]
        return None if newest is None else newest.tolist()


class ReadbackRing:
    """Buffers for images that are read back while the next ones are rendered.

    ``copy`` copies memory that the next rendering overwrites, a second stream brings it to the
    host, and ``wait`` returns it. At most ``ahead`` + 1 copies are in flight.
    """

    def __init__(self, like: Tensor, *, ahead: int, kept: int, tail: int | None = None):
        """Allocate all memory.

        Args:
            like: [L] what will be copied, on its device.
            ahead: Copies that may be in flight when the next one is made.
            kept: Copies that callers may hold besides; fewer if they would take more than 256 MiB.
            tail: Only so many of the last elements go to the host; None: all.
        """
        self._remote, self._tail = like.is_cuda, len(like) if tail is None else tail
        near = like if self._remote or tail is not None else like[:0]
        self._near = [torch.empty_like(near) for _ in range(ahead + 2)]  # one is being read
        self._idle = deque(range(len(self._near)))
        page = PAGE // like.element_size()
        length = -(-self._tail // page) * page
        self._in_flight = ahead + 1
        count = self._in_flight + min(kept, max(1, HOST_BYTES // (length * like.element_size())))
        far = torch.empty(count * length + page, dtype=like.dtype, pin_memory=self._remote)
        start = -far.data_ptr() % PAGE // like.element_size()
        self._far = far[start : start + count * length].view(count, length)[:, : self._tail]
        # of ``_far``; callers may return one at any time, from any thread
        self._free = deque(range(count))
        if self._remote:
            self._stream = torch.cuda.Stream(like.device)
            self._ready = [torch.cuda.Event() for _ in self._near]
            self._done = [torch.cuda.Event() for _ in self._near]

    def copy(self, memory: Tensor) -> tuple[int, int]:
        """Copy memory [L], in the order of the current stream; returns a ticket."""
        ticket = near, far = self._idle.popleft(), self._free.popleft()
        staged = self._near[near]
        if len(staged):
            staged.copy_(memory)
        if not self._remote:
            self._far[far].copy_(memory[-self._tail :])
            return ticket
        self._ready[near].record()
        self._stream.wait_event(self._ready[near])
        with torch.cuda.stream(self._stream):
            self._far[far].copy_(staged[-self._tail :], non_blocking=True)
        self._done[near].record(self._stream)
        return ticket

    def wait(self, ticket: tuple[int, int]) -> np.ndarray:
        """Wait for a copy: its last elements [tail], until its ticket is released or kept."""
        near, far = ticket
        if self._remote:
            self._done[near].synchronize()
        return self._far[far].numpy()

    def on_device(self, ticket: tuple[int, int]) -> Tensor:
        """[L] a copy on the device, until its ticket is released or kept."""
        return self._near[ticket[0]]

    def release(self, ticket: tuple[int, int]) -> None:
        """The buffers of a copy that has arrived may be used again."""
        self._idle.append(ticket[0])
        self._free.append(ticket[1])

    def keep(self, ticket: tuple[int, int]) -> Float[np.ndarray, " tail"]:
        """A copy that has arrived, as an array whose buffer is returned when it is deleted; an
        ordinary array if the next copies need the buffer.
        """
        near, far = ticket
        self._idle.append(near)
        array, in_flight = self._far[far].numpy(), len(self._near) - len(self._idle)
        if len(self._free) + in_flight < self._in_flight:
            array = array.copy()
            self._free.append(far)
        else:
            # views of it keep a reference to it
            weakref.finalize(array, self._free.append, far).atexit = False
        return array

    def close(self) -> None:
        """Wait for all copies, so that none writes to memory that is freed."""
        if self._remote:
            self._stream.synchronize()
