"""``gftorf import arrays``: every format and order of the same raw frames gives one capture."""

import re
import struct
import sys

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
from foreign import FRAMES, SIZE, ZERO, keys, recording

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.check import check
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.data.pictures import read_picture
from gftorf_warp.errors import InputError, ResourceError, UsageError
from gftorf_warp.importers.command import read_recording

W, H = SIZE


def pictures(root, codes, suffix, offset=ZERO, name="{:d}", dtype=np.uint16):
    """One picture for each raw frame; names without leading zeros."""
    for n, image in enumerate(codes):
        assert cv2.imwrite(str(root / f"{name.format(n)}{suffix}"), (image + offset).astype(dtype))


def exr(path, **channels):
    """An OpenEXR file of float32 channels."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(
        header, {c: np.ascontiguousarray(i, np.float32) for c, i in channels.items()}
    ).write(str(path))


def npy_each(root, codes):
    """A file for each raw frame, float64."""
    for n, image in enumerate(codes):
        np.save(root / f"quad_{n}.npy", image.astype(float))
    return {"values__zero": 0}


def npy_stack(root, codes):
    """A big-endian stack with rows last."""
    np.save(root / "stack.npy", np.asfortranarray(codes.transpose(2, 0, 1).astype(">i4")))
    return {"values__zero": 0, "source__axes": "columns frames rows"}


def npz_slots(root, codes):
    """Cycles and slots; what is beyond the last whole cycle is lost. Another array beside it."""
    np.savez_compressed(root / "a.npz", quads=codes[:8].reshape(2, 4, H, W), other=np.eye(3))
    return {
        "values__zero": 0,
        "source__axes": "cycles,slots,rows,columns",
        "source__dataset": "quads",
    }


def hdf5(root, codes):
    """Chunked and packed, the only images among times and texts."""
    with h5py.File(root / "a.h5", "w") as file:
        file.create_dataset("raw/frames", data=codes, compression="gzip", chunks=(2, H, W))
        file["times"] = np.arange(9.0)
        file["name"] = "camera"
    return {"values__zero": 0}


def mat(root, codes):
    """MATLAB's order of axes."""
    images = codes.transpose(1, 2, 0)
    scipy.io.savemat(root / "a.mat", {"quads": images, "n": 9.0}, do_compression=True)
    return {"values__zero": 0, "source__axes": "rows columns frames", "source__dataset": "quads"}


def mat73(root, codes):
    """The same as MATLAB 7.3 stores it: HDF5 behind 512 bytes, axes reversed."""
    with h5py.File(root / "a.mat", "w", userblock_size=512) as file:
        file["quads"] = codes.transpose(1, 2, 0).T
    with open(root / "a.mat", "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return {"values__zero": 0, "source__axes": "rows columns frames"}


def png(root, codes):
    """16 bits, 0.png to 8.png and 9.png, .. up to two digits."""
    pictures(root, codes, ".png", name="q_{:d}")
    return {}


def tiff_high_bits(root, codes):
    """12 bits at the top of 16."""
    pictures(root, codes.astype(np.int32) * 16, ".tiff", offset=ZERO * 16)
    return {"values__bits": 12, "values__lowest_bit": 4}


def tiff_pages(root, codes):
    """All raw frames as pages of one file, signed."""
    assert cv2.imwritemulti(str(root / "a.tif"), list(codes))
    return {"values__zero": 0}


def twos_complement(root, codes):
    """Signed numbers of 12 bits in unsigned pictures."""
    pictures(root, codes.astype(np.int32) & 0xFFF, ".png", offset=0)
    return {"values__zero": 0, "values__bits": 12, "values__twos_complement": True}


def exr_each(root, codes):
    """One channel of any name."""
    for n, image in enumerate(codes):
        exr(root / f"{n:03d}.exr", Y=image)
    return {"values__zero": 0}


def raw_stack(root, codes):
    """Big-endian, headers before the file and before each image."""
    parts = [
        b"HEAD" + struct.pack(">H", n) + image.astype(">u2").tobytes()
        for n, image in enumerate(codes + ZERO)
    ]
    (root / "a.bin").write_bytes(b"file" + b"".join(parts))
    return {
        "raw__type": "uint16",
        "raw__shape": [H, W],
        "raw__big_endian": True,
        "raw__header_bytes": 4,
        "raw__item_header_bytes": 6,
    }


def raw_each(root, codes):
    """A file for each raw frame, columns first."""
    for n, image in enumerate(codes):
        (root / f"{n}.raw").write_bytes(np.ascontiguousarray(image.T, "<i2").tobytes())
    return {
        "values__zero": 0,
        "raw__type": "int16",
        "raw__shape": [H],
        "source__axes": "columns rows",
    }


def by_slot(root, codes):
    """A file for each slot, as phase0.npy, phase180.npy, ..; other files beside them."""
    for slot, degrees in enumerate((0, 180, 90, 270)):
        np.save(root / f"phase{degrees}.npy", codes[slot::4])
    np.save(root / "dark.npy", np.eye(3))
    names = [f"phase{degrees}.npy" for degrees in (0, 180, 90, 270)]
    return {"values__zero": 0, "source__files": names}


def two_taps(root, codes):
    """Tap A and tap B in turn, on a common pedestal."""
    half = codes.astype(np.int32)
    for n, image in enumerate(half):
        a, b = 3000 + image - image // 2, 3000 - image // 2
        for tap, one in enumerate((a, b)):
            assert cv2.imwrite(str(root / f"{2 * n + tap}.png"), one.astype(np.uint16))
    return {"values__zero": 999, "sensor__taps": ["A", "B"]}


def taps_by_folder(root, codes):
    """The same in two folders, B first."""
    for tap, sign in (("A", 1), ("B", -1)):
        (root / tap).mkdir()
        whole = codes.astype(np.int32)
        part = whole - whole // 2 if sign > 0 else -(whole // 2)
        pictures(root / tap, part, ".png", offset=3000)
    return {"sensor__taps": ["B", "A"], "source__files": ["B/*.png", "A/*.png"]}


def taps_as_channels(root, codes):
    """A difference and a sum as channels of EXR files; the sum is not needed."""
    for n, image in enumerate(codes):
        exr(root / f"{n}.exr", sum=np.full_like(image, 7), diff=image)
    return {
        "values__zero": 0,
        "sensor__taps": ["A+B", "A-B"],
        "source__channels": ["sum", "diff"],
    }


def taps_axis(root, codes):
    """Taps as an axis of the array."""
    whole = codes.astype(np.int32)
    np.save(root / "a.npy", np.stack([whole - whole // 2, -(whole // 2)], axis=-1))
    return {
        "values__zero": 0,
        "source__axes": "frames rows columns taps",
        "sensor__taps": ["A", "B"],
    }


def other_tap(root, codes):
    """Tap B alone sees the opposite phase."""
    np.save(root / "a.npy", -codes)
    return {"values__zero": 0, "sensor__taps": ["B"], "expect": "opposite"}


WRITERS = (
    npy_each,
    npy_stack,
    npz_slots,
    hdf5,
    mat,
    mat73,
    png,
    tiff_high_bits,
    tiff_pages,
    twos_complement,
    exr_each,
    raw_stack,
    raw_each,
    by_slot,
    two_taps,
    taps_by_folder,
    taps_as_channels,
    taps_axis,
    other_tap,
)


def source_of(writer, tmp_path):
    """A folder that a writer made, and its TOML file."""
    root = tmp_path / "quads"
    root.mkdir()
    changes = writer(root, recording()[1])
    opposite = changes.pop("expect", None)
    (tmp_path / "keys.toml").write_text(keys(**changes))
    return root, tmp_path / "keys.toml", opposite


@pytest.mark.parametrize("writer", WRITERS, ids=lambda writer: writer.__name__)
def test_the_same_raw_frames_from_every_format(writer, tmp_path):
    """Codes bit by bit, shifts, times, poses, lens; the closed form of the capture is equal."""
    root, config, opposite = source_of(writer, tmp_path)
    out = tmp_path / "seq"
    line = ["import", "arrays", str(root), "--config", str(config), "--out", str(out), "-q"]
    assert main(line) == 0
    original, codes = recording()
    got = Sequence.open(out)
    frames = 8 if writer is npz_slots else FRAMES
    assert np.array_equal(got.quads, (-codes if opposite else codes)[:frames])
    assert got.measured.all()
    turned = np.pi if opposite else 0.0
    np.testing.assert_allclose(got.shifts, original.shifts[:frames] + turned, atol=1e-9)
    np.testing.assert_allclose(got.times, original.times[:frames], rtol=1e-12)
    assert got.intrinsics == original.intrinsics
    assert got.calibration.f_mod_hz == original.calibration.f_mod_hz
    check(out)
    scaled = Sequence(
        **{name: getattr(original, name) for name in ("measured", "shifts", "times")},
        quads=codes.astype(np.float32),
        camera_from_world=original.camera_from_world,
        intrinsics=original.intrinsics,
        calibration=original.calibration,
    )
    for quartet in range(2):
        expected = closed_form_distance(scaled, quartet)
        np.testing.assert_allclose(closed_form_distance(got, quartet), expected, atol=1e-4)


def imported(root, **changes):
    """A folder of arrays in memory."""
    path = root.parent / f"{root.name}.toml"
    path.write_text(keys(**changes))
    return read_recording("arrays", root, path)


def arrays(tmp_path, **stacks):
    """A folder with NumPy arrays."""
    root = tmp_path / "quads"
    root.mkdir(exist_ok=True)
    for name, array in stacks.items():
        np.save(root / f"{name}.npy", array)
    return root


def test_codes_that_are_no_measurement(tmp_path):
    """They become the value of the nearest raw frame of their slot, the earlier of two; a pixel
    that a slot never measured is dark in all. Both are counted.
    """
    codes = recording()[1].astype(np.uint16) + ZERO
    codes[4, 1, 2] = codes[0, 3, 3] = 64002
    codes[5, 2, 2] = 64003
    codes[[3, 7], 0, 0] = 64002
    found = imported(arrays(tmp_path, a=codes), values__invalid=[64002], values__saturated=[64003])
    quads, original = found.sequence.quads, recording()[1]
    assert quads[4, 1, 2] == original[0, 1, 2]
    assert quads[0, 3, 3] == original[4, 3, 3]
    assert quads[5, 2, 2] == original[1, 2, 2]
    assert not quads[:, 0, 0].any()
    untouched = codes < 64000
    untouched[:, 0, 0] = False
    assert np.array_equal(quads[untouched], original[untouched])
    text = "\n".join(found.uncertain)
    for words in (
        "4 values (0.23%) are invalid",
        "1 values (0.06%) are saturated",
        "1 pixels have",
    ):
        assert words in text
    floats = codes.astype(float)
    floats[codes > 64000] = np.nan
    assert np.array_equal(imported(arrays(tmp_path, a=floats)).sequence.quads, quads)


def test_missing_raw_frames(tmp_path):
    """A gap in the numbers is a warning, or, if they count raw frames, a missing one."""
    root = tmp_path / "quads"
    root.mkdir()
    codes = recording()[1]
    for n in (3, 4, 6, 7, 10):
        np.save(root / f"f_{n}.npy", codes[n - 3])
    found = imported(root, values__zero=0)
    assert found.sequence.frames == 5
    assert any("jump before 6" in text for text in found.uncertain)
    found = imported(root, values__zero=0, source__numbered=True).sequence
    assert found.measured.tolist() == [True, True, False, True, True, False, False, True]
    assert np.array_equal(found.quads[7], codes[7])
    assert found.times[7] == pytest.approx(7 * recording()[0].times[1])
    found = imported(root, values__zero=0, source__numbered=True)
    assert any("f_3.npy is taken as raw frame 0" in text for text in found.uncertain)


def test_half_precision_loses_nothing_more(tmp_path):
    """The zero is subtracted in double precision, whatever the stored type."""
    codes = (recording()[1] / 64.0).astype(np.float16)
    found = imported(arrays(tmp_path, a=codes), values__zero=2000.25)
    assert np.array_equal(found.sequence.quads, (codes.astype(float) - 2000.25).astype("f4"))


def test_every_decision_is_stated(tmp_path):
    """Format, axes, codes, sensor, times, lens and poses, with where they are from."""
    found = imported(arrays(tmp_path, a=recording()[1]), values__zero=0)
    text = "\n".join(found.understood)
    for words in (
        "9 x 12 x 16 int16 as frames, rows, columns (default)",
        "quad = code - 0 (values.zero)",
        "shifts 0, 180, 90, 270 degrees",
        "raw frames per second, evenly",
        "cx, cy + 0.5, since its pixel centres are integer (default)",
        "the camera stands still (default)",
    ):
        assert words in text, words
    assert found.uncertain == ("the last cycle has 1 of 4 raw frames",)
    small = imported(arrays(tmp_path, a=(recording()[1] // 16 + 128).astype(np.uint8)))
    assert any("8 bits" in text for text in small.uncertain)
    large = imported(arrays(tmp_path, a=recording()[1].astype(np.int64) + (1 << 30)))
    assert any("rounded to float32" in text for text in large.uncertain)


def test_several_frequencies(tmp_path):
    """Three shifts at each of two frequencies; the B tap is half a turn later at both."""
    codes = recording()[1]
    shifts = [0, 120, 240] * 2
    changes = {"sensor__f_mod_hz": [20e6] * 3 + [60e6] * 3, "sensor__shifts_deg": shifts}
    found = imported(arrays(tmp_path, a=codes), values__zero=0, **changes).sequence
    assert found.cycle == 6
    assert found.frequencies == (20e6, 60e6)
    assert found.frame_frequencies.tolist() == [20e6] * 3 + [60e6] * 3 + [20e6] * 3


def test_a_stack_is_a_source_itself(tmp_path):
    """One file in place of a folder; its exposure is kept, and other files are not named."""
    root = arrays(tmp_path, a=recording()[1], other=np.eye(3))
    config = tmp_path / "keys.toml"
    config.write_text(keys(values__zero=0, time__exposure_s=0.002))
    found = read_recording("arrays", root / "a.npy", config).sequence
    assert np.array_equal(found.quads, recording()[1])
    assert found.exposures.tolist() == [0.002] * FRAMES
    config.write_text(keys(values__zero=0, source__files=["other.npy"]))
    with pytest.raises(InputError, match="is a file"):
        read_recording("arrays", root / "a.npy", config)


def test_hdf5_without_its_package(tmp_path, monkeypatch):
    """The error names the extra to install."""
    root, config, _ = source_of(hdf5, tmp_path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ResourceError, match=r"gftorf-warp\[import\]"):
        read_recording("arrays", root, config)


def test_check_says_what_a_wrong_zero_lacks(tmp_path):
    """As docs/import.md promises: the number to add to values.zero, in codes."""
    root = arrays(tmp_path, a=recording()[1] + 300)
    out, config = tmp_path / "seq", tmp_path / "keys.toml"
    for zero, lacks in ((0, 300), (300, None)):
        config.write_text(keys(values__zero=zero))
        line = f"import arrays {root} --config {config} --out {out}{zero}"
        assert main(line.split()) == 0
        warnings = [text for text in check(f"{out}{zero}").warnings if "adc_zero" in text]
        found = [float(re.search(r"= ([\d.]+)", text)[1]) for text in warnings]
        assert found == ([] if lacks is None else [pytest.approx(lacks, abs=10)])


def good(tmp_path):
    """A folder of nine NumPy arrays that imports."""
    root = tmp_path / "quads"
    root.mkdir()
    for n, image in enumerate(recording()[1]):
        np.save(root / f"{n}.npy", image)
    return root


def replaced(name, content):
    """A change of a folder: a file with other content."""

    def change(root):
        if isinstance(content, bytes):
            (root / name).write_bytes(content)
        else:
            np.save(root / name, content)

    return change


def only(name, content):
    """A change of a folder: this file alone."""

    def change(root):
        for path in root.iterdir():
            path.unlink()
        replaced(name, content)(root)

    return change


def cut(root):
    """The fifth array loses its end."""
    data = (root / "4.npy").read_bytes()
    (root / "4.npy").write_bytes(data[:-7])


def link(root):
    """The fifth array is a link to a file elsewhere."""
    (root / "4.npy").rename(root.parent / "4.npy")
    (root / "4.npy").symlink_to(root.parent / "4.npy")


def folder(root):
    """The fifth array is a folder."""
    (root / "4.npy").unlink()
    (root / "4.npy").mkdir()


def hdf5_link(root):
    """An HDF5 file whose images are in another file."""
    only("a.h5", b"")(root)
    with h5py.File(root.parent / "b.h5", "w") as other:
        other["quads"] = recording()[1]
    with h5py.File(root / "a.h5", "w") as file:
        file["quads"] = h5py.ExternalLink("../b.h5", "quads")


def hdf5_virtual(root):
    """An HDF5 file with a view of images in another file."""
    hdf5_link(root)
    layout = h5py.VirtualLayout((9, H, W), "i2")
    layout[:] = h5py.VirtualSource("../b.h5", "quads", (9, H, W))
    with h5py.File(root / "a.h5", "w") as file:
        file.create_virtual_dataset("quads", layout)


def hdf5_unwritten(root):
    """A dataset that claims a terabyte and holds nothing."""
    only("a.h5", b"")(root)
    with h5py.File(root / "a.h5", "w") as file:
        file.create_dataset("quads", (1 << 20, 1000, 1000), "u1", chunks=(1, 1000, 1000))


def picture(image, suffix=".png"):
    """A picture as bytes."""
    return cv2.imencode(suffix, image)[1].tobytes()


def npz_bomb(root):
    """An archive whose directory claims four gigabytes."""
    only("a.npz", b"")(root)
    np.savez_compressed(root / "a.npz", quads=recording()[1])
    data = bytearray((root / "a.npz").read_bytes())
    size = data.index(b"PK\1\2") + 24
    data[size : size + 4] = b"\xf0\xff\xff\xff"
    (root / "a.npz").write_bytes(data)


HUGE_PNG = bytearray(picture(np.ones((H, W), np.uint16)))
HUGE_PNG[16:24] = struct.pack(">2I", 1 << 30, 1 << 30)
ROUND_TIFF = b"II*\0" + struct.pack("<IHHHII I", 8, 1, 256, 4, 1, 8, 8)
COLOUR = picture(np.ones((H, W, 3), np.uint16))
TALL = np.ones((9, 9000, 1), np.uint8)
OBJECTS = np.array([[None]])
BAD = [  # change of the folder, changed keys, a word of the error
    (only("a.txt", b"1"), {}, "no images"),
    (replaced("a.png", b"1"), {}, "found .npy, .png"),
    (cut, {}, "4.npy"),
    (link, {}, "a link out of the folder"),
    (folder, {"source__files": ["4.npy"]}, "matches '4.npy'"),
    (replaced("4.npy", b""), {}, "4.npy"),
    (replaced("4.npy", np.zeros((H, W + 1))), {}, "another size"),
    (replaced("4.npy", np.zeros((H, W), complex)), {}, "complex128"),
    (replaced("4.npy", np.zeros((H, W), bool)), {}, "bool"),
    (only("a.npy", np.array(["a"])), {}, "real numbers"),
    (only("a.npy", np.zeros((0, H, W))), {}, "a.npy"),
    (only("a.npy", np.zeros(7)), {}, "a name for each axis"),
    (only("a.npy", np.zeros((2, 4, H, W))), {}, "a name for each axis"),
    (only("a.npy", TALL), {}, "at most 8192"),
    (only("a.npy", np.zeros((8, H, W))), {"values__zero": 0}, "no light"),
    (good, {"source__axes": "rows columns frames"}, "a name for each axis"),
    (good, {"source__axes": "rows rows"}, "a name for each axis"),
    (good, {"source__axes": "height width"}, "'height width'"),
    (only("a.npy", np.ones((3, H, W))), {"source__axes": "slots rows columns"}, "4 slots"),
    (only("a.npy", np.ones((3, H, W))), {"source__axes": "taps rows columns"}, "1 taps"),
    (good, {"source__files": ["../quads/*.npy", "b*.npy"]}, "source.files"),
    (good, {"source__files": ["*.npy", "*.npy"]}, "one for each of 4 slots"),
    (good, {"source__files": ["/etc/*"]}, "source.files"),
    (good, {"source__files": [f"{n}.npy" for n in (8, 1, 2)] + ["[3-5].npy"]}, "fewer images"),
    (good, {"source__files": [""]}, "source.files"),
    (good, {"sensor__taps": ["A", "B"]}, "end within a raw frame"),
    (good, {"sensor__taps": ["A+B"]}, "sensor.taps"),
    (good, {"sensor__taps": ["A-B", "A"]}, "sensor.taps"),
    (good, {"values__bits": 17}, "17 from bit 0"),
    (replaced("4.npy", np.zeros((H, W))), {"values__bits": 12}, "float64"),
    (only("a.npz", b"PK\3\4"), {}, "a.npz"),
    (npz_bomb, {}, "4294967280 bytes packed into"),
    (only("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(500)), {}, "HDF5"),
    (hdf5_link, {}, "no such dataset"),
    (hdf5_virtual, {}, "a link out of the file"),
    (hdf5_unwritten, {}, "not complete"),
    (only("a.mat", b"MATLAB 5.0"), {}, "a.mat"),
    (only("a.png", COLOUR), {}, "one channel, found 3"),
    (only("a.png", bytes(HUGE_PNG)), {}, "1 to 8192 pixels"),
    (only("a.png", COLOUR[:20]), {}, "20 bytes"),
    (only("a.png", COLOUR[:80]), {}, "whole PNG"),
    (only("a.tif", b"II*\0\x08"), {}, "a PNG or a TIFF"),
    (only("a.tif", ROUND_TIFF), {}, "a circle"),
    (only("a.tif", b"II+\0" + bytes(40)), {}, "BigTIFF"),
    (only("a.exr", b"v/1\x01"), {}, "a.exr"),
    (
        only("a.bin", bytes(2 * H * W + 1)),
        {"raw__type": "int16", "raw__shape": [H, W]},
        "whole number",
    ),
    (only("a.bin", bytes(9)), {"raw__type": "int16", "raw__shape": [H, W]}, "whole number"),
    (only("a.bin", bytes(9)), {}, "2 keys are missing"),
    (only("a.bin", bytes(9)), {"values__zero": None}, "3 keys are missing"),
    (replaced("999.npy", np.ones((H, W))), {"source__numbered": True}, "frames 0 to 999"),
    (replaced("b.npy", np.ones((H, W))), {"source__numbered": True}, "found b.npy"),
    (only("a1.npy", np.ones((9, H, W))), {"source__numbered": True}, "one file for each"),
    (good, {"camera__fx": 0.6}, "camera.fx"),
    (good, {"values__zeros": 3}, "did you mean values.zero"),
]


@pytest.mark.parametrize(("change", "changes", "word"), BAD)
def test_a_bad_recording_is_named(change, changes, word, tmp_path, capfd):
    """What, where, why and a fix, no traceback, nothing written."""
    root = good(tmp_path)
    if change is not good:
        change(root)
    config, out = tmp_path / "keys.toml", tmp_path / "seq"
    config.write_text(keys(**{"values__zero": 0} | changes))
    line = ["import", "arrays", str(root), "--config", str(config), "--out", str(out)]
    assert main(line) in (2, 3)
    error = capfd.readouterr().err
    assert word in error
    assert "Traceback" not in error
    assert "WARN:" not in error, "OpenCV's own messages"
    assert not out.exists()


FLIPPED = (npy_each, npz_slots, hdf5, mat, mat73, png, tiff_pages, exr_each)


@pytest.mark.parametrize("writer", FLIPPED, ids=lambda writer: writer.__name__)
def test_a_flipped_bit_never_crashes(writer, tmp_path):
    """It gives other numbers or a named error; headers are flipped more often than images."""
    root, config, _ = source_of(writer, tmp_path)
    path = sorted(root.iterdir())[0]
    whole, rng = path.read_bytes(), np.random.default_rng(3)
    refused = 0
    for _ in range(40):
        data = bytearray(whole)
        for at in rng.integers(0, min(len(data), rng.choice([64, 1024, len(data)])), 2):
            data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data[: rng.integers(len(data))] if rng.random() < 0.2 else data)
        try:
            read_recording("arrays", root, config)
        except (InputError, UsageError) as error:
            refused += "fix" in str(error)
    assert refused > 3


@pytest.mark.parametrize("damage", ["a byte", "the end"])
def test_a_damaged_png_is_named_and_nothing_else_is_printed(tmp_path, capfd, damage):
    """By the sum of its part, before a decoder sees it."""
    path = tmp_path / "a.png"
    values = np.random.default_rng(0).integers(0, 60_000, (64, 64)).astype(np.uint16)
    assert cv2.imwrite(str(path), values)
    assert np.array_equal(read_picture(path)[0], values)
    data = bytearray(path.read_bytes())
    data[3000] ^= 0x55
    path.write_bytes(data if damage == "a byte" else data[:2000])
    with pytest.raises(InputError, match="whole PNG"):
        read_picture(path)
    assert capfd.readouterr() == ("", "")
