"""Archives in place of a recording: refused by name, and nothing of them is unpacked."""

import bz2
import gzip
import io
import lzma
import tarfile
import tracemalloc
import zipfile

import numpy as np
import pytest
from foreign import keys, recording

from gftorf_warp.cli import main
from gftorf_warp.errors import InputError
from gftorf_warp.importers.command import read_recording
from gftorf_warp.importers.kinds import KINDS

LARGE = 1 << 26  # [bytes] unpacked


def zipped(**members):
    """A ZIP archive of members by name."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for name, member in members.items():
            file.writestr(name.replace("__", "/"), member)
    return content.getvalue()


def link():
    """A ZIP archive of a symbolic link."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        member = zipfile.ZipInfo("tof")
        member.external_attr = 0o120777 << 16
        file.writestr(member, "/etc")
    return content.getvalue()


def tar():
    """A tar archive whose member leads out of its folder."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as file:
        file.addfile(tarfile.TarInfo("../evil"))
    return content.getvalue()


def nested():
    """Archives in archives of one that unpacks to a thousand times its size."""
    content = zipped(zeros=bytes(LARGE))
    for _ in range(3):
        content = zipped(**{f"a{n}.zip": content for n in range(4)})
    return content


PLAIN = zipped(tof__0000=b"1", cams__K=b"2")
FILES = {
    "data.zip": PLAIN,
    "data": PLAIN,
    "empty.zip": zipped(),
    "path.zip": zipped(**{"..__..__evil": b"1"}),
    "bomb.zip": zipped(zeros=bytes(LARGE)),
    "nested.zip": nested(),
    "link.zip": link(),
    "cut.zip": PLAIN[: len(PLAIN) // 2],
    "data.tar": tar(),
    "data.tgz": gzip.compress(tar()),
    "data.tar.bz2": bz2.compress(tar()),
    "data.tar.xz": lzma.compress(tar()),
    "data.7z": b"7z\xbc\xaf\x27\x1c" + bytes(60),
    "data.rar": b"Rar!\x1a\x07\x01\x00" + bytes(60),
    "data.zst": b"\x28\xb5\x2f\xfd" + bytes(60),
}


@pytest.mark.parametrize("name", FILES)
def test_an_archive_is_refused_and_left_packed(name, tmp_path):
    """By its content, whatever its name; in little memory, without a file more than before."""
    path = tmp_path / "in" / name
    path.parent.mkdir()
    path.write_bytes(FILES[name])
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"found a .+ archive: nothing is unpacked"):
            read_recording("ftorf", path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20
    assert [*tmp_path.rglob("*")] == [path.parent, path]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_refuses_them(kind, tmp_path, capsys):
    """Even before it asks for keys; so do commands that read a sequence."""
    path = tmp_path / "data.zip"
    path.write_bytes(PLAIN)
    assert main(["import", kind, str(path), "--out", str(tmp_path / "out"), "-q"]) == 3
    assert "unpack it into a folder" in capsys.readouterr().err
    assert main(["check", str(path)]) == 3
    assert "a ZIP archive" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_arrays_that_look_like_archives_are_read(tmp_path):
    """NPZ is a ZIP archive of arrays, and raw pixels may begin as gzip does."""
    codes = recording()[1].astype("<i2")
    codes[0, 0, 0] = int.from_bytes(b"\x1f\x8b", "little", signed=True)
    np.savez_compressed(tmp_path / "a.npz", quads=codes)
    (tmp_path / "a.bin").write_bytes(codes.tobytes())
    config = tmp_path / "keys.toml"
    for name, more in (("a.npz", {}), ("a.bin", {"raw__type": "int16", "raw__shape": [12, 16]})):
        config.write_text(keys(values__zero=0, **more))
        found = read_recording("arrays", tmp_path / name, config)
        np.testing.assert_array_equal(found.sequence.quads, codes)
