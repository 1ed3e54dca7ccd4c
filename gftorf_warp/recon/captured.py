"""A step as one graph: everything between 'which frames' and 'new parameters' is captured once, and then replayed.

The host writes numbers of frames and keys, shares of the way between keys, and rates into two small tensors, and looks
on: whether a step was finite, and how many (tile, splat) pairs there were, it learns when it asks. What a step computes
is what recon/step.py computes (design/training-step.md); on a CPU it runs without a graph.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..constants import FRAMES_PER_QUARTET
from ..losses.prior import motion_size
from ..render import descent, fused, perceptron
from ..render.api import Rendering
from ..render.bridge import pairs_of
from ..render.buffers import RenderSettings, Workspace
from ..render.cuda import CapturedGraph, DeviceReadback, DeviceUpload, SideStreams, graph_pool
from ..render.pair_capacity import READ_EVERY, PairCapacity
from ..scene.motion import Still
from ..scene.network import Network
from . import densify
from .objective import image_loss, render_settings_at, rendering_of, weights_at
from .observations import Observations
from .optimiser import EPSILON, frozen, rates_at
from .padded import Padded
from .settings import Kernels, ReconSettings
from .state import State
from .step import SEED_MASK, Map, Singles, densify_after, draw
from .variant import Image, Variant

LOG = logging.getLogger("gftorf_warp")
HEAD = 4  # numbers before those of the images: this key, the next, the one before, the quartet
PER_IMAGE = 3  # numbers of an image: raw frame, seed and number of its background
ROW = {name: n for n, name in enumerate(descent.FOUND_NAMES)}


def unsuitable(observations: Observations, settings: ReconSettings, state: State) -> str | None:
    """Why the steps of a run cannot be graphs, in words; None if they can."""
    first = observations.cameras[0]
    if observations.phasors or settings.weights.quads == 0:
        return "phasors are compared, not quads"
    sequence = observations.sequence
    if sequence.cycle != FRAMES_PER_QUARTET or len(sequence.frequencies) > 1:
        return f"a cycle has {sequence.cycle} raw frames at {len(sequence.frequencies)} modulation frequencies"
    if settings.weights.colour > 0 or settings.weights.depth > 0:
        return "colour or closed-form distance is compared"
    if any((camera.camera_from_world != first.camera_from_world).any() for camera in observations.cameras):
        return "the camera moves"
    if not isinstance(state.motion, Still) and any(
        state.motion.interval(observations.time_at(frame))[0] != frame // FRAMES_PER_QUARTET
        for batch in observations.batches
        for frame in batch
    ):
        return "raw frames lie outside the time of their quartet"
    return None


def steps_of(
    state: State, observations: Observations, settings: ReconSettings, run_all: Map = map
) -> Singles | CapturedSteps:
    """The steps of a run, as its settings want them; ``run_all`` is for those that are no graphs."""
    on_gpu = observations.quads.device.type != "cpu"
    if settings.kernels == Kernels.GRAPH or (settings.kernels == Kernels.AUTO and on_gpu):
        why = unsuitable(observations, settings, state)
        if why is None:
            return CapturedSteps(state, observations, settings)
        LOG.info("steps are no graphs: %s", why)
    return Singles(state, observations, settings, run_all)


class CapturedSteps:
    """The steps of one run. Between two steps the state is as single steps leave it, but for what is on its way."""

    def __init__(self, state: State, observations: Observations, settings: ReconSettings, *, graphs: bool = True):
        """Take over a state.

        Args:
            state: Advanced in place.
            observations: What it is fitted to; see :func:`unsuitable`.
            settings: How.
            graphs: Whether steps are captured; otherwise a GPU does the same work operation by operation.
        """
        self.observations, self.settings = observations, settings
        device = observations.quads.device
        self.state, self.padded = state, Padded()
        self._graphs: dict[Variant, Callable[[], None]] = {}
        self._part: tuple | None = None  # of the run: what graphs that are kept have in common
        self._steps = 0  # since rooms were last looked at
        self._pool = graph_pool(device)
        self._reserve = PairCapacity()
        self._reserves = device.type != "cpu"  # a CPU counts pairs first: nobody waits for anybody there
        longest = max(len(batch) for batch in observations.batches)
        self._graphs_wanted = graphs
        self._ledger = descent.Ledger.empty(longest, device)
        self._inbox, self._replays = DeviceReadback(self._ledger.counts), 0
        self._summed: set[str] = set()  # names of sums that a step has added to
        self._ones: dict[float, Tensor] = {}
        self._scratch = [fused.Scratch() for _ in range(longest)]
        numbers, values = HEAD + PER_IMAGE * longest, len(state.optimiser.leaves) + longest
        self._outbox = DeviceUpload([(numbers, torch.int32), (values, torch.float32)], device)
        self._numbers, self._values = self._outbox.parts
        self._groups = [*state.optimiser.tensors] + ["motion"] * len(state.optimiser.motion)
        self._flow = observations.flow_table() if settings.weights.flow > 0 else None
        self._branches = SideStreams(longest, device)
        self._workspaces = [Workspace() for _ in range(longest)]
        motion = state.motion
        if isinstance(motion, Network) and perceptron.fits(motion.form, device):
            motion.go_by(perceptron.TensorCores())
        self._adopt()

    def step(self) -> None:
        """Advance the state by one batch; what is due after it is done, as after a single step."""
        state, settings = self.state, self.settings
        frames = draw(state, self.observations, settings)
        before, state.images = state.images, state.images + len(frames)
        variant = self._variant(frames, before)
        self._enter(variant)
        rates = rates_at(settings, before, state.rate_factor, reset_at=state.reset_at, revived_at=state.revived_at)
        due = densify.round_is_due(before, state.images, settings.densify, settings.schedule)
        if due and settings.densify.loses_step:
            rates = {name: rate if name == "motion" else 0.0 for name, rate in rates.items()}
        self._write(frames, before, rates)
        run = self._graphs.get(variant)
        if run is None:  # the first one is done without a graph: libraries wake up, sizes become known
            table = self.padded.table()
            self._body(variant, table, table.send)
            if self._reserve.pairs is None:
                self._look()
            self._graphs[variant] = self._captured(variant, table)
        else:
            run()
            self._watch()
        self._steps += 1
        densify_after(state, self.observations, before, settings)
        if due or not self.padded.holds(state):
            self._look()
            self._adopt()

    def _enter(self, variant: Variant) -> None:
        """Let go of graphs of a part of the run that is over, and prepare what rests in the one that begins."""
        others = replace(variant.weights, flow=0.0)  # flow comes and goes, ``Schedule.flow_every``
        part = variant.moves, variant.rests, others, variant.sh_degree
        if part == self._part:
            return
        if self._graphs:
            self._look()  # waits: memory of a graph must not be given to anybody before it has run
            self._forget()
        self._part = part
        self._adopt(free=True)

    def _forget(self) -> None:
        """Let go of all graphs, and of the memory that they shared: it is gone with the last of them."""
        self._graphs.clear()
        self._pool = graph_pool(self.observations.quads.device)

    def _rest(self, rests: bool) -> None:
        """Ask the motion once where Gaussians hang on it, if they will not move any more."""
        motion, padded = self.state.motion, self.padded
        if rests and motion.follows_means:
            padded.attachment.copy_(motion.attach(padded.field.map(torch.Tensor.detach)))

    def _captured(self, variant: Variant, table: descent.AdamTable) -> Callable[[], None]:
        """A step of this kind; its gradients lie where the capture puts them, which the table learns after it."""

        def ready() -> None:
            table.send()
            table.release()

        device = self.observations.quads.device
        if device.type == "cpu" or not self._graphs_wanted:
            return lambda: self._body(variant, table, table.send)
        return CapturedGraph(lambda: self._body(variant, table, None), device, ready, self._pool)

    def collect(self) -> int:
        """Bring sums and counts of the steps so far into the state; waits for the device.

        Returns:
            How many steps in a row, up to the last one, were not finite and changed nothing.
        """
        found = dict(zip(descent.SUM_NAMES, self._ledger.sums.clone(), strict=True))
        for name in descent.SUM_NAMES:
            if name in self._summed:
                value = self.state.sums.get(name)
                self.state.sums[name] = found[name] if value is None else value + found[name]
        self._ledger.sums.zero_()
        return self._look()

    def _look(self) -> int:
        """Steps in a row that failed; makes more or less room for pairs where that is due."""
        counts = self._ledger.counts
        failed, in_a_row, pairs, overfull = counts.tolist()
        self.state.skipped += failed
        if failed:
            text = "%d steps before image %d skipped: %d of too many (tile, splat) pairs, the others not finite"
            LOG.warning(text, failed, self.state.images, overfull)
        counts[0] = 0
        counts[2:] = 0
        if self._reserve.learn(pairs, is_sorted=pairs > 0 and not self._workspaces[0].last.marks):
            self._forget()
        return 0 if overfull else in_a_row

    def _watch(self) -> None:
        """Make room for pairs before they need it: numbers of a few steps ago say so, and nobody waits for them."""
        self._replays += 1
        if self._replays % READ_EVERY == 0:
            self._inbox.request()
        seen = self._inbox.latest(wait=self.settings.render.deterministic)  # when they arrive depends on the machine
        if seen is not None and self._reserve.is_nearly_full(seen[2]):
            self._look()

    def _adopt(self, *, free: bool = False) -> None:
        state, settings = self.state, self.settings
        grows = densify.rounds_remain(state.images, settings.densify, settings.schedule)
        if self.padded.adopt(state, steps=self._steps, free=free, grows=grows):
            self._forget()
        self._steps = 0
        if self._part is not None:
            self._rest(self._part[1])

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
        shares = [0.0 if isinstance(motion, Still) else motion.interval(time)[1] for time in times]
        self._outbox.send(numbers, [rates[name] for name in self._groups] + shares)

    # -- what the device does ------------------------------------------------------------------------------------------

    def _body(self, variant: Variant, table: descent.AdamTable, send: Callable[[], None] | None) -> None:
        """One step, from the numbers that were sent to new parameters; nothing is read back.

        Args:
            variant: Of which operations it consists.
            table: Where its tensors lie; learns where its gradients do.
            send: What tells the device so; None: that comes later.
        """
        padded, numbers, motion = self.padded, self._numbers, self.state.motion
        field = padded.field
        offsets: Tensor | None = None
        if variant.moves:
            asked = motion.follows_means and not variant.rests
            attachment = motion.attach(field) if asked else padded.attachment
            offsets = motion.at_keys(attachment, numbers[: 3 if variant.flow else 2]).offset
        render = replace(self.settings.render, sh_degree=variant.sh_degree, pair_capacity=self._reserve.pairs)
        for name in descent.FOUND_NAMES:  # here, not on a branch, of which no other knows how far it is
            self._one_times(getattr(variant.weights, name, 1.0))
        images = []
        for n in range(len(variant.shifts)):  # none waits for another before all of them know their gradients
            with self._branches.fork(n):
                images.append(self._image(variant, n, offsets, render))
        self._branches.join()
        of_motion = self._motion_gradients(offsets, images)
        with torch.no_grad():
            first, *others = [image.gradients[:-1] for image in images]
            table.point([*first, *of_motion], *([*other, *(None for _ in of_motion)] for other in others))
            if send is not None:
                send()
            self._descend(variant, table, {name for image in images for name in image.terms})
            screens = [image.tof.screen for image in images if image.tof.screen is not None]
            if screens:
                camera, statistics = self.observations.cameras[0], padded.statistics
                size = camera.width, camera.height
                sums = statistics.gradient, statistics.pixels, statistics.weight
                descent.observe(screens, size, self._ledger, *sums)

    def _image(self, variant: Variant, n: int, offsets: Tensor | None, render: RenderSettings) -> Image:
        """One image of the batch, compared, and its gradients by copies of what all images share."""
        settings, weights = self.settings, variant.weights
        numbers, first = self._numbers[HEAD + PER_IMAGE * n :], len(self._groups) + n
        field = self.padded.field.map(torch.Tensor.detach)
        values = [getattr(field, name).requires_grad_(not variant.rests) for name in self.padded.values]
        moved, flows, lights = field, None, {}
        if offsets is not None:
            offsets = offsets.detach().requires_grad_(offsets.requires_grad)
            share, flow = self._values[first : first + 1], variant.flow and n == 0
            mean, flows = fused.displaced(field.mean, offsets, share, channels=flow)
            moved = replace(field, mean=mean)
        if settings.background > 0:
            shape = (1, *self.observations.quads.shape[1:])
            lights["quads"] = fused.uniform(shape, numbers[1:3], settings.background)
        sensor = self.observations.sensor.with_shifts(variant.shifts[n : n + 1])
        camera = self.observations.cameras[0]
        tof = rendering_of(
            moved, camera, sensor, settings, render, weights, lights, flows=flows, workspace=self._workspaces[n]
        )
        found = self._ledger.found[n]
        terms = {"quads": self._quad_loss(tof, numbers[:1], n)}
        if weights.distortion > 0:
            terms["distortion"] = tof.distortion.mean()
        if weights.motion_size > 0 and offsets is not None:
            terms["motion_size"] = (motion_size(moved.mean - field.mean) * self.padded.share).sum()
        for name in ("distortion", "motion_size"):
            if name in terms:
                found.data[ROW[name]] = terms[name].detach()  # apart from the history of the other numbers
        if flows is not None:  # both directions: what is unknown counts zero
            assert self._flow is not None
            assert tof.extra is not None
            row, out = self._numbers[3:4], found[ROW["flow"] : ROW["flow"] + 1]
            terms["flow"] = fused.flow_loss(
                tof.distance, tof.extra, self._flow, camera, [camera, camera], row=row, out=out
            )
        return Image(terms=terms, tof=tof, gradients=self._gradients(variant, terms, [*values, offsets]))

    def _motion_gradients(self, offsets: Tensor | None, images: list[Image]) -> list[Tensor | None]:
        """By the parameters of the motion: what all images say about the offsets goes back once."""
        learning = self.padded.leaves[len(self.padded.values) :]
        by_offsets = fused.added([image.gradients[-1] for image in images])
        if by_offsets is None or offsets is None or not learning:
            return [None] * len(learning)
        loss = fused.sum_for_gradients([by_offsets], [offsets])
        found = torch.autograd.grad(loss, learning, allow_unused=True)
        return [None if gradient is None else gradient.contiguous() for gradient in found]

    def _gradients(
        self, variant: Variant, terms: dict[str, Tensor], leaves: list[Tensor | None]
    ) -> list[Tensor | None]:
        """Of the weighted terms of one image by everything it was made of."""
        weighed = [(value, getattr(variant.weights, name)) for name, value in terms.items() if value.requires_grad]
        wanted = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
        if not weighed or not wanted:
            return [None] * len(leaves)
        values, weights = zip(*weighed, strict=True)
        loss = fused.sum_for_gradients([self._one_times(weight) for weight in weights], values)
        found = iter(torch.autograd.grad(loss, wanted, allow_unused=True))
        gradients = [next(found) if leaf is not None and leaf.requires_grad else None for leaf in leaves]
        return [None if gradient is None else gradient.contiguous() for gradient in gradients]

    def _quad_loss(self, tof: Rendering, row: Tensor, n: int) -> Tensor:
        """Of image ``n`` against the measured one in a row; with the mean squared difference and opacity beside it."""
        ssim, quads, found = self.settings.weights.ssim, self.observations.quads, self._ledger.found[n]
        if ssim > 0:
            scratch, resident = self._scratch[n], quads[:, None]
            return fused.image_loss(
                tof.quads, resident, ssim, row=row, opacity=tof.opacity, scratch=scratch, out=found[:3]
            )[0]
        loss, squared = image_loss(tof.quads, quads.index_select(0, row), ssim)
        found.data[:3] = torch.stack([loss.detach(), squared, tof.opacity.detach().mean()])
        return loss

    def _one_times(self, weight: float) -> Tensor:
        """A number where the device reads it; made before any capture, since every step runs once without."""
        if weight not in self._ones:
            self._ones[weight] = torch.full((), weight, device=self.observations.quads.device)
        return self._ones[weight]

    def _descend(self, variant: Variant, table: descent.AdamTable, terms: set[str]) -> None:
        """Adam, if everything is finite and no pair was dropped; counts and sums what happened."""
        weights = dict.fromkeys(descent.FOUND_NAMES, 0.0) | {"quad_mse": 1.0, "opacity": 1.0}
        weights |= {name: float(getattr(variant.weights, name)) for name in terms}
        self._summed |= terms | {"quad_mse", "opacity", "loss", "count"}
        used = self._workspaces[: len(variant.shifts)]
        capacity = (-1 if self._reserve.pairs is None else self._reserve.pairs) if self._reserves else 0
        descent.descend(
            table,
            self._values[: len(self._groups)],
            self._ledger,
            [weights[name] for name in descent.FOUND_NAMES],
            motion_from=len(self.padded.values),
            motion_gradient_max=self.settings.motion_gradient_max,
            pairs=[pairs_of(workspace) for workspace in used],
            capacity=capacity,
            betas=self.state.optimiser.betas,
            epsilon=EPSILON,
        )
