"""Where torch renders with Warp: shares memory, follows torch's stream, attaches gradients."""

from __future__ import annotations

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.geometry import CameraView
from ..scene.camera import Camera
from . import launch
from .buffers import Frame, RenderSettings, Workspace
from .device_camera import DeviceCamera
from .inputs import Images, Inputs, View, names_of, shapes_of

INPUTS = names_of(Inputs)
IMAGES = names_of(Images)
ALIGNED = 64  # [float32] to which parts of one memory are rounded
SLOTS = 8  # steps that the host may be ahead of the device
_VECTORS = {"mean": wp.vec3, "log_scale": wp.vec3, "quaternion": wp.vec4, "colour_sh": wp.vec3}


@dataclass(frozen=True, kw_only=True, eq=False)
class Request:
    """What is rendered, and how, besides tensors with a derivative."""

    camera: Camera
    """Its size, and whether its lens distorts; without ``control`` all of it."""
    shifts: tuple[float, ...]
    """Phase shifts of the quads [rad]; with ``control`` only their number counts."""
    control: DeviceCamera | None = None
    """Camera and shifts in device memory; None: uploaded from ``camera`` and ``shifts``."""
    settings: RenderSettings
    """How."""
    screen: Tensor | None = None
    """[N, 4] that backward fills with screen gradient, pixels and weight, ``api.ScreenGradient``; None: not wanted."""
    images: frozenset[str]
    """Names of what is wanted of quads, phasor, distance, opacity and distortion; colour and extra always are."""
    workspace: Workspace | None = None
    """Where; None: in memory of its own."""
    extra_detached: bool = False
    """Whether extra images hold the weights fixed."""


class Rasterize(torch.autograd.Function):
    """All images of one rendering from all inputs of one; without a workspace each has arrays of its own."""

    @staticmethod
    def forward(
        ctx: Any,
        request: Request,
        *tensors: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        """Return the images in the order of ``IMAGES``, None where there is none.

        Args:
            ctx: Of autograd.
            request: What and how.
            tensors: In the order of ``INPUTS``, float32, contiguous, None where there is none.
        """
        ctx.set_materialize_grads(False)
        named = dict(zip(INPUTS, tensors, strict=True))
        mean, extra, colour_sh = named["mean"], named["extra"], named["colour_sh"]
        assert mean is not None
        camera, shifts = request.camera, request.shifts
        shapes = shapes_of(len(shifts), camera.height, camera.width, 0 if extra is None else extra.shape[1])
        made = request.images | {name for name, of in (("colour", colour_sh), ("extra", extra)) if of is not None}
        images = {name: mean.new_empty(shapes[name]) for name in IMAGES if name in made}
        with stream_of(mean):
            device = wp.device_from_torch(mean.device)
            kind = len(mean), camera.width, camera.height, request.settings, device
            frame = Frame(*kind) if request.workspace is None else request.workspace.frame(*kind)
            view = _view(request, device)
            learns = any(ctx.needs_input_grad)  # otherwise these are the launches of a replay
            launch.forward(_inputs(named), view, frame, _images(images), differentiable=learns)
        ctx.save_for_backward(*tensors)
        ctx.state = request, view, frame, frame.turns
        return tuple(images.get(name) for name in IMAGES)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        """Launch the adjoints explicitly: no tape, no state outside ``ctx``; gradients into fresh tensors."""
        named = dict(zip(INPUTS, ctx.saved_tensors, strict=True))
        request, view, frame, turn = ctx.state
        if frame.turns != turn:
            raise ValueError("its workspace has rendered again since: call backward before the next rendering with it")
        screen = request.screen
        needed = dict(zip(INPUTS, ctx.needs_input_grad[1:], strict=True))
        wanted = _zeros_like({name: named[name] for name in INPUTS if needed[name]})
        cotangents = {name: g.contiguous() for name, g in zip(IMAGES, grads, strict=True) if g is not None}
        if cotangents and wanted:
            with stream_of(named["mean"]):
                arrays = _inputs(named), view, frame, _images(cotangents), _inputs(wanted)
                records = launch.backward(*arrays, extra_detached=request.extra_detached)
                if screen is not None and len(screen):
                    pairs = wp.to_torch(records).unflatten(1, (-1, 2))  # of slots: the first and the fourth
                    screen.view(-1, 2, 2).copy_(pairs[:, 0:4:3])
        return None, *(wanted.get(name) for name in INPUTS)


def _view(request: Request, device: wp.Device) -> View:
    """Camera and shifts as kernels read them; arrays of ``control`` are those of its tensors."""
    camera, control = request.camera, request.control
    if control is None:
        return launch.uploaded(camera, request.shifts, request.settings, device)
    pointer = control.view.data_ptr()
    view = wp.array(ptr=pointer, dtype=CameraView, shape=(1,), device=device)
    return View(camera=view, shifts=array_over(control.shifts, wp.vec2), lens=bool(camera.distortion))


def _zeros_like(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Zeros of these shapes, cleared at once: parts of one memory, each with lines of cache of its own."""
    if not tensors:
        return {}
    rooms = [-(-tensor.numel() // ALIGNED) * ALIGNED for tensor in tensors.values()]
    first = next(iter(tensors.values()))
    parts = first.new_zeros(sum(rooms)).split(rooms)
    return {name: part[: t.numel()].view(t.shape) for part, (name, t) in zip(parts, tensors.items(), strict=True)}


def _inputs(named: Mapping[str, Tensor | None]) -> Inputs:
    return Inputs(**{name: array_over(named.get(name), _VECTORS.get(name, wp.float32)) for name in INPUTS})


def _images(named: Mapping[str, Tensor]) -> Images:
    return Images(**{name: array_over(named.get(name), wp.float32) for name in IMAGES})


def left_out(name: str, like: Tensor, height: int, width: int) -> Tensor:
    """What stands for an image that nobody asked for: no elements, where ``like`` is."""
    return like.new_empty(0, *shapes_of(0, height, width)[name][1:])


def array_over(tensor: Tensor | None, dtype=wp.float32) -> wp.array | None:
    """A Warp array over the memory of a tensor, without its history."""
    if tensor is None:
        return None
    wp.init()  # from_torch needs the runtime; does nothing after the first call
    if tensor.numel() == 0:  # strides of an empty tensor say nothing, and from_torch believes them
        shape = tensor.shape[: tensor.ndim - len(getattr(dtype, "_shape_", ()))]
        return wp.empty(tuple(shape), dtype=dtype, device=wp.device_from_torch(tensor.device))
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def stream_of(tensor: Tensor):
    """Order launches with the torch work around them; on the CPU there is nothing to order."""
    wp.init()
    if tensor.is_cuda:
        return wp.ScopedStream(_warp_stream(torch.cuda.current_stream(tensor.device)), sync_enter=False)
    return contextlib.nullcontext()


@functools.cache
def _warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """The one Warp stream over a torch stream, kept for good.

    Warp knows a stream by its handle and forgets it, scratch memory and a capture included, as soon as any of the
    objects over that handle dies.
    """
    return wp.stream_from_torch(stream)


@contextlib.contextmanager
def captured(graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream | None = None, pool: Any = None) -> Iterator[None]:
    """Capture what torch and Warp do inside the block, backward passes included, in a graph that torch replays.

    The same must have run before on ``stream``: modules get loaded, constants uploaded and libraries started then. What
    is rendered must have a reserve of pairs; with a ``Workspace`` nothing is allocated by a replay either. What the
    graph reads and writes must live as long as it is replayed.

    Args:
        graph: An empty one.
        stream: Where to capture, not the default stream; None: one of torch's own.
        pool: Memory that several graphs share, of which one runs after the other and none looks at what another made.
    """
    wp.init()
    mode = "thread_local"  # what Warp takes for granted
    with without_garbage_collection(), torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode=mode):
        with wp.ScopedCapture(stream=_warp_stream(torch.cuda.current_stream()), external=True):
            yield


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """No cycle of references is looked for inside the block.

    An older graph may hang on one, and to let go of its memory would break off a capture that is under way.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def pairs_of(workspace: Workspace) -> Tensor:
    """[1] int32: (tile, splat) pairs of the last rendering, where it was made; more than the reserve if some were lost.

    Raises:
        ValueError: If nothing has been rendered there.
    """
    return wp.to_torch(workspace.last.total)


@dataclass(frozen=True, eq=False)
class Sent:
    """Numbers of one kind in an :class:`Outbox`."""

    there: Tensor
    """Where the device reads them."""


class Outbox:
    """A few numbers of 32 bits that the host writes before every step and the device reads, without either waiting.

    Whatever their kind they cross in one copy: each takes 3 us of a stream of an H200, however short it is.
    """

    def __init__(self, lengths: Sequence[tuple[int, torch.dtype]], device: torch.device):
        """Make room.

        Args:
            lengths: How many numbers at most, and of which kind: the bits of all kinds stand in one memory of integers.
            device: Who reads them.
        """
        remote, sizes = device.type != "cpu", [length for length, _ in lengths]

        def parts_of(room: Tensor) -> list[Tensor]:
            return [part.view(dtype) for part, (_, dtype) in zip(room.split(sizes), lengths, strict=True)]

        self._there = torch.zeros(sum(sizes), dtype=torch.int32, device=device)
        self.parts = [Sent(part) for part in parts_of(self._there)]
        """In the order of ``lengths``."""
        slots = [torch.zeros(sum(sizes), dtype=torch.int32, pin_memory=remote) for _ in range(SLOTS if remote else 1)]
        self._slots = [(slot, parts_of(slot)) for slot in slots]
        self._sent: list[torch.cuda.Event | None] = [None] * len(slots)
        self._next = 0

    def send(self, *numbers: Sequence[float]) -> None:
        """Let the device see these from now on, in the order of the stream; nobody may read behind a shorter list."""
        (slot, parts), event = self._slots[self._next], self._sent[self._next]
        if event is not None:
            event.synchronize()  # of a step long ago: the host is at most so many ahead
        for part, own in zip(parts, numbers, strict=True):
            part[: len(own)] = torch.tensor(own, dtype=part.dtype)
        self._there.copy_(slot, non_blocking=True)
        if self._there.is_cuda:
            self._sent[self._next] = event = event or torch.cuda.Event()
            event.record()
        self._next = (self._next + 1) % len(self._slots)


class Inbox:
    """A few numbers that the device has and the host would like to know, some steps late: neither waits."""

    def __init__(self, there: Tensor):
        self._there = there
        self._slots = [torch.zeros_like(there, device="cpu", pin_memory=there.is_cuda) for _ in range(SLOTS)]
        self._asked: list[tuple[Tensor, torch.cuda.Event | None]] = []  # from the oldest to the newest
        self._next = 0

    def ask(self) -> None:
        """Send for the numbers of the work so far, unless ``SLOTS`` answers are on their way."""
        if len(self._asked) == SLOTS:
            return
        slot, event = self._slots[self._next], None
        slot.copy_(self._there, non_blocking=True)
        if self._there.is_cuda:
            event = torch.cuda.Event()
            event.record()
        self._asked.append((slot, event))
        self._next = (self._next + 1) % SLOTS

    def look(self, *, wait: bool = False) -> list[int] | None:
        """The newest numbers that have arrived since the last look, if any; ``wait``: all that were asked for have."""
        newest = None
        while self._asked:
            slot, event = self._asked[0]
            if event is not None and wait:
                event.synchronize()
            elif event is not None and not event.query():
                break
            newest = slot
            del self._asked[0]
        return None if newest is None else newest.tolist()


class Captured:
    """Work on one device as a CUDA graph: captured at the first call, replayed from then on; on a CPU it just runs.

    What the work reads and writes must keep its addresses, and nothing of it may wait for the device. What it allocates
    belongs to the graph; nobody else may look at it.
    """

    def __init__(
        self, work: Callable[[], None], device: torch.device, ready: Callable[[], None] | None = None, pool: Any = None
    ):
        """Wrap ``work``.

        Args:
            work: What is captured.
            device: Where it is done.
            ready: Called once it is captured, before the first replay.
            pool: Memory shared with other graphs, see :func:`captured`; None: its own.
        """
        self._work, self._device, self._ready, self._pool = work, device, ready, pool
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Do the work."""
        if self._device.type == "cpu":
            self._work()
            return
        if self._graph is None:
            self._graph = self._capture()
            if self._ready is not None:
                self._ready()
        self._graph.replay()

    def _capture(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        with captured(graph, pool=self._pool):
            self._work()
        return graph


def shared_pool(device: torch.device) -> Any:
    """Memory for graphs that run one after the other; None on a CPU."""
    return torch.cuda.graph_pool_handle() if device.type != "cpu" else None


class Branches:
    """Streams that fork from torch's current one and join it again: what does not depend on each other may overlap.

    A captured graph has as many branches then, and so has the gradient, which runs where its operation ran. On a CPU
    there is one stream. Where blocks of several branches wait, those of the earlier one go first, so that branches do
    different things at one time; the first should be the longest.
    """

    def __init__(self, count: int, device: torch.device):
        self._device, self._streams = device, []
        if device.type != "cpu" and count > 1:
            self._streams = [torch.cuda.Stream(device, priority=n + 1 - count) for n in range(count)]
        self._open: set[torch.cuda.Stream] = set()

    @contextlib.contextmanager
    def fork(self, number: int) -> Iterator[None]:
        """Work on branch ``number`` from here on, behind everything before."""
        if not self._streams:
            yield
            return
        stream = self._streams[number]
        self._open.add(stream)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            yield

    def join(self) -> None:
        """Wait, on the current stream, for all branches that were forked."""
        for stream in self._open:
            torch.cuda.current_stream(self._device).wait_stream(stream)
        self._open.clear()
