"""Codes of an analogue-to-digital converter as quads, and pixels without a valid code.

    quad = code - zero,     code = bits lowest_bit .. lowest_bit + bits - 1 of the stored number

A sequence cannot state that one raw frame did not measure a pixel. Such a pixel gets the
value of the nearest raw frame of the same slot, the earlier one of two; a pixel that some slot
never measured is without light, 0, in all raw frames. Both are counted and stated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from .imported import Notes
from .keys import Key, Settings

EXACT = 1 << 24  # float32 holds every whole number up to this
KEYS = (
    Key(
        name="values.zero",
        kind=float,
        about="code without light, subtracted: 0 if signed, often half of the range if not",
        example=2048.0,
        needed=True,
    ),
    Key(
        name="values.bits",
        kind=int,
        about="number of bits that hold the code; without, all of the stored type",
        example=12,
        least=1,
    ),
    Key(
        name="values.lowest_bit",
        kind=int,
        about="position of the lowest of them: 4 if 12 bits are at the top of 16",
        example=0,
        default=0,
        least=0,
    ),
    Key(
        name="values.twos_complement",
        kind=bool,
        about="whether these bits are a signed number although the stored type is not",
        example=False,
        default=False,
    ),
    Key(
        name="values.invalid",
        kind=float,
        about="stored numbers that mean: not measured; NaN always does",
        example=(64002.0,),
        default=(),
        shape=(None,),
    ),
    Key(
        name="values.saturated",
        kind=float,
        about="stored numbers that mean: too bright",
        example=(64003.0,),
        default=(),
        shape=(None,),
    ),
)


@dataclass(kw_only=True)
class Decoder:
    """Decodes images one by one and counts what is no measurement."""

    settings: Settings
    """Values of ``KEYS``."""
    pixels: int = 0
    """Pixels of all images."""
    invalid: int = 0
    """Pixels of all images that were not measured."""
    saturated: int = 0
    """Pixels of all images that were too bright."""
    types: set[str] = field(default_factory=set)
    """Stored types."""
    rounded: bool = False
    """Whether float32 cannot hold some code."""

    def __call__(self, stored: np.ndarray) -> Float[np.ndarray, "H W"]:
        """Quads of an image of stored numbers [H, W], float32; NaN where there is no measurement.

        Raises:
            InputError: If the keys ask for bits that the type does not have.
        """
        self.types.add(stored.dtype.name)
        stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
        saturated = np.isin(stored, self.settings["values.saturated"])
        invalid = np.isin(stored, self.settings["values.invalid"]) & ~saturated
        codes = self._codes(stored)
        with np.errstate(over="ignore", invalid="ignore"):  # NaN, and numbers beyond float32
            zero = self.settings["values.zero"]
            quads = np.subtract(codes, zero, dtype=np.float64).astype(np.float32)
        invalid |= ~np.isfinite(quads) & ~saturated
        self.pixels += stored.size
        self.invalid += int(invalid.sum())
        self.saturated += int(saturated.sum())
        quads[invalid | saturated] = np.nan
        if codes.dtype.kind != "f" or codes.dtype.itemsize > 4:
            self.rounded |= bool((np.abs(codes[np.isfinite(codes)]) > EXACT).any())
        return quads

    def _codes(self, stored: np.ndarray) -> np.ndarray:
        """The codes in the bits of stored integers; other numbers as they are."""
        bits, lowest = self.settings["values.bits"], self.settings["values.lowest_bit"]
        signed = self.settings["values.twos_complement"]
        if bits is None and not lowest and not signed:
            return stored
        width = 8 * stored.dtype.itemsize
        bits = width - lowest if bits is None else bits
        if stored.dtype.kind == "f" or not 1 <= bits <= width - lowest:
            why = f"expected bits of {stored.dtype}, found {bits} from bit {lowest} on"
            fix = "leave values.bits out to take stored numbers as they are"
            raise self.settings.wrong("values.bits", why, fix)
        codes = (stored.astype(np.int64) >> lowest) & ((1 << bits) - 1)
        if signed or stored.dtype.kind == "i":
            codes = np.where(codes >> (bits - 1), codes - (1 << bits), codes)
        return codes

    def describe(self, notes: Notes) -> None:
        """Add what was decoded to the notes."""
        settings = self.settings
        bits, lowest = settings["values.bits"], settings["values.lowest_bit"]
        zero = settings["values.zero"]
        text = "all bits" if bits is None else f"{bits} bits"
        text += f" from bit {lowest} on" if lowest else ""
        text += ", two's complement" if settings["values.twos_complement"] else ""
        kinds = ", ".join(sorted(self.types))
        notes.understood.append(f"values: {kinds}, {text}; quad = code - {zero:g} (values.zero)")
        if self.rounded:
            notes.uncertain.append(f"codes above {EXACT} are rounded to float32")
        if "uint8" in self.types or "int8" in self.types:
            notes.uncertain.append("images of 8 bits: was the recording converted to a picture?")
        for count, what in ((self.invalid, "invalid"), (self.saturated, "saturated")):
            if count:
                share = f"{count / self.pixels:.2%}"
                text = f"{count} values ({share}) are {what}: each is replaced by the value of its "
                notes.uncertain.append(f"{text}pixel in the nearest raw frame of its slot")


def fill(quads: Float[np.ndarray, "F H W"], measured: Bool[np.ndarray, "F"], cycle: int) -> int:
    """Replace NaN in raw frames that were measured, as the module states; in place.

    Args:
        quads: Raw frames.
        measured: Which of them were measured; the others are left alone.
        cycle: Number K of slots.

    Returns:
        Number of pixels that some slot never measured.
    """
    dark = np.zeros(quads.shape[1:], dtype=bool)
    for slot in range(cycle):
        frames = [n for n in range(slot, len(quads), cycle) if measured[n]]
        holes = np.stack([np.isnan(quads[n]) for n in frames]) if frames else np.zeros(0, bool)
        never = holes.all(axis=0) if holes.any() else np.zeros_like(dark)
        dark |= never
        for i in np.flatnonzero(holes.any(axis=(1, 2))) if holes.any() else ():
            left = holes[i] & ~never
            for j in sorted(range(len(frames)), key=lambda other: (abs(other - i), other)):
                if not left.any():
                    break
                usable = left & ~holes[j]
                quads[frames[i]][usable] = quads[frames[j]][usable]
                left &= ~usable
    quads[:, dark] = 0.0
    return int(dark.sum())
