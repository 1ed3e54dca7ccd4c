"""Writing is all or nothing; pictures come back as they were."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp.data.exr import read_exr, write_exr
from gftorf_warp.data.files import atomic_folder, atomic_write, write_json
from gftorf_warp.data.images import indexed_png_bytes, png_bytes
from gftorf_warp.errors import InputError, ResourceError, UsageError


def names(folder):
    """Everything in a folder, temporary files included."""
    return sorted(entry.name for entry in folder.iterdir())


def test_atomic_write_replaces_and_leaves_nothing_else(tmp_path):
    """The new content is there and no temporary file."""
    atomic_write(tmp_path / "a.bin", b"old")
    atomic_write(tmp_path / "a.bin", b"new")
    assert (tmp_path / "a.bin").read_bytes() == b"new"
    assert names(tmp_path) == ["a.bin"]


def test_a_failed_write_keeps_the_old_content(tmp_path, monkeypatch):
    """A disk that fails to flush costs the new content only."""
    atomic_write(tmp_path / "a.bin", b"old")
    monkeypatch.setattr(
        os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    with pytest.raises(ResourceError) as caught:
        atomic_write(tmp_path / "a.bin", b"new")
    assert caught.value.exit_code == 5
    assert "a.bin" in caught.value.where
    assert (tmp_path / "a.bin").read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


@pytest.mark.skipif(
    sys.platform != "linux", reason="limits of file size are tested where the system has them"
)
@pytest.mark.parametrize(
    "write",
    ["atomic_write(sys.argv[1], content.tobytes())", "write_exr(sys.argv[1], {'a': content})"],
)
def test_a_full_disk_is_an_error_with_exit_code_5(tmp_path, write):
    """A limit on the size of files stands in for a full disk."""
    program = (
        "import resource, signal, sys\n"
        "import numpy as np\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "from gftorf_warp.data.files import atomic_write\n"
        "from gftorf_warp.data.exr import write_exr\n"
        "from gftorf_warp.errors import ResourceError\n"
        "content = np.random.default_rng(0).normal(size=(60, 70))\n"
        "try:\n    {write}\n"
        "except ResourceError as error:\n    sys.exit(error.exit_code)\n"
    ).replace("{write}", write)
    # -B: no bytecode cut off by the limit
    command = [sys.executable, "-B", "-c", program, str(tmp_path / "a.bin")]
    done = subprocess.run(command, check=False, capture_output=True)
    assert done.returncode == 5, done.stderr
    assert names(tmp_path) == []


def test_a_missing_folder_is_a_usage_error(tmp_path):
    """Whoever writes, the place is named."""
    for write, content in (
        (atomic_write, b"x"),
        (write_json, {}),
        (write_exr, {"a": np.zeros((2, 3))}),
    ):
        with pytest.raises(UsageError) as caught:
            write(tmp_path / "nowhere" / "a.bin", content)
        assert caught.value.exit_code == 2
        assert "nowhere" in caught.value.where


def test_leftovers_of_dead_processes_are_swept_and_of_living_ones_kept(tmp_path):
    """Only temporaries of the same name whose process is gone."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    for name in (
        f".a.bin.tmp-{dead.pid}-0",
        f".a.bin.tmp-{os.getpid()}-999999",
        f".b.bin.tmp-{dead.pid}-0",
    ):
        (tmp_path / name).write_bytes(b"half")
    (tmp_path / f".a.bin.tmp-{dead.pid}-1").mkdir()
    atomic_write(tmp_path / "a.bin", b"whole")
    assert names(tmp_path) == [
        f".a.bin.tmp-{os.getpid()}-999999",
        f".b.bin.tmp-{dead.pid}-0",
        "a.bin",
    ]


def test_json_is_plain_and_refuses_what_json_cannot_say(tmp_path):
    """Numbers of numpy and paths become plain values; NaN and objects are mistakes."""
    content = {
        "a": np.float32(0.5),
        "b": np.arange(2),
        "c": tmp_path,
        "d": None,
        "e": np.bool_(True),
    }
    write_json(tmp_path / "m.json", content)
    assert json.loads((tmp_path / "m.json").read_text()) == {
        "a": 0.5,
        "b": [0, 1],
        "c": str(tmp_path),
        "d": None,
        "e": True,
    }
    for bad, error in ((float("nan"), ValueError), (object(), TypeError)):
        with pytest.raises(error):
            write_json(tmp_path / "bad.json", {"a": bad})
    assert names(tmp_path) == ["m.json"]


def test_a_folder_appears_only_when_it_is_complete(tmp_path):
    """An exception half way leaves nothing, not even the parent that was made for it."""
    target = tmp_path / "new" / "seq"

    def fail_half_way():
        with atomic_folder(target) as folder:
            (folder / "half").write_bytes(b"1")
            assert not target.exists()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert names(tmp_path) == []
    with atomic_folder(target) as folder:
        (folder / "whole").write_bytes(b"1")
    assert names(target) == ["whole"]
    assert names(tmp_path / "new") == ["seq"]


def test_a_folder_is_never_overwritten(tmp_path):
    """An empty folder may be filled; a full one, or a file, stays as it is."""
    (tmp_path / "seq").mkdir()
    with atomic_folder(tmp_path / "seq") as folder:
        (folder / "first").write_bytes(b"1")
    (tmp_path / "file").write_bytes(b"1")
    for name in ("seq", "file"):
        with pytest.raises(UsageError) as caught, atomic_folder(tmp_path / name):
            pass
        assert caught.value.exit_code == 2
        assert name in caught.value.where
    assert names(tmp_path / "seq") == ["first"]


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    count=st.integers(1, 5),
    seed=st.integers(0, 2**16),
)
def test_exr_gives_back_every_bit(tmp_path_factory, height, width, count, seed):
    """Any size, any number of channels, NaN included."""
    generator = np.random.default_rng(seed)
    images = {
        f"part.{n}": generator.normal(size=(height, width)).astype(np.float32) for n in range(count)
    }
    images["part.0"].flat[0] = np.nan
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    write_exr(path, images)
    back = read_exr(path)
    assert back.keys() == images.keys()
    for name, image in images.items():
        assert back[name].dtype == np.float32
        np.testing.assert_array_equal(back[name], image)


@pytest.mark.parametrize(
    "names", [["distance", "opacity"], ["quad_000", "B", "a.b", "é"], ["n" * 32, "n" * 31]]
)
def test_exr_is_what_openexr_itself_writes_uncompressed(tmp_path, names):
    """Byte by byte, names of any length and order included;
    so whatever reads that library's files reads ours.
    """
    import OpenEXR

    images = {
        name: np.random.default_rng(k).random((5, 7), dtype=np.float32)
        for k, name in enumerate(names)
    }
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, dict(images)) as file:
        file.write(str(tmp_path / "theirs.exr"))
    write_exr(tmp_path / "ours.exr", images)
    assert (tmp_path / "ours.exr").read_bytes() == (tmp_path / "theirs.exr").read_bytes()


def test_exr_of_slices_flips_and_fortran_order_holds_the_right_pixels(tmp_path):
    """OpenEXR's own writer puts wrong pixels there, and says nothing."""
    whole = np.arange(48.0).reshape(6, 8)
    images = {
        "slice": whole[::2, 1::3],
        "flip": whole[2::-1, 2::-1],
        "fortran": np.asfortranarray(whole[:3, :3]),
    }
    write_exr(tmp_path / "a.exr", images)
    for name, image in read_exr(tmp_path / "a.exr").items():
        np.testing.assert_array_equal(image, images[name].astype(np.float32), err_msg=name)
    assert names(tmp_path) == ["a.exr"]


PRINTING = """
import sys, threading
from gftorf_warp.data.exr import read_exr

sys.setswitchinterval(1e-6)
ended = threading.Event()

def read():
    while not ended.is_set():
        read_exr(sys.argv[1])

threads = [threading.Thread(target=read) for _ in range(2)]
for thread in threads:
    thread.start()
for k in range(20000):
    print(k)
ended.set()
for thread in threads:
    thread.join()
"""


def test_one_thread_prints_while_others_read_exr(tmp_path):
    """Reading replaces stdout to silence OpenEXR: the replaced stream must not be freed."""
    write_exr(tmp_path / "a.exr", {"Z": np.zeros((2, 3))})
    command = [sys.executable, "-c", PRINTING, str(tmp_path / "a.exr")]
    result = subprocess.run(command, check=False, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.split() == [str(k) for k in range(20000)]


@pytest.mark.parametrize(
    "images", [{}, {"a": np.zeros((2, 3)), "b": np.zeros((3, 2))}, {"a": np.zeros(4)}]
)
def test_exr_needs_images_of_one_size(tmp_path, images):
    """Anything else is a programming mistake."""
    with pytest.raises(ValueError, match="one shape"):
        write_exr(tmp_path / "a.exr", images)
    assert names(tmp_path) == []


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.999])
def test_a_truncated_exr_is_refused(tmp_path, share):
    """The library returns the parts it could read, and no error."""
    write_exr(
        tmp_path / "a.exr", {n: np.random.default_rng(0).normal(size=(40, 30)) for n in "RGB"}
    )
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError) as caught:
        read_exr(tmp_path / "a.exr")
    assert caught.value.exit_code == 3
    assert "a.exr" in caught.value.where


def test_missing_and_foreign_exr_files_are_refused(tmp_path):
    """The file is named."""
    (tmp_path / "text.exr").write_text("no picture")
    for name in ("text.exr", "none.exr"):
        with pytest.raises(InputError) as caught:
            read_exr(tmp_path / name)
        assert name in caught.value.where


def test_png_keeps_red_red():
    """OpenCV stores blue first; ours are red first."""
    import cv2

    rgb = np.zeros((2, 3, 3), np.uint8)
    rgb[0, 0] = 250, 120, 10
    content = np.frombuffer(png_bytes(rgb[:, ::-1]), np.uint8)
    assert cv2.imdecode(content, cv2.IMREAD_COLOR)[0, 2].tolist() == [10, 120, 250]
    for bad in (rgb.astype(np.float32), rgb[..., 0]):
        with pytest.raises(ValueError, match="uint8"):
            png_bytes(bad)


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(height=st.integers(1, 300), width=st.integers(1, 300), colours=st.integers(1, 256))
def test_png_of_numbered_colours_is_that_picture(height, width, colours):
    """Of any size, also past the 64 KiB that a block of it holds; by two readers."""
    import io

    import cv2
    from matplotlib import image as mpl

    generator = np.random.default_rng(height * width)
    palette = generator.integers(0, 256, (colours, 3), dtype=np.uint8)
    index = generator.integers(0, colours, (height, width), dtype=np.uint8)
    content = indexed_png_bytes(index, palette)
    np.testing.assert_array_equal(
        cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], palette[index]
    )
    np.testing.assert_array_equal(
        np.round(255 * mpl.imread(io.BytesIO(content))[..., :3]), palette[index]
    )


def test_numbered_colours_are_bytes():
    """Anything else is a programming mistake."""
    good, palette = np.zeros((2, 3), np.uint8), np.zeros((4, 3), np.uint8)
    for index, colours in (
        (good.astype(int), palette),
        (good[0], palette),
        (good, palette[:, :2]),
        (good, palette / 2),
    ):
        with pytest.raises(ValueError, match="uint8"):
            indexed_png_bytes(index, colours)
