"""One training step on the device: render a batch, evaluate the terms of the loss, descend.

Runs eagerly on a CPU and is captured as a CUDA graph on a GPU: it reads nothing back and takes
everything that changes from step to step from the control block.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from ..render import descent, fused
from ..render.api import ScreenGradient
from ..render.buffers import RenderSettings
from ..render.cuda import SideStreams
from ..scene.motion import KeyMotion, Motion
from .control import ControlBlock
from .keys import GraphKey, ImageKey
from .observations import Observations
from .optimiser import EPSILON, field_of
from .padded import PaddedParameters
from .renderings import Renderer, primary
from .rows import AllRows, RenderedRows, add_statistics, rendered_rows
from .settings import ReconSettings
from .terms import BatchImage, Term

Map = Callable[[Callable[[int], "ImageGradients"], Iterable[int]], Iterable["ImageGradients"]]


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageGradients:
    """Gradients of the weighted terms of one image."""

    values: list[Tensor | None]
    """With respect to the tensors of the field; None: zero."""
    motion: list[Tensor | None]
    """With respect to offsets and rotations at all keys."""
    screen: ScreenGradient | None
    """Of the rendering that densification is based on."""
    pairs: list[Tensor]
    """(tile, splat) pairs [1] of every rendering."""


class Step:
    """The operations of a step, for any key."""

    def __init__(
        self,
        observations: Observations,
        settings: ReconSettings,
        terms: Sequence[Term],
        control: ControlBlock,
        padded: PaddedParameters,
        betas: tuple[float, float],
    ):
        """Allocate what all steps share.

        Args:
            observations: What is compared.
            settings: Of the run.
            terms: All terms of the loss.
            control: What differs between steps.
            padded: Parameters and moments.
            betas: Decays of the moments of Adam.
        """
        self.observations, self.settings, self.terms = observations, settings, tuple(terms)
        self.control, self.padded, self.betas = control, padded, betas
        device = observations.quads.device
        self.output = descent.StepResults.empty(control.images, len(self.terms), device)
        """Results and sums on the device."""
        self._streams = SideStreams(control.images, device)
        self._scratch: defaultdict[tuple[int, str], fused.Scratch] = defaultdict(fused.Scratch)
        self._all_rows = AllRows()
        self.renderer = Renderer(observations, settings, self.terms)
        """Renders the images."""

    def run(
        self,
        key: GraphKey,
        motion: Motion,
        render: RenderSettings,
        table: descent.AdamTable,
        send: Callable[[], None] | None,
        map_images: Map = map,
    ) -> None:
        """One step, from the control block to new parameters.

        Args:
            key: Which operations.
            motion: The motion model.
            render: Renderer settings.
            table: Addresses of parameters and moments; gets those of the gradients.
            send: Uploads them; None: the caller does, after a capture.
            map_images: ``map``, or that of a thread pool: images are independent.
        """
        keys = self.control.keys(key.keys)
        rendered = rendered_rows(self.padded, motion, keys)
        key_motion = motion_at_keys(motion, rendered, keys, frozen=key.frozen)

        def image(n: int) -> ImageGradients:
            with self._streams.fork(n):
                return self._image(n, key, rendered, key_motion, render)

        images = [*map_images(image, range(len(key.images)))]
        self._streams.join()
        lists = gradient_lists(self.padded, rendered, key_motion, images, self._all_rows)
        with torch.no_grad():
            table.point(lists, [count for image in images for count in image.pairs])
            if send is not None:
                send()
            descent.descend(
                table,
                self.control.rates,
                self.output,
                self.control.weights.flatten(1),
                self.control.compared,
                images=len(images),
                motion_from=len(self.padded.values),
                motion_gradient_max=self.settings.motion_gradient_max,
                capacity=render.pair_capacity,
                betas=self.betas,
                epsilon=EPSILON,
            )
            if self.settings.scale_max is not None:
                self.padded.values["log_scale"].clamp_(max=math.log(self.settings.scale_max))
            screens = [image.screen for image in images if image.screen is not None]
            if screens:
                camera = self.renderer.cameras[primary(key.images[0])]
                size = camera.width, camera.height
                add_statistics(self.padded.statistics, rendered, screens, size, self.output)

    def _image(
        self,
        n: int,
        key: GraphKey,
        rendered: RenderedRows,
        key_motion: KeyMotion | None,
        render: RenderSettings,
    ) -> ImageGradients:
        """Render one image, evaluate its terms, and differentiate them,
        independently of other images.
        """
        image, control = key.images[n], self.control.image(n, key)
        values = {
            name: value.detach().requires_grad_(not key.frozen)
            for name, value in rendered.values.items()
        }
        field, leaf = field_of(values, rendered.layer), None
        if key_motion is not None:
            offset, rotation = key_motion
            leaf = KeyMotion(_leaf_of(offset), None if rotation is None else _leaf_of(rotation))
        renderings, moved = self.renderer.render(n, image, field, leaf, control, render)
        batch_image = BatchImage(
            observations=self.observations,
            settings=self.settings,
            renderings=renderings,
            rows=control.rows,
            mean=field.mean,
            moved=moved,
            mean_weight=rendered.mean_weight,
            flow_cameras=control.flow_cameras,
            scratch=lambda name: self._scratch[n, name],
        )
        leaves = [*values.values(), *(t for t in leaf or () if t is not None)]
        gradients = self._gradients(n, image, batch_image, leaves)
        based_on = renderings.get(primary(image))
        return ImageGradients(
            values=gradients[: len(values)],
            motion=gradients[len(values) :],
            screen=None if based_on is None else based_on.screen,
            pairs=self.renderer.pairs(n, image),
        )

    def _gradients(
        self, n: int, image: ImageKey, batch_image: BatchImage, leaves: list[Tensor]
    ) -> list[Tensor | None]:
        """Gradients of the weighted terms of one image; the results of the terms are stored."""
        values, weights = [], []
        results = self.output.results.view(-1, len(self.terms), self.control.weights.shape[-1])
        for k, term in enumerate(self.terms):
            if term.name not in image.terms:
                continue
            value = term.loss(batch_image, results[n, k])
            if value.data_ptr() != results[n, k].data_ptr():
                # .data: other rows are part of a graph by now
                results.data[n, k, 0] = value.detach()
            if value.requires_grad:
                values.append(value)
                weights.append(self.control.weights[n, k, 0])
        return _gradients_of(values, weights, leaves)


def motion_at_keys(
    motion: Motion, rendered: RenderedRows, keys: Int[Tensor, "K"], *, frozen: bool
) -> KeyMotion | None:
    """Motion at all keys of the batch, evaluated once; None: nothing moves yet."""
    if not len(keys):
        return None
    binding = rendered.binding
    if motion.follows_means and not frozen:
        binding = motion.bind(rendered.field)
    return motion.at_keys(binding, keys)


def gradient_lists(
    padded: PaddedParameters,
    rendered: RenderedRows,
    key_motion: KeyMotion | None,
    images: list[ImageGradients],
    all_rows: AllRows,
) -> list[list[Tensor | None]]:
    """Gradients of all leaves as few enough lists, which Adam sums up; where some rows were
    rendered, as one list in the memory of ``all_rows``.
    """
    of_values, of_motion = _back_through_motion(padded, rendered, key_motion, images)
    if rendered.rows is not None:
        each = zip(*(image.values for image in images), of_values, strict=True)
        total = all_rows.of([fused.added(same) for same in each], padded, rendered.rows)
        return [[*total, *of_motion]]
    none: list[Tensor | None] = [None] * len(padded.motion)
    first, *others = [image.values for image in images]
    lists = [[*first, *of_motion], *([*values, *none] for values in others)]
    if any(gradient is not None for gradient in of_values):
        lists.append([*of_values, *none])
    last = descent.GRADIENTS - 1
    if len(lists) > descent.GRADIENTS:
        lists[last:] = [[fused.added(same) for same in zip(*lists[last:], strict=True)]]
    return lists


def _back_through_motion(
    padded: PaddedParameters,
    rendered: RenderedRows,
    key_motion: KeyMotion | None,
    images: list[ImageGradients],
) -> tuple[list[Tensor | None], list[Tensor | None]]:
    """Gradients of the field and of the motion parameters through the motion,
    for all images at once.
    """
    values = [*rendered.values.values()]
    shared = [t for t in key_motion or () if t is not None]
    pairs = [
        (total, tensor)
        for tensor, *given in zip(shared, *(image.motion for image in images), strict=True)
        if tensor.requires_grad and (total := fused.added(given)) is not None
    ]
    totals, tensors = [total for total, _ in pairs], [tensor for _, tensor in pairs]
    gradients = _gradients_of(tensors, totals, [*values, *padded.motion])
    return gradients[: len(values)], gradients[len(values) :]


def _leaf_of(tensor: Tensor) -> Tensor:
    """The same values as a leaf."""
    return tensor.detach().requires_grad_(tensor.requires_grad)


def _gradients_of(
    values: list[Tensor], cotangents: list[Tensor], leaves: list[Tensor]
) -> list[Tensor | None]:
    """Contiguous gradients of leaves through values; None: zero, or the leaf needs none."""
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    if not values or not wanted:
        return [None] * len(leaves)
    loss = fused.sum_for_gradients(cotangents, values)
    computed = iter(torch.autograd.grad(loss, wanted, allow_unused=True))
    gradients = [next(computed) if leaf.requires_grad else None for leaf in leaves]
    return [None if gradient is None else gradient.contiguous() for gradient in gradients]
