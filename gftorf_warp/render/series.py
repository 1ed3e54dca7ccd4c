"""Many images of a replay, rendered ahead without synchronisation.

The number of pairs of an image arrives with it, a few images later. An image that exceeded the pair
capacity is rendered again with a larger one before it is returned, so every image is complete, in
the order of the views. On a CPU every image is rendered when it is iterated over.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..scene.camera import Camera
from .api import Rendering
from .cuda import ReadbackRing
from .replay import Replay, Target, part

AHEAD = 4  # images that are launched before the first is read: 1 ms, longer than a host is late
KEPT = 40  # arrays on the host that a caller may keep without copies being made
View = tuple[float, Camera]  # time [s] and camera


@dataclass(kw_only=True, eq=False)
class _Pending:
    """An image that was launched."""

    view: View
    target: Target
    readback: ReadbackRing
    ticket: tuple[int, int]


class Series:
    """The images of a replay from many views; iterate over :meth:`on_host` or :meth:`on_device`."""

    def __init__(self, replay: Replay, views: Iterable[View]):
        """Nothing is rendered yet.

        Args:
            replay: What to render.
            views: Time [s] and camera of each image.
        """
        self._replay, self._views = replay, iter(views)
        self.ahead = AHEAD if replay.device.is_cuda else 0
        self.repeated = 0
        """Images so far that were rendered again because they exceeded the pair capacity."""
        self._kept = KEPT
        self._readbacks: dict[int, ReadbackRing] = {}  # by the length of a packed image

    def on_host(self, kept: int = KEPT) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
        """Images by name as arrays on the host, float32: quads [4, H, W], distance [H, W] and so
        on.

        Arrays stay valid: their memory is reused only when nothing refers to it or a part of it.
        Pinned memory is reserved for ``kept`` images (for fewer, if they would take more than 256
        MiB); a caller that keeps more of them gets the others as copies in pageable memory.
        """
        self._kept = kept
        for image in self._complete(tail=False):
            packed, places = image.readback.keep(image.ticket), image.target.places
            yield {name: part(packed, *places[name]) for name in places}

    def on_device(self) -> Iterator[Rendering]:
        """Images on the device, which the next iteration may overwrite."""
        if not self.ahead:
            for view in self._views:
                yield self._replay(*view)
            return
        for image in self._complete(tail=True):
            packed, places = image.readback.on_device(image.ticket), image.target.places
            tensors = {name: part(packed, *places[name]) for name in places}
            yield self._replay.rendering(tensors, image.view[1])
            image.readback.release(image.ticket)

    def _complete(self, *, tail: bool) -> Iterator[_Pending]:
        """Images in order that have arrived and did not exceed the pair capacity."""
        pending: deque[_Pending] = deque()
        try:
            for view in self._views:
                pending.append(self._launch(view, tail))
                if len(pending) > self.ahead:
                    yield self._checked(pending.popleft(), tail)
            while pending:
                yield self._checked(pending.popleft(), tail)
        finally:
            for readback in self._readbacks.values():
                readback.close()

    def _launch(self, view: View, tail: bool) -> _Pending:
        target = self._replay.draw(*view)
        length = len(target.packed)
        if length not in self._readbacks:
            few = {"kept": 1, "tail": 1} if tail else {"kept": self._kept}
            self._readbacks[length] = ReadbackRing(target.packed, ahead=self.ahead, **few)
        readback = self._readbacks[length]
        return _Pending(
            view=view, target=target, readback=readback, ticket=readback.copy(target.packed)
        )

    def _checked(self, image: _Pending, tail: bool) -> _Pending:
        """Render an image again until its pairs fit the capacity."""
        while self._exceeded(image):
            image.readback.release(image.ticket)
            self.repeated += 1
            if not self._replay.fits():
                self._replay.grow()
            image = self._launch(image.view, tail)
        return image

    @staticmethod
    def _exceeded(image: _Pending) -> bool:
        pairs = int(image.readback.wait(image.ticket)[-1:].view(np.int32)[0])
        capacity = image.target.buffers.settings.pair_capacity
        return capacity is not None and pairs > capacity


def on_host(
    render: Callable[[float, Camera], Rendering],
    views: Iterable[View],
    names: Iterable[str],
    *,
    kept: int = KEPT,
) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
    """Images by name as arrays that stay valid, of any renderer; see :meth:`Series.on_host` for a
    replay.

    Args:
        render: A :class:`Replay`, or another function of time [s] and camera.
        views: Time [s] and camera of each image.
        names: Names of the images; those that are absent or empty are left out.
        kept: Images that the caller may keep without copies being made.
    """
    if isinstance(render, Replay):
        yield from Series(render, views).on_host(kept)
        return
    for time, camera in views:
        rendering = render(time, camera)
        images = {name: getattr(rendering, name) for name in names}
        yield {
            name: image.detach().to("cpu", torch.float32, copy=True).numpy()
            for name, image in images.items()
            if image is not None and image.numel()
        }
