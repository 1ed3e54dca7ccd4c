"""Simulated recordings in the layout of every kind that ``gftorf import`` reads.

Each is a scene in which something moves, recorded with noise by our simulator, in the whole numbers
of the camera's converter, and written by code that shares nothing with the readers.
"""

import atexit
import functools
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cornell_folder
import cv2
import foreign
import kinect2_dump
import numpy as np
import test_import_arrays as arrays
import vxl
from test_import_espros import raw_frame, recorder
from test_import_mlx7502x import stored
from test_import_oak import frame
from test_import_poses import tum

from gftorf_warp import Sequence
from gftorf_warp.sim.simulate import simulate

SIZE = (16, 12)
QUARTER = (0.0, 90.0, 180.0, 270.0)  # [deg]
LARGEST = 1800  # code of the brightest pixel, of 12 bits with sign
PERIOD = 1 / 120  # [s] from one raw frame to the next
TAP = 2000  # code of a tap of 12 bits without modulated light


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A recording on disk, and what an import has to make of it."""

    kind: str
    source: Path
    keys: str = ""
    """Text of the TOML file; empty: none is needed."""
    quads: np.ndarray
    """The raw frames, to the bit or, where a pixel's phase is corrected, nearly."""
    exact: bool = True
    """Whether to the bit."""
    distance: np.ndarray
    """True distance [H, W] at the first raw frame [m]."""
    truth: Path | None = None
    """The simulated sequence, if raw frame n is its raw frame n."""
    has_truth: bool = False
    """Whether the import has a truth of its own."""
    reconstruct: tuple[str, ...] = ("--preset", "temporal")
    """Options of ``gftorf reconstruct``."""
    warnings: tuple[str, ...] = ()
    """Names of the warnings of ``gftorf check`` that are right."""


FITTED = ("--images", "8")  # best, which starts from measured phase


@functools.cache
def sequence(
    shifts=QUARTER, further=(), f_mod_hz=20e6, *, frames=8, size=SIZE, scene="demo", **changes
) -> Path:
    """Folder of a simulated capture, made once in a process."""
    place = Path(tempfile.mkdtemp(prefix="simulated-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    given = {"sensor.f_mod_hz": f_mod_hz, "sensor.frame_period_s": PERIOD}
    given["sensor.shifts"] = ",".join(repr(float(np.radians(shift))) for shift in shifts)
    if further:
        given["sensor.further_hz"] = ",".join(map(repr, further))
    given |= {f"sensor.{name}": value for name, value in changes.pop("sensor", ())}
    given["horizontal_fov_deg"] = changes.pop("horizontal_fov_deg", 60.0)
    overrides = tuple(f"{name}={value}" for name, value in given.items())
    options = {"engine": "mesh", "format": "capture", **changes}
    out = place / "sequence"
    return simulate(scene, out, frames=frames, size=size, overrides=overrides, **options)


def codes_of(path, largest=LARGEST):
    """The raw frames of a sequence as whole numbers [F, H, W]."""
    quads = Sequence.open(path).quads
    return np.rint(quads * (largest / np.abs(quads).max())).astype(int)


def camera(path):
    """The table of a lens, as OpenCV counts pixels."""
    lens = Sequence.open(path).intrinsics
    centre = f"cx = {lens.cx - 0.5!r}\ncy = {lens.cy - 0.5!r}"
    return f"[camera]\nfx = {lens.fx!r}\nfy = {lens.fy!r}\n{centre}\n"


def distance_of(path):
    """True distance at the first raw frame [m]."""
    return Sequence.open(path).truth().distance[0]


def by_camera(place, kind, content, keys, *, suffix="", **more):
    """A recording in one file, with its keys and the lens of the simulated camera."""
    source, path = place / f"recording{suffix}", sequence()
    source.write_bytes(content)
    return Recorded(
        kind=kind,
        source=source,
        keys=keys + camera(path),
        quads=codes_of(path),
        distance=distance_of(path),
        truth=path,
        **more,
    )


SENSOR = "[sensor]\nf_mod_hz = 20e6\n"
RATE = f"[time]\nrate_hz = {1 / PERIOD!r}\n"
SLOTS = f"[time]\nslot_period_s = {PERIOD!r}\n"
OF_CYCLES = f"[time]\ncycle_rate_hz = {0.25 / PERIOD!r}\nslot_period_s = {PERIOD!r}\n"


def espros(place):
    """Raw frames of a TOFcam."""
    quartets = codes_of(sequence()).reshape(-1, 4, *SIZE[::-1])
    content = b"".join(raw_frame(q + 2048) for q in quartets)
    return by_camera(place, "espros", content, SENSOR + RATE, reconstruct=FITTED)


def espros_hdf5(place):
    """The recorder of a TOFcam; it has a time for every quartet, here 50 ms apart."""
    quartets = codes_of(sequence()).reshape(-1, 4, *SIZE[::-1])
    recorder(place / "recording.h5", quartets, "DCS")
    content = (place / "recording.h5").read_bytes()
    return by_camera(place, "espros", content, SLOTS, suffix=".h5")


def mlx7502x(place):
    """Packed buffers of V4L2."""
    content = b"".join(stored(image, "Y12P") for image in codes_of(sequence()))
    raw = "[raw]\nformat = 'Y12P'\nsize = [16, 12]\n"
    sensor = f"{SENSOR}shifts_deg = {[*QUARTER]}\n"
    return by_camera(place, "mlx7502x", content, raw + sensor + RATE)


def voxel(place):
    """A .vxl file in quad mode; its frames are 50 ms apart."""
    quartets = codes_of(sequence()).reshape(-1, 4, *SIZE[::-1])
    assert (vxl.WIDTH, vxl.HEIGHT) == SIZE
    return by_camera(place, "voxel", vxl.content(quartets), SENSOR + OF_CYCLES)


def oak(place):
    """Two frequencies, four taps with ambient light, phases shuffled; a frame is one instant."""
    shuffled = (180.0, 270.0, 0.0, 90.0)
    path = sequence(QUARTER + shuffled, (100e6,), 80e6, frames=32, sync=True)
    codes = codes_of(path) + TAP
    parts = codes.reshape(-1, 4, 4, *SIZE[::-1])
    source = place / "raw"
    source.write_bytes(b"".join(map(frame, parts)))
    keys = "[raw]\nsize = [32, 104]\npart_rows = 24\n"
    keys += f"[time]\ncycle_rate_hz = {1 / 16 / PERIOD!r}\nslot_period_s = 0\n"
    return Recorded(
        kind="oak",
        source=source,
        keys=keys + camera(path),
        quads=codes,
        distance=distance_of(path),
        truth=path,
        reconstruct=("--input", "phasor", *FITTED),
        warnings=("constant part",),  # ambient light
    )


def kinect2(place):
    """A packet of 512x424, of a simulation of 64x53 whose pixels are repeated, with phase
    offsets of every pixel.
    """
    third, zoom = (0.0, -120.0, -240.0), 8
    path = sequence(third, (16e6, 120e6), 80e6, frames=9, size=(64, 53), sync=True)
    quads = codes_of(path, 6000).repeat(zoom, axis=1).repeat(zoom, axis=2)
    _, steps = kinect2_dump.scene()
    waves = np.exp(1j * np.radians(third))[:, None, None]
    groups = quads.reshape(3, 3, *quads.shape[1:])
    phasors = 2 / 3 * (groups * waves).sum(axis=1)
    turned = phasors * np.exp(-3.1e-5j * np.pi * steps)
    codes = kinect2_dump.code_of((turned[:, None] * waves.conj()).real.reshape(quads.shape))
    kinect2_dump.write_codes(place / "dump", [codes], steps, tables_too=False)
    lens = Sequence.open(path).intrinsics.scaled(zoom, zoom)
    keys = f"[camera]\nfx = {lens.fx}\nfy = {lens.fy}\ncx = {lens.cx}\ncy = {lens.cy}\n"
    wanted = (phasors[:, None] * waves.conj()).real.reshape(quads.shape)
    wanted[..., [0, -1]] = 0.0
    distance = distance_of(path).repeat(zoom, axis=0).repeat(zoom, axis=1)
    distance[:, [0, -1]] = np.nan
    return Recorded(
        kind="kinect2",
        source=place / "dump",
        keys=keys,
        quads=wanted,
        exact=False,
        distance=distance,
        reconstruct=("--preset", "ctof"),
    )


def cornell_box(place):
    """Instants of twelve images each, seen under 65 degrees, of which one tap takes one after the
    other.
    """
    shifts, frequencies = (0.0, -90.0, -180.0, -270.0), cornell_folder.FREQUENCIES_MHZ
    further = tuple(f * 1e6 for f in frequencies[1:])
    sensor = (("dc_offset", 1.5), ("unipolar", "true"), ("frame_period_s", PERIOD / 12))
    path = sequence(
        *(shifts, further, 1e6 * frequencies[0]),
        **{"frames": 96, "sync": True, "noise": False, "sensor": sensor},
        horizontal_fov_deg=65.0,
    )
    found, truth = Sequence.open(path), Sequence.open(path).truth()
    images = found.quads.astype(np.float64).reshape(-1, 3, 4, *SIZE[::-1])

    def colours(instant, f_mhz, image):
        values = images[instant, frequencies.index(f_mhz), image]
        return np.stack([r * values for r in cornell_folder.REFLECTANCES], axis=2)

    def distance(instant):
        return truth.distance[12 * instant]

    cornell_folder.write(place / "o_1", len(images), distance, colours)
    quads = [cornell_folder.stored(colours(n, 20, n % 4))[..., 0] for n in range(len(images))]
    return Recorded(
        kind="cornell_box",
        source=place / "o_1",
        quads=np.array(quads, np.float32),
        distance=distance(0),
        has_truth=True,
    )


def in_folder(form, place, **more):
    """A folder that our simulator writes, with its truth."""
    path = simulate("demo", place / form, frames=8, size=(48, 36), engine="mesh", format=form)
    quads, distance = Sequence.open(path).quads, distance_of(path)
    return Recorded(kind=form, source=path, quads=quads, distance=distance, has_truth=True, **more)


def ftorf(place):
    """Raw quads."""
    return in_folder("ftorf", place)


def torf(place):
    """Phasors."""
    return in_folder("torf", place, reconstruct=FITTED)


def of_arrays(writer, place):
    """The raw frames in one of the formats of kind ``arrays``."""
    path = sequence()
    codes = codes_of(path).astype(np.int16)
    (place / "quads").mkdir()
    sensor = {"sensor__f_mod_hz": 20e6, "sensor__shifts_deg": [*QUARTER]}
    return Recorded(
        kind="arrays",
        source=place / "quads",
        keys=foreign.keys(**sensor, **writer(place / "quads", codes)),
        quads=codes,
        distance=distance_of(path),
        truth=path,
    )


def phasors(place):
    """I and Q of every quartet, of whose quads nothing else is left."""
    path = sequence(sync=True)
    quads = codes_of(path).reshape(-1, 4, *SIZE[::-1])
    i, q = quads[:, 0] - quads[:, 2], quads[:, 1] - quads[:, 3]
    np.save(place / "iq.npy", np.stack([i, q], axis=1).astype(np.int16))
    changes = {
        "sensor__taps": ["I", "Q"],
        "source__axes": "frames taps rows columns",
        "sensor__f_mod_hz": 20e6,
        "sensor__shifts_deg": None,
        "time__rate_hz": 0.25 / PERIOD,
        "values__zero": 0,
    }
    return Recorded(
        kind="arrays",
        source=place / "iq.npy",
        keys=foreign.keys(**changes),
        quads=np.stack([i, -i, q, -q], axis=1).reshape(-1, *SIZE[::-1]) / 2,
        distance=distance_of(path),
        truth=path,
        reconstruct=FITTED,
    )


def colour(place):
    """A camera that is carried around, its poses as lines of the TUM benchmark, and colour images
    of 16 bits.
    """
    path = sequence(scene="tour", engine="gaussian")
    found, codes = Sequence.open(path), codes_of(path)
    quads = place / "quads"
    (quads / "c").mkdir(parents=True)
    arrays.pictures(quads, codes, ".png")
    white = max(image.max() for image in found.colour.images.values())
    for n, image in found.colour.images.items():
        picture = np.rint(image[..., ::-1] * (65535 / white)).astype(np.uint16)
        assert cv2.imwrite(str(quads / "c" / f"{n}.png"), picture)
    lens, own = found.intrinsics, found.colour.intrinsics
    matrix = found.camera_from_world[0] @ np.linalg.inv(found.colour.camera_from_world[0])
    changes = {
        "source__files": "*.png",
        "sensor__f_mod_hz": 20e6,
        "sensor__shifts_deg": [*QUARTER],
        "time__rate_hz": 1 / PERIOD,
        **{f"camera__{name}": getattr(lens, name) for name in ("fx", "fy")},
        **{f"camera__{name}": getattr(lens, name) - 0.5 for name in ("cx", "cy")},
        "colour__files": "c/*.png",
        "colour__encoding": "linear",
        "colour__rate_hz": 0.25 / PERIOD,
        "colour__tof_from_colour": matrix.tolist(),
        **{f"colour__{name}": getattr(own, name) for name in ("fx", "fy")},
        **{f"colour__{name}": getattr(own, name) - 0.5 for name in ("cx", "cy")},
        **tum(quads, found.camera_from_world),
    }
    return Recorded(
        kind="arrays",
        source=quads,
        keys=foreign.keys(**changes),
        quads=codes,
        distance=distance_of(path),
        truth=path,
        reconstruct=("--input", "phasor", *FITTED),
    )


WRITERS = {
    function.__name__: function
    for function in (
        *(espros, espros_hdf5, mlx7502x, voxel, oak, kinect2),
        *(cornell_box, ftorf, torf, phasors, colour),
    )
} | {
    f"arrays, {writer.__name__}": functools.partial(of_arrays, writer)
    for writer in (
        *(arrays.npy_each, arrays.npz_slots, arrays.hdf5, arrays.mat, arrays.png),
        *(arrays.tiff_pages, arrays.exr_each, arrays.raw_stack, arrays.two_taps),
    )
}
