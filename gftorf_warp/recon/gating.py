"""Who has to ask the motion network: Gaussians that stay where they are keep their last displacements for a while.

An approximation, off unless ``GateSettings.distance`` says how far is still at rest. Every now and then all Gaussians
ask for all keys. The spread of one is the largest distance of a displacement from its mean over the keys: up to the
gate it is at rest. Who was awake falls asleep at half of it; who was at rest wakes up above it, or if the network has
come to say something else than what was kept. In between, rows at rest take what was kept, without gradient
(design/training-step.md).
"""

from __future__ import annotations

import logging

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..scene.gaussians import GaussianField
from ..scene.motion import Motion
from ..scene.network import Network
from .densify import crossed
from .settings import ReconSettings

LOG = logging.getLogger("gftorf_warp")
BUCKET = 2048  # rows that ask come in such numbers
ASKED = 1 << 16  # rows that ask at once when all are judged, about as many as in a step


class Gate:
    """Who asks, of the rows of one run; nothing of it is stored with the run.

    Shapes are fixed between two judgements, so that a captured step may look at them: always whole buckets ask. Where
    fewer are awake, those at rest that move most ask as well, so no row comes twice.
    """

    active: Int[Tensor, "A"]
    """Rows that ask, in their order."""
    table: Float[Tensor, "T rows 3"]
    """Displacements [m] at all keys when they were last asked for."""
    awake: Bool[Tensor, "rows"]
    """Gaussians that are not at rest; False behind the last Gaussian."""
    spread: Float[Tensor, "rows"]
    """How far each goes from its mean displacement [m]; -1 behind the last Gaussian."""

    def __init__(self, settings: ReconSettings, motion: Motion):
        """Everybody is awake, and nobody was judged.

        Args:
            settings: Of the run.
            motion: Of the run; what is no network is cheap to ask, and never gated.
        """
        self.settings, self._begins = settings.gate, settings.schedule.warm_up + settings.gate.after
        self._motion, self._network = motion, motion if isinstance(motion, Network) else None
        self._judged = False

    def is_due(self, before: int, after: int) -> bool:
        """Whether a step from ``before`` to ``after`` images ends with a judgement."""
        if self.settings.distance is None or self._network is None or after < self._begins:
            return False
        return not self._judged or crossed(before, after, self.settings.every)

    def is_shut(self, step: int) -> bool:
        """Whether in the step of this number some rows do not ask."""
        return self._judged and len(self.active) < len(self.awake) and step % self.settings.open_every != 0

    @property
    def counts(self) -> tuple[int, int] | None:
        """Gaussians that are awake and rows that ask, which waits for the device; None: nobody was judged."""
        return (int(self.awake.sum()), len(self.active)) if self._judged else None

    @torch.no_grad()
    def judge(self, field: GaussianField, count: int) -> bool:
        """Ask for everybody, and decide who rests; the host waits once.

        Args:
            field: All rows, dead ones as well.
            count: How many Gaussians there are; rows behind them are dead.

        Returns:
            Whether a tensor lies elsewhere than before, so that nothing captured with the old ones may run again.
        """
        distance, found = self.settings.distance, self._all(field)
        assert distance is not None
        spread = (found - found.mean(dim=0)).norm(dim=2).amax(dim=0)
        kept = self._judged and len(self.awake) == len(field)
        if kept:
            rested = spread <= torch.where(self.awake, 0.5 * distance, distance)
            rested &= self.awake | ((found - self.table).norm(dim=2).amax(dim=0) <= distance)
        else:
            rested = spread <= 0.5 * distance
        rested[count:] = True
        spread[count:] = -1.0
        self._keep(found, ~rested, spread)  # not a number: awake
        return self._choose() or not kept

    @torch.no_grad()
    def follow(self, origin: Int[Tensor, "N"] | None, rows: int) -> bool:
        """Gaussians came and went: a copy is taken for what it was copied from until it is judged.

        Args:
            origin: The row that each Gaussian was; None: the same.
            rows: How many rows there are now.

        Returns:
            See :meth:`judge`.
        """
        if not self._judged or (origin is None and rows == len(self.awake)):
            return False
        if origin is None:
            origin = torch.arange(min(rows, len(self.awake)), device=self.awake.device)
        table = self.table.new_zeros(len(self.table), rows, 3)
        table[:, : len(origin)] = self.table[:, origin]
        awake, spread = self.awake.new_zeros(rows), self.spread.new_full((rows,), -1.0)
        awake[: len(origin)], spread[: len(origin)] = self.awake[origin], self.spread[origin]
        elsewhere = rows != len(self.awake)
        self._keep(table, awake, spread)
        return self._choose() or elsewhere

    def offsets(
        self, field: GaussianField, attachment: Float[Tensor, "rows M"] | None, keys: Int[Tensor, "k"], *, gated: bool
    ) -> Float[Tensor, "k rows 3"]:
        """Displacements [m]; if gated, only active rows ask and have a gradient, the others take what was kept.

        Args:
            field: All rows.
            attachment: How they hang on the motion; None: that is found out, for those that ask.
            keys: Numbers of keys, read on their device.
            gated: Whether some do not ask; everybody must have been judged then.
        """
        if not gated:
            place = self._motion.attach(field) if attachment is None else attachment
            return self._motion.key_offsets(place, keys)
        assert self._network is not None
        if attachment is None:
            place = self._network.attach_at(field.mean.detach().index_select(0, self.active))
        else:
            place = attachment.index_select(0, self.active)
        return self.table.index_select(0, keys).index_copy_(1, self.active, self._network.key_offsets(place, keys))

    def _all(self, field: GaussianField) -> Float[Tensor, "T rows 3"]:
        """What the network says for all rows at all keys."""
        assert self._network is not None
        place, keys = self._network.attach(field), torch.arange(len(self._network.key_times), device=field.device)
        parts = keys.split(max(ASKED // len(field), 1))
        return torch.cat([self._network.key_offsets(place, part) for part in parts])

    def _keep(self, table: Tensor, awake: Tensor, spread: Tensor) -> None:
        """New values, where the old ones were if there is room."""
        if self._judged and self.table.shape == table.shape:
            self.table.copy_(table)
        else:
            self.table = table
        self.awake, self.spread = awake, spread

    def _choose(self) -> bool:
        """Decide who asks; whether that lies elsewhere now."""
        awake, rows = int(self.awake.sum()), len(self.awake)
        wanted = max(-(-awake // BUCKET), 1) * BUCKET
        if self._judged and 0 <= len(self.active) - wanted <= BUCKET:  # one too many does no harm: a new graph would
            wanted = len(self.active)
        first = torch.where(self.awake, torch.inf, self.spread).argsort(descending=True, stable=True)
        active = first[: min(wanted, rows)].sort().values
        LOG.debug("%d Gaussians are awake, %d of %d rows ask the network", awake, len(active), rows)
        elsewhere = not self._judged or len(active) != len(self.active)
        if elsewhere:
            self.active = active
        else:
            self.active.copy_(active)
        self._judged = True
        return elsewhere
