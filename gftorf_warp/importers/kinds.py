"""The kinds of recordings that ``gftorf import`` reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
    what it should be raises an InputError, and it asks for keys by ``settings.require``."""
    keys: tuple[Key, ...] = ()
    """Keys of its TOML file."""


KINDS = {
    kind.name: kind
    for kind in (
        Kind(
            name="arrays",
            about="raw quads of any camera as arrays or pictures: NPY, NPZ, HDF5, MAT, PNG, TIFF, "
            "EXR, raw binary",
            read=arrays.read,
            keys=arrays.KEYS,
        ),
        Kind(
            name="ftorf",
            about="an F-ToeRF folder of raw quads, with its truth",
            read=sequence_folders.read_ftorf,
            keys=sequence_folders.KEYS,
        ),
        Kind(
            name="torf",
            about="a ToeRF folder of phasors, with its truth",
            read=sequence_folders.read_torf,
            keys=sequence_folders.KEYS,
        ),
        Kind(
            name="cornell_box",
            about="a sequence of the Cornell-Box data set with motion, with its truth",
            read=cornell_box.read,
            keys=cornell_box.KEYS,
        ),
        Kind(
            name="espros",
            about="raw frames of an ESPROS TOFcam, or an HDF5 file of its recorder",
            read=espros.read,
            keys=espros.KEYS,
        ),
        Kind(
            name="kinect2",
            about="a folder of Kinect v2 packets and tables, dumped by libfreenect2",
            read=kinect2.read,
            keys=kinect2.KEYS,
        ),
        Kind(
            name="mlx7502x",
            about="buffers of a Melexis MLX75026 or MLX75027, dumped by V4L2",
            read=mlx7502x.read,
            keys=mlx7502x.KEYS,
        ),
        Kind(
            name="oak",
            about="raw frames of a Luxonis OAK with a ToF sensor",
            read=oak.read,
            keys=oak.KEYS,
        ),
        Kind(
            name="voxel",
            about="a .vxl file of the TI Voxel SDK, recorded in quad mode",
            read=voxel.read,
            keys=voxel.KEYS,
        ),
    )
}
