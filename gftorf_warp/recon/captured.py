"""A step as one graph: everything between 'which frames' and 'new parameters' is captured once, and then replayed.

The host writes numbers of frames and keys, shares of the way between keys, and rates into two small tensors, and looks
on: whether a step was finite, and how many (tile, splat) pairs there were, it learns when it asks. What a step computes
is what recon/step.py computes (design/training-step.md); on a CPU it runs without a graph.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..constants import FRAMES_PER_QUARTET
from ..losses.prior import motion_size
from ..render import fused
from ..render.api import Rendering
from ..render.bridge import Branches, Captured, Outbox, pairs_of
from ..render.buffers import RenderSettings, Workspace
from ..scene.motion import Still
from . import densify
from .objective import flow_between, image_loss, render_settings_at, rendering_of, weights_at
from .observations import Observations
from .optimiser import BETAS, EPSILON, frozen, rates_at
from .padded import Padded
from .settings import Kernels, ReconSettings, Weights
from .state import State
from .step import SEED_MASK, Map, Singles, densify_after, draw

LOG = logging.getLogger("gftorf_warp")
HEAD = 4  # numbers before those of the images: this key, the next, the one before, the quartet
PER_IMAGE = 3  # numbers of an image: raw frame, seed and number of its background
ROOM = 1.5  # pairs that are reserved, over the most that were seen
PAIRS = 1 << 16  # in such numbers
FULL, EMPTY = 0.85, 0.4  # shares of that reserve at which another one is made


def unsuitable(observations: Observations, settings: ReconSettings, state: State) -> str | None:
    """Why the steps of a run cannot be graphs, in words; None if they can."""
    first = observations.cameras[0]
    if observations.phasors or settings.weights.quads == 0:
        return "phasors are compared, not quads"
    if settings.weights.colour > 0 or settings.weights.depth > 0:
        return "colour or closed-form distance is compared"
    if any((camera.camera_from_world != first.camera_from_world).any() for camera in observations.cameras):
        return "the camera moves"
    if not isinstance(state.motion, Still) and any(
        state.motion.position(observations.time_at(frame))[0] != frame // FRAMES_PER_QUARTET
        for batch in observations.batches
        for frame in batch
    ):
        return "raw frames lie outside the time of their quartet"
    return None


def steps_of(
    state: State, observations: Observations, settings: ReconSettings, run_all: Map = map
) -> Singles | CapturedSteps:
    """The steps of a run, as its settings want them; ``run_all`` is for those that are no graphs."""
    if settings.kernels == Kernels.GRAPH:
        why = unsuitable(observations, settings, state)
        if why is None:
            return CapturedSteps(state, observations, settings)
        LOG.info("steps are no graphs: %s", why)
    return Singles(state, observations, settings, run_all)


@dataclass(frozen=True)
class Variant:
    """What decides which operations a step consists of."""

    shifts: tuple[float, ...]
    """Phase shift of each image [rad]."""
    moves: bool
    """Whether Gaussians are displaced."""
    flow: bool
    """Whether the first image is compared with optical flow, too."""
    rests: bool
    """Whether the Gaussians are frozen."""
    weights: Weights
    """Of the terms."""
    sh_degree: int
    """Of the harmonics."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    """One image of a batch."""

    terms: dict[str, Tensor]
    """Weighted terms of its loss."""
    tof: Rendering
    """What was compared."""
    squared: Tensor
    """Mean squared difference [squared quad units]."""
    opacity: Tensor
    """Mean opacity [1]."""


class CapturedSteps:
    """The steps of one run. Between two steps the state is as single steps leave it, but for what is on its way."""

    def __init__(self, state: State, observations: Observations, settings: ReconSettings):
        self.observations, self.settings = observations, settings
        device = observations.quads.device
        self.state, self.padded = state, Padded()
        self._graphs: dict[Variant, Callable[[], None]] = {}
        self._capacity: int | None = None
        self._reserves = device.type != "cpu"  # a CPU counts pairs first: nobody waits for anybody there
        self._sums: dict[str, Tensor] = {}
        self._counts = torch.zeros(3, dtype=torch.int32, device=device)  # failed, in a row, most pairs of an image
        longest = max(len(batch) for batch in observations.batches)
        self._images = longest
        self._numbers = Outbox(HEAD + PER_IMAGE * longest, torch.int32, device)
        leaves = len(state.optimiser.leaves)
        self._values = Outbox(leaves + longest, torch.float32, device)
        self._groups = [*state.optimiser.tensors] + ["motion"] * len(state.optimiser.motion)
        self._flow = self._resident_flow()
        self._branches = Branches(longest, device)
        self._workspaces = [Workspace() for _ in range(longest)]
        self._adopt()

    def step(self) -> None:
        """Advance the state by one batch; what is due after it is done, as after a single step."""
        state, settings = self.state, self.settings
        frames = draw(state, self.observations, settings)
        before, state.images = state.images, state.images + len(frames)
        variant = self._variant(frames, before)
        rates = rates_at(settings, before, state.rate_factor, reset_at=state.reset_at)
        due = densify.round_is_due(before, state.images, settings.densify, settings.schedule)
        if due and settings.densify.loses_step:
            rates = {name: rate if name == "motion" else 0.0 for name, rate in rates.items()}
        self._write(frames, before, rates)
        run = self._graphs.get(variant)
        if run is None:  # the first one is done without a graph: libraries wake up, sizes become known
            self._body(variant)
            if self._capacity is None:
                self._look()
            self._graphs[variant] = Captured(lambda: self._body(variant), self.observations.quads.device)
        else:
            run()
        densify_after(state, before, settings)
        if due or not self.padded.holds(state):
            self._look()
            self._adopt()

    def collect(self) -> int:
        """Bring sums and counts of the steps so far into the state; waits for the device.

        Returns:
            How many steps in a row, up to the last one, were not finite and changed nothing.
        """
        for name, room in self._sums.items():
            value = self.state.sums.get(name)
            self.state.sums[name] = room.clone() if value is None else value + room
            room.zero_()
        return self._look()

    def _look(self) -> int:
        """Steps in a row that failed; makes more or less room for pairs where that is due."""
        failed, in_a_row, pairs = self._counts.tolist()
        self.state.skipped += failed
        if failed:
            LOG.warning("%d steps before image %d skipped, not finite or of too many splats", failed, self.state.images)
        self._counts[0] = 0
        self._counts[2] = 0
        if pairs and (self._capacity is None or not EMPTY < pairs / self._capacity < FULL):
            self._capacity = math.ceil(ROOM * pairs / PAIRS) * PAIRS
            self._graphs.clear()
        return in_a_row

    def _adopt(self) -> None:
        if self.padded.adopt(self.state):
            self._graphs.clear()

    # -- what the host says --------------------------------------------------------------------------------------------

    def _variant(self, frames: list[int], images: int) -> Variant:
        weights = weights_at(self.settings, images)
        moves = images >= self.settings.schedule.warm_up
        return Variant(
            shifts=tuple(float(self.observations.sequence.shifts[frame]) for frame in frames),
            moves=moves,
            flow=moves and weights.flow > 0 and self._flow is not None and frames[0] % FRAMES_PER_QUARTET == 0,
            rests=frozen(self.settings, images),
            weights=weights,
            sh_degree=render_settings_at(self.settings, images).sh_degree,
        )

    def _write(self, frames: list[int], images: int, rates: dict[str, float]) -> None:
        """Send what the next step has to know; the device need not be asked for anything."""
        quartet = frames[0] // FRAMES_PER_QUARTET
        numbers = [quartet, quartet + 1, max(quartet - 1, 0), quartet]
        seed = self.state.noise.initial_seed() & SEED_MASK
        for n, frame in enumerate(frames):
            numbers += [frame, seed, images + n]
        motion, times = self.state.motion, [self.observations.time_at(frame) for frame in frames]
        shares = [0.0 if isinstance(motion, Still) else motion.position(time)[1] for time in times]
        self._numbers.send(numbers)
        self._values.send([rates[name] for name in self._groups] + shares)

    # -- what the device does ------------------------------------------------------------------------------------------

    def _body(self, variant: Variant) -> None:
        """One step, from the numbers that were sent to new parameters; nothing is read back."""
        padded = self.padded
        numbers, motion, count = self._numbers.there, self.state.motion, len(variant.shifts)
        field = padded.field
        if variant.rests:
            field = field.map(torch.Tensor.detach)
        field = field.map(lambda tensor: tensor.view_as(tensor))  # gradients of all branches meet on this stream
        offsets: Tensor | None = None
        if variant.moves:
            attachment = motion.attach(field) if motion.follows_means else padded.attachment
            offsets = motion.key_offsets(attachment, numbers[: 3 if variant.flow else 2])
        render = replace(self.settings.render, sh_degree=variant.sh_degree, pair_capacity=self._capacity)
        found: dict[str, Tensor] = {}
        images = []
        for n in range(count):
            with self._branches.fork(n):
                images.append(self._image(variant, n, field, offsets, render))
        self._branches.join()
        for image in images:
            for name, value in image.terms.items():
                found[name] = found[name] + value if name in found else value
        loss = torch.stack([*found.values()]).sum()
        first = len(padded.values) if variant.rests else 0
        wanted = padded.leaves[first:]
        gradients = torch.autograd.grad(loss, wanted, allow_unused=True) if loss.requires_grad else []
        with torch.no_grad():
            self._descend(gradients, loss.detach(), count)
            sound = self._counts[1:2] == 0
            rows = {name: value.detach() for name, value in found.items()}
            rows |= {"loss": loss.detach(), "quad_mse": torch.stack([image.squared for image in images]).sum()}
            opacity = torch.stack([image.opacity for image in images]).sum()
            self._account(rows | {"opacity": opacity, "count": torch.full_like(loss, count)}, sound)
            for image in images:
                if image.tof.screen is not None:
                    self._observe(image.tof.screen, sound)

    def _image(self, variant: Variant, n: int, field, offsets: Tensor | None, render: RenderSettings) -> _Image:
        """One image of the batch, compared."""
        settings, weights = self.settings, variant.weights
        numbers, share = self._numbers.there[HEAD + PER_IMAGE * n :], self._values.there[len(self._groups) + n]
        moved, displacement, lights = field, None, {}
        if offsets is not None:
            displacement = torch.lerp(offsets[0], offsets[1], share)
            moved = field.moved(displacement)
        if settings.background > 0:
            shape = (1, *self.observations.quads.shape[1:])
            lights["quads"] = fused.uniform(shape, numbers[1:3], settings.background)
        sensor = self.observations.sensor.with_shifts(variant.shifts[n : n + 1])
        camera, flows = self.observations.cameras[0], []
        if variant.flow and n == 0 and offsets is not None:
            flows = [offset - offsets[0] for offset in offsets[1:]]
        tof = rendering_of(
            moved, camera, sensor, settings, render, weights, lights, flows=flows, workspace=self._workspaces[n]
        )
        measured = self.observations.quads.index_select(0, numbers[:1])
        loss, squared = image_loss(tof.quads, measured, weights.ssim, kernel=True)
        terms = {"quads": weights.quads * loss}
        if weights.distortion > 0:
            terms["distortion"] = weights.distortion * tof.distortion.mean()
        if weights.motion_size > 0 and displacement is not None:
            terms["motion_size"] = weights.motion_size * motion_size(displacement).mean()
        if flows:  # both directions: what is unknown counts zero
            assert self._flow is not None
            assert tof.extra is not None
            measured = self._flow.index_select(0, self._numbers.there[3:4])[0]
            rays = self.observations.rays_at(0)
            flow = flow_between(tof.distance, tof.extra, list(measured), camera, [camera, camera], rays)
            terms["flow"] = weights.flow * flow
        return _Image(terms=terms, tof=tof, squared=squared, opacity=tof.opacity.detach().mean())

    def _descend(self, gradients, loss: Tensor, images: int) -> None:
        """Adam, if everything is finite and no pair was dropped; counts what happened."""
        padded, settings = self.padded, self.settings
        absent = padded.write_gradients(gradients)
        if images > 1:  # not the loss: densification looks at the gradients of single images
            torch._foreach_mul_(padded.gradients, 1.0 / images)
        norm = torch.nn.utils.get_total_norm(padded.gradients)
        sound = (loss + norm).isfinite().reshape(1)
        if self._reserves:
            most = torch.cat([pairs_of(workspace) for workspace in self._workspaces[:images]]).amax().reshape(1)
            self._counts[2:] = torch.maximum(self._counts[2:], most)
            if self._capacity is not None:
                sound &= most <= self._capacity
        failed = (~sound).to(torch.int32)
        self._counts[:1] += failed
        self._counts[1:2] = (self._counts[1:2] + 1) * failed
        of_motion = padded.gradients[len(padded.values) :]
        if of_motion and settings.motion_gradient_max is not None:
            _shorten(of_motion, settings.motion_gradient_max)
        rates = self._values.there[: len(self._groups)]
        for n in absent:  # what has no gradient is left alone, as torch's Adam does
            rates[n : n + 1].zero_()
        assert padded.table is not None
        fused.adam_step(padded.table, rates, sound.to(torch.int32), betas=BETAS, epsilon=EPSILON)

    def _account(self, rows: dict[str, Tensor], sound: Tensor) -> None:
        """Add to the sums of the log what a sound step found."""
        for name in rows.keys() - self._sums.keys():
            self._sums[name] = torch.zeros_like(rows[name])
        names = list(rows)
        values = torch.where(sound, torch.stack([rows[name] for name in names]), 0.0)
        torch._foreach_add_([self._sums[name] for name in names], list(values.unbind()))

    def _observe(self, screen, sound: Tensor) -> None:
        """Add to what densification looks at."""
        before = self.padded.statistics
        after = densify.observe(before, screen, self.observations.cameras[0])
        before.gradient.copy_(torch.where(sound, after.gradient, before.gradient))
        before.pixels.copy_(torch.where(sound, after.pixels, before.pixels))

    def _resident_flow(self) -> Tensor | None:
        """[quartets, 2, 2, H, W] px to the next quartet and to the one before; NaN where there is none."""
        flows = self.observations.flow
        if not flows or self.settings.weights.flow == 0:
            return None
        quads = self.observations.quads
        count = -(-len(quads) // FRAMES_PER_QUARTET)
        room = torch.full((count, 2, 2, *quads.shape[1:]), float("nan"), device=quads.device)
        for (quartet, step), flow in flows.items():
            room[quartet, 0 if step == 1 else 1] = flow
        return room


def _shorten(gradients: list[Tensor], longest: float) -> None:
    """As torch.nn.utils.clip_grad_norm_ does it, on gradients themselves."""
    norm = torch.nn.utils.get_total_norm(gradients)
    torch._foreach_mul_(gradients, (longest / (norm + 1e-6)).clamp(max=1.0))
