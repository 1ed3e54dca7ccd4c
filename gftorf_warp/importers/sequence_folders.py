"""F-TöRF and TöRF folders, which the program reads too, as captures with other times."""

from __future__ import annotations

from pathlib import Path

from ..data.folder import format_of
from ..data.read import read, read_truth
from ..errors import InputError
from .imported import Imported
from .keys import Key, Settings

KEYS = (
    Key(
        name="time.rate_hz",
        kind=float,
        about="raw frames (ftorf) or phasors (torf) per second [Hz]; replaces times of the folder",
        example=120.0,
        above=0.0,
    ),
)


def read_ftorf(source: Path, settings: Settings) -> Imported:
    """An F-TöRF folder of raw quads with its truth.

    Raises:
        InputError: If it is another folder, or does not conform to data_specs/ftorf.toml.
    """
    return _read("ftorf", source, settings)


def read_torf(source: Path, settings: Settings) -> Imported:
    """A TöRF folder of phasors with its truth.

    Raises:
        InputError: If it is another folder, or does not conform to data_specs/torf.toml.
    """
    return _read("torf", source, settings)


def _read(form: str, source: Path, settings: Settings) -> Imported:
    kind = format_of(source)
    if kind != form:
        why = f"expected a folder of format {form}, found one of format {kind}"
        fix = "a capture needs no import" if kind == "capture" else f"gftorf import {kind}"
        raise InputError(f"no {form} folder", where=source, why=why, fix=fix)
    sequence = read(source, frame_rate_hz=settings["time.rate_hz"])
    sources = sequence.sources.items()
    guesses = tuple(
        f"{name}: {text}" for name, text in sources if text.startswith(("inferred", "default "))
    )
    absent = ("default none", "default 0", "default as ")
    return Imported(
        sequence=sequence,
        understood=tuple(f"{name}: {text}" for name, text in sources),
        uncertain=tuple(line for line in guesses if not any(word in line for word in absent)),
        truth=read_truth(sequence),
    )
