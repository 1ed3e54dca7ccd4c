"""Many images of a replay, one after the other, without waiting for any of them.

How many pairs an image needed arrives with it, a few images later. One that did not fit into the reserve is rendered
again with more before it is handed out, so every image is whole, in the order of the views. On a CPU, where there is
nothing to run ahead of, each is rendered when it is asked for.
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

AHEAD = 4  # images that are launched before the first of them is looked at: 1 ms, more than a host is ever late
KEPT = 40  # images on the host that others may hold while the rest goes on without a copy
View = tuple[float, Camera]  # time [s], where from


@dataclass(kw_only=True, eq=False)
class _Sent:
    """An image on its way."""

    view: View
    target: Target
    outgoing: ReadbackRing
    ticket: tuple[int, int]


class Series:
    """The images of a replay from many views; iterate over :meth:`on_host` or :meth:`on_device`."""

    def __init__(self, replay: Replay, views: Iterable[View]):
        """Take note of what to render.

        Args:
            replay: What is rendered.
            views: Time [s] and camera of each image.
        """
        self._replay, self._views = replay, iter(views)
        self.ahead = AHEAD if replay.device.is_cuda else 0
        self.again = 0
        """Images so far that were rendered again, because they needed more pairs than were reserved."""
        self._kept = KEPT
        self._outgoing: dict[int, ReadbackRing] = {}  # by the length of a packed image

    def on_host(self, kept: int = KEPT) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
        """Images by name as arrays on the host, float32: quads [4, H, W], distance [H, W] and so on.

        An array belongs to whoever has it, for as long as he wants: its memory is used again only when nothing refers
        to it or a part of it. Of ``kept`` images at a time that memory is reserved beforehand (of fewer, if they would
        take more than 256 MiB); whoever holds more of them gets the rest as copies in ordinary memory.
        """
        self._kept = kept
        for sent in self._whole(tail=False):
            packed = sent.outgoing.keep(sent.ticket)
            places = sent.target.places
            yield {name: part(packed, *places[name]) for name in places}

    def on_device(self) -> Iterator[Rendering]:
        """Images on the device, which the next step of the iteration may overwrite."""
        if not self.ahead:
            for view in self._views:
                yield self._replay(*view)
            return
        for sent in self._whole(tail=True):
            packed, places = sent.outgoing.on_device(sent.ticket), sent.target.places
            yield self._replay.rendering({name: part(packed, *places[name]) for name in places}, sent.view[1])
            sent.outgoing.release(sent.ticket)

    def _whole(self, *, tail: bool) -> Iterator[_Sent]:
        """Images in order that have arrived, and for which the reserve sufficed."""
        waiting: deque[_Sent] = deque()
        try:
            for view in self._views:
                waiting.append(self._send(view, tail))
                if len(waiting) > self.ahead:
                    yield self._settled(waiting.popleft(), tail)
            while waiting:
                yield self._settled(waiting.popleft(), tail)
        finally:
            for outgoing in self._outgoing.values():
                outgoing.close()

    def _send(self, view: View, tail: bool) -> _Sent:
        target = self._replay.draw(*view)
        length = len(target.packed)
        if length not in self._outgoing:
            few = {"kept": 1, "tail": 1} if tail else {"kept": self._kept}
            self._outgoing[length] = ReadbackRing(target.packed, ahead=self.ahead, **few)
        outgoing = self._outgoing[length]
        return _Sent(view=view, target=target, outgoing=outgoing, ticket=outgoing.copy(target.packed))

    def _settled(self, sent: _Sent, tail: bool) -> _Sent:
        """An image, rendered again until it is whole: once, unless others grow the reserve in between."""
        while self._lacks_pairs(sent):
            sent.outgoing.release(sent.ticket)
            self.again += 1
            if not self._replay.fits():
                self._replay.grow()
            sent = self._send(sent.view, tail)
        return sent

    @staticmethod
    def _lacks_pairs(sent: _Sent) -> bool:
        needed = int(sent.outgoing.wait(sent.ticket)[-1:].view(np.int32)[0])
        reserved = sent.target.frame.settings.pair_capacity
        return reserved is not None and needed > reserved


def on_host(
    render: Callable[[float, Camera], Rendering], views: Iterable[View], names: Iterable[str], *, kept: int = KEPT
) -> Iterator[dict[str, Float[np.ndarray, "..."]]]:
    """Images by name as arrays that stay valid, of whatever renders: see :meth:`Series.on_host` for a replay.

    Args:
        render: A :class:`Replay`, or any other function of time [s] and camera.
        views: Time [s] and camera of each image.
        names: Of what is wanted; an image that is not there, or has no elements, is left out.
        kept: Images that the caller may hold without more of them being copied.
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
