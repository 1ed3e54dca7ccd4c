"""What decides which operations a step consists of: steps of one key share a CUDA graph."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from .blending import Blending
from .observations import Observations
from .terms import Term, View


@dataclass(frozen=True, kw_only=True)
class ImageKey:
    """One image of a batch, as far as it decides which operations a step consists of."""

    terms: tuple[str, ...]
    """Names of its terms."""
    views: frozenset[View]
    """What is rendered. Flow at the time of the ToF image comes with that rendering."""
    flow_terms: tuple[str, ...] = ()
    """Names of the terms that read the flow, which not every image has."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GraphKey:
    """What decides which operations a step consists of: steps of one key share a CUDA graph.

    Keys are compared by identity: :class:`GraphKeys` makes one object for equal values.
    """

    images: tuple[ImageKey, ...]
    """The images of the batch."""
    keys: int
    """Number of motion keys that are evaluated; 0: nothing moves."""
    frozen: bool
    """Whether only the motion is optimised."""
    sh_degree: int
    """Degree of the harmonics."""

    @cached_property
    def terms(self) -> frozenset[str]:
        """Names of all terms that every batch has."""
        return frozenset(
            n for image in self.images for n in image.terms if n not in image.flow_terms
        )

    @cached_property
    def has_flow(self) -> bool:
        """Whether any image has a term that reads the flow."""
        return any(image.flow_terms for image in self.images)

    @cached_property
    def stage(self) -> tuple[object, ...]:
        """Equal for keys that alternate. When it changes, earlier graphs are not needed again."""
        return self.keys > 0, self.frozen, self.sh_degree, self.terms


class GraphKeys:
    """The keys of one run; one object for equal values."""

    def __init__(self, observations: Observations, terms: Sequence[Term], blending: Blending):
        """No keys yet.

        Args:
            observations: What is compared.
            terms: All terms of the loss.
            blending: Times and motion keys of the images.
        """
        self._observations, self._terms, self._blending = observations, terms, blending
        self._keys: dict[tuple, GraphKey] = {}

    def of(
        self,
        frames: list[int],
        weights: tuple[float, ...],
        *,
        moves: bool,
        frozen: bool,
        sh_degree: int,
    ) -> GraphKey:
        """The key of a step of some raw frames with these weights of the terms."""
        active = tuple(
            w > 0 and (moves or not t.needs_motion)
            for t, w in zip(self._terms, weights, strict=True)
        )
        name = (*frames, active, moves, frozen, sh_degree)
        if name not in self._keys:
            terms = list(itertools.compress(self._terms, active))
            images = tuple(self._image_key(frame, terms) for frame in frames)
            keys = self._blending.counts[any(image.flow_terms for image in images)] if moves else 0
            values = images, keys, frozen, sh_degree
            if values not in self._keys:
                self._keys[values] = GraphKey(
                    images=images, keys=keys, frozen=frozen, sh_degree=sh_degree
                )
            self._keys[name] = self._keys[values]
        return self._keys[name]

    def _image_key(self, frame: int, active: list[Term]) -> ImageKey:
        terms = [term for term in active if term.applies(self._observations, frame)]
        views = {term.view for term in terms if term.view is not None}
        tof, flow = (self._blending.time_of(view, frame) for view in (View.TOF, View.FLOW))
        if {View.TOF, View.FLOW} <= views and tof == flow:
            views.remove(View.FLOW)
        return ImageKey(
            terms=tuple(term.name for term in terms),
            views=frozenset(views),
            flow_terms=tuple(term.name for term in terms if term.view == View.FLOW),
        )
