"""Files as strangers write them: whole ones of every format that is read, and damage to them.

Used by test_damaged_files.py, for a few seconds, and by benchmarks/fuzz.py, for as long as wanted.
"""

import atexit
import functools
import hashlib
import os
import re
import shutil
import struct
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import foreign
import kinect2_dump
import numpy as np
import recordings
import test_import_arrays as arrays
import test_import_colour
import torf_folder
from dng import dng
from ftorf_folder import scene
from small_runs import demo, small
from test_capture import recording
from test_meshes import TETRAHEDRON, written

from gftorf_warp import Run, Sequence
from gftorf_warp.data.exr import read_parts, write_exr
from gftorf_warp.data.write import write
from gftorf_warp.errors import GftorfError, InputError
from gftorf_warp.importers.colour_images import read_colour
from gftorf_warp.importers.command import read_recording
from gftorf_warp.recon.train import reconstruct
from gftorf_warp.scene.falloff import read_falloff
from gftorf_warp.sim.mesh_file import read_mesh
from gftorf_warp.sim.scene_file import read_scene

EXAMPLES = Path(__file__).parents[1] / "examples"


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A reader of foreign files."""

    make: Callable[[Path], object]
    """Fills a folder."""
    read: Callable[[Path], object]
    """Reads it, and returns arrays and texts that can be compared."""
    damaged: str = "**/*"
    """Pattern of the files that are damaged."""
    protected: bool = False
    """Whether a hash protects these, so that what is read is what was written."""


def sequence(folder):
    """Everything in a sequence folder."""
    found = Sequence.open(folder)
    truth = found.truth()
    arrays = [found.quads, found.times, found.camera_from_world, found.shifts]
    return [*arrays, *found.colour.images.values(), None if truth is None else truth.distance]


def make_capture(folder, *, protected=True):
    """Everything that a capture can hold."""
    write("capture", folder, *recording(), readme="# a capture\n")
    if not protected:
        (folder / "MANIFEST.sha256").unlink()


def make_ftorf(folder):
    """Raw quads with colour, flow and truth."""
    colour = {0: np.full((4, 6, 3), 0.5, np.float32)}
    flow = {0: np.zeros((2, 6, 8), np.float32)}
    write("ftorf", folder, *scene(colour=colour, forward_flow=flow))


def make_torf(folder):
    """Phasors, and matrices of MATLAB."""
    torf_folder.build(folder, matlab=True)


def make_run(folder):
    """A short run."""
    reconstruct(small(), folder, demo(images=40, warm_up=4))


def run(folder):
    """What is read of a run that does not say that it has gone back to an earlier checkpoint."""
    found = Run.open(folder)
    if damaged := found.config.get("damaged_checkpoints"):
        raise InputError("an earlier checkpoint", where=folder, why=f"{damaged}", fix="none")
    return [found.field.mean.numpy(), found.field.reflectivity_sh.numpy()]


def run_with_a_right_hash(folder):
    """As :func:`run`, but whoever damaged the checkpoints wrote their hashes, too."""
    for path in (folder / "ckpt").glob("*.pt"):
        if regular(path):
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            path.with_suffix(".pt.sha256").write_text(f"{digest}  {path.name}\n")
    return run(folder)


def make_pictures(folder):
    """Maps of the fall-off of a lens, in all of their formats."""
    image = np.linspace(0.5, 1.0, 24, dtype=np.float32).reshape(4, 6)
    np.save(folder / "a.npy", image)
    write_exr(folder / "b.exr", {"Y": image})
    cv2.imwrite(str(folder / "c.png"), (60_000 * image).astype(np.uint16))


def pictures(folder):
    """The first of the maps that is there, then the others."""
    return [read_falloff(path) for path in sorted(folder.iterdir())]


def make_exr(folder):
    """Several parts."""
    shutil.copy(next(whole("capture").glob("tof/*.exr")), folder / "a.exr")


def make_meshes(folder):
    """Text and binary."""
    written(folder / "a.ply", *TETRAHEDRON)
    written(folder / "b.obj", *TETRAHEDRON)
    points, faces = TETRAHEDRON
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nelement face 4\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = b"".join(struct.pack("<B3i", 3, *face) for face in faces)
    (folder / "c.ply").write_bytes(head.encode() + points.astype("<f4").tobytes() + rows)


def meshes(folder):
    """Every mesh."""
    return [array for path in sorted(folder.iterdir()) for array in read_mesh(path)]


def make_scene(folder):
    """A scene file that says most of what one can say."""
    for name in ("scene.toml", "vase.toml", "vase.obj"):
        shutil.copy(EXAMPLES / name, folder / name)


def scenes(folder):
    """Both scenes."""
    return [repr(read_scene(folder / name)) for name in ("scene.toml", "vase.toml")]


AS_IT_IS = ("linear", "none")


def make_dng(folder):
    """What a camera of colour stores."""
    (folder / "a.dng").write_bytes(dng(np.full((24, 32), 30000)))


READERS = {
    "capture": Reader(make=make_capture, read=sequence, damaged="[!M]*/*", protected=True),
    "capture without a manifest": Reader(
        make=functools.partial(make_capture, protected=False), read=sequence
    ),
    "F-ToeRF": Reader(make=make_ftorf, read=sequence),
    "ToeRF": Reader(make=make_torf, read=sequence),
    "run": Reader(make=make_run, read=run),
    "checkpoint": Reader(make=make_run, read=run, damaged="ckpt/*.pt", protected=True),
    "checkpoint with its hash": Reader(
        make=make_run, read=run_with_a_right_hash, damaged="ckpt/*.pt"
    ),
    "EXR": Reader(make=make_exr, read=lambda folder: read_parts(folder / "a.exr")),
    "NPY, EXR, PNG": Reader(make=make_pictures, read=pictures),
    "PLY, OBJ": Reader(make=make_meshes, read=meshes),
    "scene": Reader(make=make_scene, read=scenes),
    "DNG": Reader(make=make_dng, read=lambda folder: [read_colour(folder / "a.dng", *AS_IT_IS)]),
    **{
        f"import {name}": Reader(make=make, read=functools.partial(recordings.read, name))
        for name, make in recordings.WRITERS.items()
    },
}


def make_import(writer, folder):
    """A recording as arrays, and the keys that say how."""
    _, codes = foreign.recording()
    (folder / "files").mkdir()
    changes = writer(folder / "files", codes)
    (folder / "keys.toml").write_text(foreign.keys(**changes))


def imported(folder):
    """The quads of a recording."""
    return [read_recording("arrays", folder / "files", folder / "keys.toml").sequence.quads]


WRITERS = (
    *(arrays.npy_stack, arrays.npz_slots, arrays.hdf5, arrays.mat, arrays.mat73, arrays.png),
    *(arrays.tiff_high_bits, arrays.tiff_pages, arrays.exr_each, arrays.raw_stack),
)
IMPORTS = {
    f"import {writer.__name__}": Reader(
        make=functools.partial(make_import, writer), read=imported, damaged="files/*"
    )
    for writer in WRITERS
}
READERS |= IMPORTS


def make_kinect2(folder):
    """A packet and all tables of a Kinect v2."""
    kinect2_dump.write(folder / "dump", lookup=True)


def kinect2(folder):
    """Its quads and lens."""
    found = read_recording("kinect2", folder / "dump").sequence
    return [found.quads, repr(found.intrinsics)]


def make_colour(folder):
    """Quads with pictures of a colour camera."""
    test_import_colour.recorded(folder, test_import_colour.png)


def colour(folder):
    """The pictures and where they were taken."""
    found = read_recording("arrays", folder / "quads", folder / "keys.toml").sequence.colour
    return [*found.images.values(), found.camera_from_world]


READERS["import kinect2"] = Reader(make=make_kinect2, read=kinect2, damaged="dump/*")
READERS["import colour"] = Reader(make=make_colour, read=colour, damaged="quads/c/*")


@functools.cache
def whole(name: str) -> Path:
    """The undamaged folder of a reader, made once in a process."""
    place = Path(tempfile.mkdtemp(prefix="whole-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    folder = place / "files"
    if READERS[name].make not in (make_ftorf, make_run) and "capture" not in name:
        folder.mkdir()
    READERS[name].make(folder)
    return folder


NUMBERS = (0, 1, -1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1)
WORDS = (
    *("0", "-1", "1e999", "nan", "NaN", "Infinity", "1e30", "99999999999999999999", "0x10", "null"),
    *(
        "true",
        '""',
        "[]",
        "{}",
        "[[]]",
        "{",
        "]",
        ",",
        '"',
        "\\",
        "= =",
        "\n",
        "../../../etc/passwd",
    ),
)
NESTED = ("[" * 5000, '{"a":' * 5000, "[[[[" * 300 + "1" + "]]]]" * 300)


def flip(data, random):
    """Other bits in a few places."""
    for at in random.integers(0, len(data), random.integers(1, 9)):
        data[at] ^= 1 << random.integers(8)


def overwrite(data, random):
    """Zeros, ones or noise over a stretch."""
    start, length = random.integers(len(data)), int(2 ** random.uniform(0, 9))
    part = data[start : start + length]
    filler = (bytes(len(part)), b"\xff" * len(part), random.bytes(len(part)))
    data[start : start + length] = filler[random.integers(3)]


def number(data, random):
    """An extreme number of two to eight bytes, where headers are more often than elsewhere."""
    size = int(random.choice((2, 4, 8)))
    end = len(data) if random.integers(2) else min(len(data), 400)
    start = random.integers(end)
    value = NUMBERS[random.integers(len(NUMBERS))] & ((1 << 8 * size) - 1)
    order = ("little", "big")[random.integers(2)]
    data[start : start + size] = value.to_bytes(size, order)


def cut(data, random):
    """The end is missing."""
    del data[random.integers(len(data)) :]


def empty(data, random):  # noqa: ARG001
    """Nothing is left."""
    data.clear()


def extend(data, random):
    """More than there was."""
    data += random.bytes(int(2 ** random.uniform(0, 12)))


def repeat(data, random):
    """A stretch twice, or moved."""
    start, length = random.integers(len(data)), int(2 ** random.uniform(0, 9))
    at = random.integers(len(data))
    data[at:at] = data[start : start + length]


def word(data, random):
    """Another word where a number or a name was."""
    text = bytes(data).decode("latin-1")
    found = [*re.finditer(r"-?[\w.+]+", text)]
    if found:
        match = found[random.integers(len(found))]
        new = (*WORDS, *NESTED)[random.integers(len(WORDS) + len(NESTED))]
        data[match.start() : match.end()] = new.encode()


def line(data, random):
    """A line less, or twice."""
    lines = bytes(data).splitlines(keepends=True)
    at = random.integers(len(lines))
    data[:] = b"".join(lines[:at] + [lines[at]] * (2 * random.integers(2)) + lines[at + 1 :])


BYTES = (flip, overwrite, number, cut, empty, extend, repeat)
TEXT = (word, line)
IN_TEXTS = {".json", ".jsonl", ".toml", ".obj", ".ply", ".sha256", ".txt", ".md"}


def take_away(path, random):  # noqa: ARG001
    """There is none."""
    path.unlink()


def folder_instead(path, random):  # noqa: ARG001
    """A folder of that name."""
    path.unlink()
    path.mkdir()


def pipe_instead(path, random):  # noqa: ARG001
    """A pipe, which nobody writes to."""
    path.unlink()
    os.mkfifo(path)


def device_instead(path, random):
    """A link to a file without an end, or that cannot be read."""
    path.unlink()
    path.symlink_to(("/dev/zero", "/proc/self/mem", "/nowhere", path.name)[random.integers(4)])


def link_instead(path, random):  # noqa: ARG001
    """A link to what was there, in another folder."""
    outside = Path(tempfile.mkdtemp(dir=path.parents[1])) / path.name
    path.rename(outside)
    path.symlink_to(outside)


def other_name(path, random):
    """A number that is another, too large or too long."""
    digits = re.sub(r"\d+", str(random.choice((0, 1, 7, 99, 10**6))).zfill(4), path.stem)
    path.rename(path.with_name(digits + path.suffix))


IN_FOLDERS = (
    *(take_away, folder_instead, pipe_instead, device_instead),
    *(link_instead, other_name),
)


def damage(folder: Path, random: np.random.Generator, reader: Reader) -> str:
    """Damage files of a folder, once, twice or three times; says how."""
    done = []
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        files = sorted(path for path in folder.glob(reader.damaged) if regular(path))
        if not files:
            break
        path = files[random.integers(len(files))]
        kinds = IN_FOLDERS if random.random() < 0.1 else BYTES
        if kinds is BYTES and path.suffix in IN_TEXTS and random.random() < 0.6:
            kinds = TEXT
        change = kinds[random.integers(len(kinds))]
        if kinds is IN_FOLDERS:
            change(path, random)
        elif path.stat().st_size:
            data = bytearray(path.read_bytes())
            change(data, random)
            path.write_bytes(data)
        done.append(f"{change.__name__} {path.relative_to(folder)}")
    return ", ".join(done)


def regular(path: Path) -> bool:
    """Whether it is a file and no link."""
    return path.is_file() and not path.is_symlink()


def attempt(name: str, seed: int, place: Path) -> tuple[str, str]:
    """Damage a copy of the files of a reader in a new folder ``place``, and read it.

    Returns:
        What was done; and `read`, `refused`, `changed` (other content than what a hash protects) or
        the name of an exception and the line that raised it.
    """
    reader, random = READERS[name], np.random.default_rng((seed, len(name)))
    shutil.copytree(whole(name), place)
    done = damage(place, random, reader)
    try:
        found = reader.read(place)
    except GftorfError:
        return done, "refused"
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        return done, f"{type(error).__name__} in {Path(at.filename).name}:{at.lineno}"
    if reader.protected and not same(found, reader.read(whole(name))):
        return done, "changed"
    return done, "read"


def same(one: object, other: object) -> bool:
    """Whether two results of a reader agree to the bit."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return one == other
