"""Small fields, sequences and runs that the tests of motion and of recon/ share."""

import copy
import json
from dataclasses import replace

import torch
from moving_box import recording

from gftorf_warp.recon import checkpoint, presets
from gftorf_warp.recon.state import from_dict, to_dict
from gftorf_warp.recon.stepper import Stepper
from gftorf_warp.recon.terms import TERMS, Term
from gftorf_warp.render.descent import TOTAL_NAMES
from gftorf_warp.scene.gaussians import GaussianField, constant_sh

KEYS = torch.arange(4, dtype=torch.float64) * (4 / 120)  # three quartets


def field(mean, layer):
    """Gaussians that differ in position and layer only."""
    n = len(mean)
    return GaussianField(
        mean=mean,
        log_scale=torch.full((n, 3), -3.0),
        quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        opacity_logit=torch.zeros(n),
        reflectivity_sh=constant_sh(torch.ones(n)),
        layer=layer,
    )


def random(*shape, seed=0):
    """Seeded values in [0, 1)."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def demo(**changes):
    """The demo preset with other values; those of the schedule by their own names."""
    settings = presets.demo()
    schedule = {
        name: changes.pop(name)
        for name in ("images", "batch", "log_every", "warm_up")
        if name in changes
    }
    return replace(settings, schedule=replace(settings.schedule, **schedule), **changes)


def small():
    """Twelve frames of a 48x36 recording."""
    return recording(frames=12)[0]


def stored(run):
    """Everything in the newest checkpoint but the clock."""
    return {name: value for name, value in checkpoint.last(run).items() if name != "seconds"}


def rows(run):
    """metrics.jsonl without the clock."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name != "seconds"} for row in lines]


def same(a, b):
    """Two nested values agree to the bit."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


FLOW = replace(next(term for term in TERMS if term.name == "flow"), weight=lambda *_: 1.0)
"""The flow term alone, in every step."""


def weights_at(settings, images):
    """Weight of every term after so many images."""
    return {term.name: term.weight(settings, images) for term in TERMS}


def advance(state, observations, settings, steps=1):
    """Train a state by some batches; returns how many of the last ones in a row were skipped."""
    stepper = Stepper(state, observations, settings)
    for _ in range(steps):
        stepper.step()
    return stepper.collect()


class OneStep:
    """A step of some raw frames from a copy of a state: terms, gradients and renderings."""

    def __init__(self, state, observations, settings, *frames, terms=TERMS):
        """Run it; ``frames`` are one batch. Moments of the state must be zero."""
        device = observations.quads.device
        twin = from_dict(copy.deepcopy(to_dict(state)), device)
        twin.queue, twin.sums = [0], {}
        one = replace(observations, batches=[[*frames]])
        watch = Term(name="watch", loss=self._watch, weight=lambda *_: 1.0, view=None)
        self.images = []
        """What the terms of every image got."""
        stepper = Stepper(twin, one, settings, terms=(*terms, watch))
        stepper.step()
        self.skipped = stepper.collect()
        """1 if it was not valid."""
        self.sums = {name: float(value) for name, value in twin.sums.items() if name != "watch"}
        """Weighted terms and the other sums of the log."""
        self.terms = {name: value for name, value in self.sums.items() if name not in TOTAL_NAMES}
        """Weighted terms."""
        optimiser = twin.optimiser
        moments = [
            optimiser.moments_of(leaf)[1] / (1 - optimiser.betas[0]) for leaf in optimiser.leaves
        ]
        self.gradients = dict(zip(optimiser.groups, moments, strict=True))
        """By group; of a motion of several tensors the last."""
        self.state = twin
        """Afterwards."""

    def _watch(self, image, _):
        self.images.append(image)
        return torch.zeros((), device=image.mean_weight.device)
