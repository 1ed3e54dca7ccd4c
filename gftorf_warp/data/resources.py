"""Memory and disk that a command needs at least, from the size of its input: compared with what is
free before anything is allocated.

The bytes are slopes of measured peaks, see design/resources.md. They are rounded down, so that
nothing is refused that would have worked.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..errors import ResourceError
from .files import as_errors

CGROUP = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")
RENDERINGS_KEPT_MAX = 1 << 30  # [B] that `compare` keeps of renderings that it needs twice
RENDERINGS_OF_PIXEL = 40.0  # [B] ten float32: four quads, a phasor, distances, opacity


@dataclass(frozen=True, kw_only=True)
class Need:
    """What a command needs beyond what its process has already."""

    memory: float = 0.0
    """Memory [B]."""
    disk: float = 0.0
    """Disk space [B]."""


def to_simulate(frames: int, pixels: int, rays: int, *, traced: bool) -> Need:
    """Recording of F raw frames of some pixels and rays per pixel, by tracing or by splats."""
    memory = frames * (2e3 + 25.0 * pixels) + pixels * rays * (60.0 if traced else 800.0)
    return Need(memory=memory, disk=frames * (12e3 + 24.0 * pixels))


def to_cover(splats: float) -> Need:
    """Splats that cover the moving bodies of a scene, and a rendering of those that are seen."""
    return Need(memory=400.0 * splats)


def to_read(frames: int, pixels: int) -> Need:
    """A sequence of F raw frames in memory, twice while it is read."""
    return Need(memory=8.0 * frames * pixels)


def to_import(frames: int, pixels: int) -> Need:
    """A recording of F raw frames in memory, twice while it is written, and a capture of it."""
    return Need(memory=8.0 * frames * pixels, disk=frames * (1e3 + 0.3 * pixels))


def to_open(size: float) -> Need:
    """A file of so many bytes, unpacked, that is read whole."""
    return Need(memory=float(size))


def to_reconstruct(frames: int, pixels: int, gaussians: int) -> Need:
    """Optimisation of N Gaussians: observations, state, renderings, three checkpoints."""
    memory = 120.0 * frames * pixels + 300.0 * pixels + 3e3 * gaussians
    return Need(memory=memory, disk=2e3 * gaussians)


def to_reconstruct_on_gpu(frames: int, pixels: int, gaussians: int) -> Need:
    """What of an optimisation is on the GPU."""
    return Need(memory=8.0 * frames * pixels + 300.0 * pixels + 2e3 * gaussians)


def to_compare(frames: int, pixels: int) -> Need:
    """Images of F scored raw frames with their errors, renderings that are kept, and a page."""
    kept = RENDERINGS_OF_PIXEL * frames * pixels
    kept = kept if kept <= RENDERINGS_KEPT_MAX else 0.0
    return Need(memory=150.0 * frames * pixels + kept, disk=2e6)


def to_render(images: int, pixels: int, channels: int, *, arrays: bool, held: int) -> Need:
    """Images of some channels as pictures, which are compressed, or as arrays, ``held`` of them in
    memory.
    """
    values = float(channels * pixels)
    disk = images * (4.0 * values if arrays else 4e3 + 1.5 * values)
    return Need(memory=300.0 * pixels + 4.0 * values * min(held, images), disk=disk)


class Exported(NamedTuple):
    """What a format of ``gftorf export`` needs [B], see :func:`to_export`."""

    of_pixel: float = 0.0
    """Memory."""
    of_gaussian: float = 0.0
    """Memory."""
    file: float = 0.0
    """Disk of a moment, however small its image."""
    file_of_pixel: float = 0.0
    """Disk."""
    file_of_gaussian: float = 0.0
    """Disk."""


def to_export(formats: Iterable[Exported], moments: int, pixels: int, gaussians: int) -> Need:
    """Files of S moments in some formats, one format after the other and moment by moment.

    Args:
        formats: What each needs.
        moments: Number of moments.
        pixels: Of the sequence's camera.
        gaussians: Those that exist at every moment.
    """
    memory, disk = 0.0, 0.0
    for one in formats:
        memory = max(memory, one.of_pixel * pixels + one.of_gaussian * gaussians)
        files = one.file + one.file_of_pixel * pixels + one.file_of_gaussian * gaussians
        disk += moments * files
    return Need(memory=memory, disk=disk)


def to_fuse(nodes: int) -> Need:
    """A surface on a grid."""
    return Need(memory=12.0 * nodes)


def require(need: Need, where: Path | str, fix: str, *, free: float | None = None) -> None:
    """Check that there is enough memory, and enough space on the disk of a path.

    Args:
        need: What is needed.
        where: File or folder that is written, or read if nothing is.
        fix: What the user can do, options first.
        free: Free memory of the device [B]; None: that of the CPU.

    Raises:
        ResourceError: If there is not.
    """
    free = free_memory() if free is None else free
    if free is not None and need.memory > free:
        raise _missing("memory", where, need.memory, free, fix)
    if need.disk:
        space = _free_space(Path(where))
        if need.disk > space:
            raise _missing("disk space", where, need.disk, space, f"free some, or {fix}")


def free_memory() -> float | None:
    """Bytes that this process may still allocate: of the machine with its swap, of its control
    group and of its limit on address space; None where the system does not tell.
    """
    limits = [_of_machine(), _of_control_group(), _of_address_space()]
    return min((limit for limit in limits if limit is not None), default=None)


def _missing(what: str, where: Path | str, needed: float, free: float, fix: str) -> ResourceError:
    why = f"at least {_bytes(needed)} are needed, {_bytes(max(free, 0.0))} are free"
    return ResourceError(f"not enough {what}", where=where, why=why, fix=fix)


def _bytes(number: float) -> str:
    return f"{number / 1e9:,.2f} GB" if number >= 1e7 else f"{number / 1e6:.2f} MB"


def _free_space(path: Path) -> float:
    """Bytes that may be written below a path, which need not exist yet."""
    path = path.absolute()
    while not path.exists() and path != path.parent:
        path = path.parent
    with as_errors(path):
        return shutil.disk_usage(path).free


def _of_machine() -> float | None:
    values = _table(Path("/proc/meminfo"))
    if "MemAvailable:" not in values:
        return None
    return 1024.0 * (values["MemAvailable:"] + values.get("SwapFree:", 0))


def _of_control_group() -> float | None:
    """Limit minus use of control groups of version 2 or 1, without files that may be dropped: the
    least of this process's group and all that it is in.
    """
    margins = []
    for base, most, used in (
        (CGROUP, "memory.max", "memory.current"),
        (CGROUP / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ):
        for folder in _groups_below(base):
            limit, use = _number(folder / most), _number(folder / used)
            if limit is not None and use is not None:
                dropped = _table(folder / "memory.stat").get("inactive_file", 0)
                margins.append(limit - use + dropped)
    return min(margins, default=None)


def _groups_below(base: Path) -> frozenset[Path]:
    """Folders of the groups that this process is in; some of them may not exist."""
    try:
        listed = OWN_GROUPS.read_text()
    except OSError:  # no Linux
        return frozenset({base})
    return _folders_of(base, listed)


@functools.lru_cache(maxsize=8)  # asked for every file of a recording
def _folders_of(base: Path, listed: str) -> frozenset[Path]:
    inner = [base / line.split(":", 2)[-1].lstrip("/") for line in listed.splitlines()]
    outer = {one for path in inner for one in path.parents if one.is_relative_to(base)}
    return frozenset({base, *inner, *outer})


def _of_address_space() -> float | None:
    try:
        import resource
    except ImportError:  # not a Unix
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    status = _table(Path("/proc/self/status"))
    if limit == resource.RLIM_INFINITY or "VmSize:" not in status:
        return None
    return limit - 1024.0 * status["VmSize:"]


def _number(path: Path) -> float | None:
    """The number in a file of the system; None if it is missing or no number, such as "max"."""
    try:
        return float(path.read_text())
    except (OSError, ValueError):
        return None


def _table(path: Path) -> dict[str, float]:
    """Names and numbers of the lines of a file of the system; none if there is no such file."""
    try:
        rows = [line.split() for line in path.read_text(errors="replace").splitlines()]
    except OSError:
        return {}
    return {row[0]: float(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}
