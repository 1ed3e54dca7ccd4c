"""What presets are functions of: how a sequence was recorded."""

from __future__ import annotations

from dataclasses import dataclass

from ..data.decode import unambiguous_range
from ..data.sequence import Sequence
from ..data.temporal import camera_rests
from .settings import Input


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What a preset may depend on: how a sequence was recorded, never which one it is."""

    input: Input = Input.QUADS
    """What will be compared, quads or phasors."""
    unambiguous_range: float = 7.5
    """Distances are known modulo this [m]."""
    camera_moves: bool = False
    """Whether raw frames have different poses."""
    width: int = 160
    """Columns of a raw frame."""

    @classmethod
    def of(cls, sequence: Sequence, wanted: Input) -> Recorded:
        """How a sequence was recorded, if ``wanted`` is compared with it."""
        return cls(
            input=wanted,
            unambiguous_range=unambiguous_range(sequence),
            camera_moves=not camera_rests(sequence),
            width=sequence.width,
        )

    @property
    def scene_scale(self) -> float:
        """S = 1.1 unambiguous ranges [m], in which the released code gives lengths:
        8.25 m at 20 MHz.
        """
        return 1.1 * self.unambiguous_range

    @property
    def bounds(self) -> tuple[float, float]:
        """z-depths that hold everything [m]: 0.018 unambiguous ranges to 0.99,
        for phasors 1.21 (sections 2.2, 6.3).
        """
        far = 1.21 if self.input == Input.PHASOR else 0.99
        return 0.018 * self.unambiguous_range, far * self.unambiguous_range
