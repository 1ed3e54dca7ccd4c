"""Quartets of ESPROS TOFcams as stored: raw frames of the camera, and HDF5 files of its recorder.

A raw frame is a header of 25 bytes, high bytes first, and four images (DCS 0 to 3) of 16 bits, low
bytes first. The recorder of epc-tofcam-toolkit stores the images of each frame and its time.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from ..data.resources import to_open
from ..data.untrusted import SIDE_MAX
from ..errors import InputError
from .hdf5_files import MAGIC, checked, datasets, open_hdf5
from .imported import Notes
from .raw_files import check_resources, files_of, raw_bytes, size_of

# version, type, columns, rows, region of interest (left, top, right, bottom), three integration
# times [us], temperature [0.01 degrees], offset of the data
HEADER = struct.Struct(">B10HhH")
DCS = 4
MEGAHERTZ_BELOW = 1e4  # a modulation frequency below this is in MHz
# DCS whose images the recorder of a turned camera stores, in the order in which it stores them
ORDER_TURNED = (2, 0, 3, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Quartets:
    """N quartets as stored."""

    dcs: Shaped[np.ndarray, "N 4 H W"]
    """Stored numbers of DCS 0, 1, 2, 3."""
    times: Float[np.ndarray, "N"] | None = None
    """Time of each quartet [s]; None: not stored."""
    exposure_s: float | None = None
    """Integration time [s]; None: unknown."""
    f_mod_hz: float | None = None
    """Modulation frequency [Hz]; None: not stored."""


def read_quartets(source: Path, turned: bool | None, notes: Notes) -> Quartets:
    """Quartets of a file, or of the files of a folder in natural order.

    ``turned``: whether the recorder stored images a quarter turn clockwise; None: if higher than
    wide.

    Raises:
        InputError: If it is neither of the two formats, damaged, or has no DCS.
        ResourceError: If h5py is needed and not installed.
    """
    files = files_of(source)
    if bytes(raw_bytes(files[0], 0, min(size_of(files[0]), len(MAGIC)))) == MAGIC:
        return _recorded(files, turned, notes)
    return _raw(files, notes)


def _raw(files: list[Path], notes: Notes) -> Quartets:
    """Quartets of raw frames, one after the other."""
    images, headers = [], []
    check_resources(
        to_open(2.0 * sum(map(size_of, files))), files[0].parent
    )  # and once more in a row
    for path in files:
        first, size = 0, size_of(path)
        while first < size:
            header = _header(path, first)
            columns, rows = header[2:4]
            data = raw_bytes(path, first + HEADER.size, 2 * DCS * rows * columns)
            images.append(data.view("<u2").reshape(DCS, rows, columns))
            headers.append(header)
            first += HEADER.size + len(data)
    if len({image.shape for image in images}) != 1:
        sizes = ", ".join(sorted({f"{i.shape[2]}x{i.shape[1]}" for i in images})) or "none"
        why, fix = f"expected raw frames of one size, found {sizes}", "split the recording"
        raise InputError("no raw frames", where=files[0].parent, why=why, fix=fix)
    low, mid, high = headers[0][8:11]
    degrees = [header[11] / 100 for header in headers]
    left, top = headers[0][4:6]
    notes.understood.append(
        f"raw frames: {len(images)} in {len(files)} files, header version {headers[0][0]}, "
        f"{min(degrees):g} to {max(degrees):g} degrees Celsius"
    )
    notes.understood.append(
        f"region: from column {left}, row {top}; camera.cx, cy count from there"
    )
    if mid or high or len({header[8] for header in headers}) > 1:
        text = f"integration times {low}, {mid}, {high} us: with HDR, DCS are of different ones"
        notes.uncertain.append(text)
        low = 0
    return Quartets(dcs=np.stack(images), exposure_s=1e-6 * low or None)


def _header(path: Path, first: int) -> tuple[int, ...]:
    header = HEADER.unpack(raw_bytes(path, first, HEADER.size).tobytes())
    columns, rows = header[2:4]
    if not (0 < columns <= SIDE_MAX and 0 < rows <= SIDE_MAX and header[12] in (0, HEADER.size)):
        why = (
            f"expected columns, rows and data from byte {HEADER.size} on, found {columns}, {rows} "
        )
        why += f"and byte {header[12]} in the header at byte {first}"
        fix = "store what the camera sends for getDcs, without the headers of UDP packets"
        raise InputError("no raw frame of a TOFcam", where=path, why=why, fix=fix)
    return header


def _recorded(files: list[Path], turned: bool | None, notes: Notes) -> Quartets:
    """Quartets of a file of the recorder: group DCS, or, in older ones, a grid of 2x2 images."""
    path = files[0]
    if len(files) > 1:
        why, fix = f"expected one recording, found {len(files)} files", "name the file"
        raise InputError("several files", where=path.parent, why=why, fix=fix)
    with open_hdf5(path) as file:
        by_name = datasets(file)
        group = next((g for g in ("DCS/", "") if f"{g}frames" in by_name), None)
        if group is None:
            why = f"expected DCS/frames, found {', '.join(by_name)[:200] or 'nothing'}"
            fix = "record with image type DCS: distances and amplitudes are decoded already"
            raise InputError("no DCS", where=path, why=why, fix=fix)
        frames = checked(path, by_name[f"{group}frames"])
        times = by_name.get(f"{group}timestamps")
        stored = None if times is None else checked(path, times).astype(np.float64).reshape(-1)
        f_mod = file.attrs.get("mod_frequency")
    notes.understood.append(f"file: {path.name}, {group}frames, {frames.dtype} {frames.shape}")
    if stored is not None and stored.shape != frames.shape[:1]:
        why = f"expected {len(frames)} timestamps, found {stored.shape}"
        raise InputError("timestamps", where=path, why=why, fix="record again")
    return Quartets(
        dcs=_upright(path, frames, turned, notes), times=stored, f_mod_hz=_hertz(f_mod, notes)
    )


def _upright(path: Path, frames: np.ndarray, turned: bool | None, notes: Notes) -> np.ndarray:
    """Stored images as [N, 4, H, W], DCS in their order."""
    grid = frames.ndim == 3 and not any(n % 2 for n in frames.shape[1:])
    if (not grid and (frames.ndim != 4 or frames.shape[1] != DCS)) or min(frames.shape) < 1:
        why = f"expected N x 4 x rows x columns, or N grids of 2x2 images, found {frames.shape}"
        raise InputError("no quartets", where=path, why=why, fix="record with image type DCS")
    if turned is None:
        turned = frames.shape[-2] > frames.shape[-1]
        text = "higher than wide, so taken as turned" if turned else "not turned"
        notes.uncertain.append(
            f"images are {text}: some versions of the recorder store them a quarter turn "
            "clockwise; recorder.turned states it"
        )
    if turned:
        frames = np.rot90(frames, 1, axes=(-2, -1))
    if grid:
        rows, columns = (n // 2 for n in frames.shape[1:])
        cells = frames.reshape(len(frames), 2, rows, 2, columns)
        return cells.transpose(0, 1, 3, 2, 4).reshape(len(frames), DCS, rows, columns)
    if turned:
        notes.uncertain.append(
            "a recorder that turns images also changes their order: DCS 2, 0, 3, 1 is undone; "
            "sensor.shifts_deg corrects another one"
        )
        frames = frames[:, np.argsort(ORDER_TURNED)]
    return frames


def _hertz(stored: object, notes: Notes) -> float | None:
    """The attribute mod_frequency in Hz."""
    try:
        value = float(np.asarray(stored, dtype=np.float64).reshape(()))
    except (TypeError, ValueError):
        return None
    if not 0 < value < np.inf:
        return None
    if value < MEGAHERTZ_BELOW:
        notes.uncertain.append(f"mod_frequency {value:g} has no unit: taken as MHz")
        value *= 1e6
    return value
