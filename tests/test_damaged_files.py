"""Files that others wrote, or damaged: read, or refused by name; nothing else, and soon."""

import errno
import functools
import hashlib
import io
import json
import os
import shutil
import signal
import struct
import tempfile
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from damaged_files import READERS, attempt, whole
from hypothesis import given, settings
from hypothesis import strategies as st

from gftorf_warp import Run, Sequence
from gftorf_warp.data.exr import read_exr, write_exr
from gftorf_warp.data.texts import read_json, read_toml
from gftorf_warp.errors import InputError
from gftorf_warp.recon import checkpoint
from gftorf_warp.scene.falloff import read_falloff
from gftorf_warp.sim.mesh_file import read_mesh

LONG_S = 10  # no file of these sizes may take longer


@contextmanager
def limited():
    """Raise a TimeoutError in what takes too long."""

    def ring(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LONG_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@functools.cache
def read_once(name):
    """Make and read undamaged files without a time limit.

    What the limit interrupts may be a compilation of kernels, which Warp would repeat as an error
    wherever this process uses them.
    """
    READERS[name].read(whole(name))


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=8, deadline=None, derandomize=True, database=None)
@given(seed=st.integers(0, 2**31))
def test_damage_is_seen_or_does_not_matter(name, seed):
    """benchmarks/fuzz.py does the same some thousand times."""
    read_once(name)
    with tempfile.TemporaryDirectory() as folder, limited():
        done, outcome = attempt(name, seed, Path(folder) / "copy" / "files")
    assert outcome in ("read", "refused"), done


@pytest.mark.parametrize("name", READERS)
def test_undamaged_files_are_read(name):
    """Otherwise every damage would be refused."""
    READERS[name].read(whole(name))


@pytest.fixture
def folder(request, tmp_path):
    """A copy of the whole files of the reader that is the fixture's parameter."""
    copy = tmp_path / "files"
    shutil.copytree(whole(request.param), copy)
    return copy


def of(name):
    """Parametrise the fixture ``folder``."""
    return pytest.mark.parametrize("folder", [name], indirect=True)


@of("capture")
def test_a_folder_named_like_a_frame_is_refused(folder):
    """Its hash cannot be computed."""
    (folder / "tof/000003.exr").unlink()
    (folder / "tof/000003.exr").mkdir()
    with pytest.raises(InputError, match="found a folder"):
        Sequence.open(folder)


@of("capture")
@pytest.mark.parametrize("name", ["truth/000004.exr", "colour/000000.exr"])
def test_a_missing_file_that_the_manifest_names_is_noticed(folder, name):
    """Truth and colour may lack raw frames, but not those that were written; the second is the only
    one.
    """
    (folder / name).unlink()
    with pytest.raises(InputError, match=r"MANIFEST.sha256 names it"):
        Sequence.open(folder).truth()


@of("capture")
def test_a_manifest_that_is_no_file_protects_nothing(folder):
    """So it is an error; it was ignored."""
    (folder / "MANIFEST.sha256").unlink()
    (folder / "MANIFEST.sha256").mkdir()
    with pytest.raises(InputError, match="found a folder"):
        Sequence.open(folder)


@of("F-ToeRF")
@pytest.mark.parametrize("name", ["tofType1/0001.npy", "cams/tof_intrinsics.npy", "color"])
def test_no_link_leads_out_of_a_sequence(folder, name, tmp_path):
    """Nor does a link to a folder; one inside of it is fine."""
    (folder / name).rename(tmp_path / "outside")
    (folder / name).symlink_to(tmp_path / "outside")
    with pytest.raises(InputError, match="link out of the folder"):
        Sequence.open(folder)
    (folder / name).unlink()
    (tmp_path / "outside").rename(folder / "inside")
    (folder / name).symlink_to(folder / "inside")
    Sequence.open(folder)


@of("F-ToeRF")
def test_a_folder_that_cannot_be_listed_is_named(folder, monkeypatch):
    """Permissions do not bind root, who may run the tests."""
    scandir = os.scandir

    def refusing(path):
        if Path(path).name == "cams":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    with pytest.raises(InputError, match=r"cams\n.*Permission denied"):
        Sequence.open(folder)


@of("checkpoint")
def test_a_checkpoint_that_is_gone_is_named(folder, caplog):
    """Its SHA-256 is still there; the run went back without a word."""
    newest = sorted((folder / "ckpt").glob("*.pt"))[-1]
    newest.unlink()
    run = Run.open(folder)
    assert run.config["damaged_checkpoints"] == [newest.name]
    assert newest.name in caplog.text


def stored_as(path, data):
    """Put bytes where a checkpoint belongs, with the right SHA-256."""
    path.parent.mkdir()
    path.write_bytes(data)
    path.with_suffix(".pt.sha256").write_text(hashlib.sha256(data).hexdigest() + "  " + path.name)


def bytes_of(content):
    """Return what torch writes."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def test_a_tensor_is_no_larger_than_its_file(tmp_path):
    """A stride of zero makes terabytes of one number."""
    path = tmp_path / "ckpt" / "0000000001.pt"
    stored_as(path, bytes_of({"format": 1, "images": 1, "x": torch.zeros(1).expand(1 << 40)}))
    with pytest.raises(InputError, match="unreadable checkpoint"):
        checkpoint.load(path)


def test_a_checkpoint_is_not_packed(tmp_path):
    """Torch compresses nothing; zeros would unpack to a thousand times the file."""
    packed = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(bytes_of({"format": 1, "images": 1}))) as archive,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as other,
    ):
        for member in archive.infolist():
            other.writestr(member.filename, archive.read(member))
    path = tmp_path / "ckpt" / "0000000001.pt"
    stored_as(path, packed.getvalue())
    with pytest.raises(InputError, match="unreadable checkpoint"):
        checkpoint.load(path)


@of("checkpoint with its hash")
@pytest.mark.parametrize(
    "change",
    [
        lambda stored: stored["field"].update(colour=stored["field"].pop("log_scale")),
        lambda stored: stored["field"].update(mean=stored["field"]["mean"][:-1]),
        lambda stored: stored.update(motion={"kind": stored["motion"]["kind"]}),
        lambda stored: stored.update(attachment="none"),
        lambda stored: stored.pop("field"),
    ],
)
def test_a_checkpoint_whose_parts_do_not_fit_is_refused(folder, change):
    """A flipped bit in a name raised a TypeError."""
    stored = checkpoint.last(folder)
    change(stored)
    checkpoint.save(folder, stored)
    with pytest.raises(InputError, match="the parts of the checkpoint do not fit"):
        Run.open(folder)


def png(width, height):
    """Return a PNG file that claims a size and has no pixel."""
    header = struct.pack(">2I5B", width, height, 16, 6, 0, 0, 0)
    chunk = b"IHDR" + header
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", 0)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("map.png", png(60_000, 60_000)),
        ("map.png", png(8000, 8000)),
        ("map.npy", b"\x93NUMPY\x01\x00\x76\x00" + b"{'descr': '<f8', 'shape': (" + b" " * 91),
        (
            "map.npy",
            b"\x93NUMPY\x01\x00\x76\x00"
            + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999, 99999999)}".ljust(118),
        ),
    ],
)
def test_headers_that_claim_too_much_are_refused(tmp_path, name, content):
    """Before memory is allocated: the last one claims 80 petabytes."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError):
        read_falloff(tmp_path / name)


def test_an_exr_file_holds_no_more_than_it_can(tmp_path):
    """Two channels of 8000x8000 in a kilobyte."""
    path = tmp_path / "a.exr"
    write_exr(path, {"X": np.ones((4, 6)), "Y": np.ones((4, 6))})
    data, window = path.read_bytes(), struct.pack("<4i", 0, 0, 5, 3)
    assert data.count(window) == 2
    path.write_bytes(data.replace(window, struct.pack("<4i", 0, 0, 7999, 7999)))
    with pytest.raises(InputError, match="bytes claimed by a file of"):
        read_exr(path)


def test_a_mesh_without_vertices_is_refused(tmp_path):
    """Its faces name some."""
    (tmp_path / "a.obj").write_text("f 1 2 3\nf 1 2 4\n")
    with pytest.raises(InputError):
        read_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (read_json, json.dumps({"a": 1})[:-2] + "[" * 100 + "]" * 100 + "}"),
        (read_toml, "a = " + "[" * 100 + "]" * 100),
        (read_json, "[" * 100_000),
        (read_toml, "a = " + "[" * 100_000),
        (read_toml, ".".join("a" * 5000) + " = 1"),
    ],
)
def test_nested_texts_are_refused(tmp_path, read, text):
    """By name, whether the parser gives up or what it returns is too deep for recursion."""
    path = tmp_path / "text"
    path.write_text(text)
    with limited(), pytest.raises(InputError):
        read(path)
