"""Which image of which file is which raw frame and tap."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..data.arrays import SIDE_MAX
from ..data.resources import to_import
from ..errors import InputError
from .imported import Notes
from .keys import Key, Settings
from .raw_files import check_resources, natural
from .stacks import BY_AXES, SUFFIXES, Stack, open_stack

SPARSE = 10  # raw frames per file: with more missing, the numbers count something else
FRAMES, IMAGE = ("frames", "cycles", "slots", "taps"), ("rows", "columns")
KEYS = (
    Key(
        name="source.files",
        kind=str,
        about="files, * is any text: one pattern, or one for each slot or each tap; without, all "
        "images in the folder, ordered as numbers in their names are",
        example=("quads/*.png",),
        shape=(None,),
    ),
    Key(
        name="source.axes",
        kind=str,
        about="axes of a file's array: rows, columns and any of frames, or cycles and slots, and "
        "taps; without, 'rows columns' or 'frames rows columns'",
        example="rows columns frames",
    ),
    Key(
        name="source.numbered",
        kind=bool,
        about="whether the last number in a file's name counts raw frames, so that a gap is a "
        "raw frame that was not measured",
        example=False,
        default=False,
    ),
)


def patterns_of(source: Path, settings: Settings) -> list[list[Path]]:
    """Files of each pattern, in natural order; of a source that is a file only this file.

    Raises:
        InputError: If a pattern has no file, or a file lies outside the folder.
    """
    if source.is_file():
        if settings.given("source.files"):
            why, fix = f"{source} is a file", "give its folder, or leave source.files out"
            raise settings.wrong("source.files", why, fix)
        files = [[source]]
    elif settings.given("source.files"):
        patterns = settings["source.files"]
        files = [matching(source, pattern, settings, "source.files") for pattern in patterns]
    else:
        files = [_images(source)]
    return files


def read_images(
    files: list[Path],
    settings: Settings,
    slots: int,
    taps: int,
    notes: Notes,
    others: int = 0,
) -> Iterator[tuple[Path, np.ndarray]]:
    """The images [H, W] of files in their order, with the file: raw frame by raw frame, and tap by
    tap of each.

    Args:
        files: The files.
        settings: Values of the keys of files and axes.
        slots: Slots that an axis of a file may have.
        taps: Images of a raw frame.
        notes: What was understood is added.
        others: Number of further patterns with as many raw frames.

    Raises:
        InputError: If a file is not what the keys say.
        ResourceError: If memory cannot hold the raw frames of all files.
    """
    told = False
    for path in files:
        stack = open_stack(path, settings)
        axes = _axes(stack, settings, slots, taps)
        if not told:
            told = True
            shape = " x ".join(map(str, stack.array.shape))
            source = "source.axes" if settings.given("source.axes") else "default"
            text = f"{len(files)} files like {path.name}, {shape} {stack.array.dtype.name}"
            notes.understood.append(f"images: {text} as {', '.join(axes)} ({source})")
        order = [axes.index(name) for name in (*FRAMES, *IMAGE) if name in axes]
        array = stack.array.transpose(order)
        if path == files[0]:
            images = len(files) * math.prod(array.shape[:-2]) * (1 + others)
            check_resources(to_import(images // taps, math.prod(array.shape[-2:])), path)
        for index in np.ndindex(array.shape[:-2]):
            yield path, array[index]


def frame_numbers(files: list[Path], settings: Settings, notes: Notes) -> list[int] | None:
    """Raw frame of each file from the last number in its name, the first is 0; None if names do not
    count raw frames.

    Raises:
        InputError: If they should, and two have one number, or none.
    """
    digit_runs = [re.findall(r"\d+", path.stem) for path in files]
    if not all(digit_runs):
        if settings["source.numbered"]:
            name = files[[bool(numbers) for numbers in digit_runs].index(False)].name
            why = f"expected a number in each name, found {name}"
            raise settings.wrong("source.numbered", why, "leave it out, or name files by number")
        return None
    numbers = [int(digits[-1]) for digits in digit_runs]
    gaps = [b for a, b in itertools.pairwise(numbers) if b != a + 1]
    if not settings["source.numbered"]:
        if gaps and len(set(numbers)) == len(numbers):
            text = f"numbers in the names jump before {gaps[0]}: raw frames are taken as complete; "
            notes.uncertain.append(f"{text}source.numbered = true says that some are missing")
        return None
    if any(b <= a for a, b in itertools.pairwise(numbers)):
        why = f"two files have one number, or the order is not theirs: {numbers[:8]} .."
        raise settings.wrong("source.numbered", why, "leave it out, or name files by number")
    if numbers[-1] - numbers[0] >= SPARSE * len(numbers):
        why = f"{len(numbers)} files would be raw frames {numbers[0]} to {numbers[-1]}"
        raise settings.wrong("source.numbered", why, "leave it out, or name files by number")
    if numbers[0] > 1:
        text = f"{files[0].name} is taken as raw frame 0, the first of a cycle"
        notes.uncertain.append(
            f"{text}: if files before it are lost, shifts may be those of others"
        )
    if gaps:
        notes.understood.append(f"frames: {numbers[-1] - numbers[0] + 1 - len(numbers)} missing")
    return [number - numbers[0] for number in numbers]


def matching(root: Path, pattern: str, settings: Settings, name: str) -> list[Path]:
    """Files of a folder that match a pattern, the value of a key, in natural order.

    Raises:
        InputError: If there are none, or one lies outside the folder.
    """
    try:
        files = sorted((path for path in root.glob(pattern) if path.is_file()), key=_natural)
    except (ValueError, NotImplementedError, IndexError) as error:  # absolute, or no pattern
        why = f"expected a pattern such as quads/*.png, found {pattern!r} ({error})"
        raise settings.wrong(name, why, "name files relative to the folder") from error
    if not files:
        why = f"no file of {root} matches {pattern!r}"
        raise settings.wrong(name, why, "correct the pattern")
    _refuse_outside(root, files)
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    return natural(str(path))


def _images(root: Path) -> list[Path]:
    """All files of a folder with a suffix of images, which must be one."""
    files = [p for p in root.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()]
    suffixes = {path.suffix.lower() for path in files}
    if len(suffixes) != 1:
        kinds = ", ".join(sorted(suffixes)) or "none"
        why = f"expected files of one of the formats {', '.join(SUFFIXES)}, found {kinds}"
        fix = "give a folder of images, or name them, by source.files"
        raise InputError("no images", where=root, why=why, fix=fix)
    _refuse_outside(root, files)
    return sorted(files, key=_natural)


def _refuse_outside(root: Path, files: list[Path]) -> None:
    for path in files:
        if not path.resolve().is_relative_to(root.resolve()):
            why, fix = f"it leads to {path.resolve()}", "copy the file into the folder"
            raise InputError("a link out of the folder", where=path, why=why, fix=fix)


def _axes(stack: Stack, settings: Settings, slots: int, taps: int) -> list[str]:
    """Names of the axes of a file's array, checked against its shape."""
    shape, given = stack.array.shape, settings["source.axes"]
    names = (given or stack.axes or BY_AXES.get(len(shape), "")).replace(",", " ").split()
    fits = set(names) <= {*FRAMES, *IMAGE} and len(set(names)) == len(names) == len(shape)
    if not fits or not set(IMAGE) <= set(names) or {"frames", "cycles"} <= set(names):
        why = f"expected a name for each axis of {stack.path.name}, {shape}: rows, columns, and "
        why += f"frames, or cycles and slots, and taps; found {' '.join(names) or 'none'!r}"
        raise settings.wrong("source.axes", why, "for example 'frames rows columns'")
    sizes = dict(zip(names, shape, strict=True))
    wanted = {"slots": slots, "taps": taps}
    for name, size in wanted.items():
        if sizes.get(name, size) != size:
            why = f"expected {size} {name}, as sensor.shifts_deg and sensor.taps say, found "
            why += f"{sizes[name]} in {stack.path.name}, {shape}"
            raise settings.wrong("source.axes", why, "correct the order of axes, or these keys")
    if max(sizes["rows"], sizes["columns"]) > SIDE_MAX:
        why = f"expected at most {SIDE_MAX} rows and columns, found {shape} in {stack.path.name}"
        raise settings.wrong("source.axes", why, "correct the order of axes")
    return names
