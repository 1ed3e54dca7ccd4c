"""The kinds of recordings that ``gftorf import`` reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from . import arrays, cornell_box, espros, kinect2, mlx7502x, oak, sequence_folders, voxel
from .imported import Imported
from .keys import Key, Settings


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of recording."""

    name: str
    """Name on the command line."""
    about: str
    """What it reads, in a line."""
    read: Callable[[Path, Settings], Imported]
    """Reads a file or folder with the values of the keys. A reader that finds the source is not
    what it should be raises an InputError; ``settings.require`` refuses missing keys."""
    keys: tuple[Key, ...] = ()
    """Keys of its TOML file."""


def _of(module: ModuleType, about: str) -> Kind:
    """The kind that a module of its name reads."""
    name = module.__name__.rpartition(".")[2]
    return Kind(name=name, about=about, read=module.read, keys=module.KEYS)


def _folder(name: str, about: str, read: Callable[[Path, Settings], Imported]) -> Kind:
    """A folder of another program that is a sequence already."""
    return Kind(name=name, about=about, read=read, keys=sequence_folders.KEYS)


KINDS = {
    kind.name: kind
    for kind in (
        _of(
            arrays,
            "raw quads of any camera as arrays or pictures: NPY, NPZ, HDF5, MAT, PNG, TIFF, EXR, "
            "raw binary",
        ),
        _folder(
            "ftorf", "an F-ToeRF folder of raw quads, with its truth", sequence_folders.read_ftorf
        ),
        _folder("torf", "a ToeRF folder of phasors, with its truth", sequence_folders.read_torf),
        _of(cornell_box, "a sequence of the Cornell-Box data set with motion, with its truth"),
        _of(espros, "raw frames of an ESPROS TOFcam, or an HDF5 file of its recorder"),
        _of(kinect2, "a folder of Kinect v2 packets and tables, dumped by libfreenect2"),
        _of(mlx7502x, "buffers of a Melexis MLX75026 or MLX75027, dumped by V4L2"),
        _of(oak, "raw frames of a Luxonis OAK with a ToF sensor"),
        _of(voxel, "a .vxl file of the TI Voxel SDK, recorded in quad mode"),
    )
}
