"""Files that others wrote: the limits of all readers, how such a file is opened, and the error for
one that is not what its name says.

A reader compares what a header claims with these limits and with the size of the file before it
allocates anything.
"""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import InputError

SIDE_MAX = 8192  # [px] no C-ToF image is larger; a forged header would ask for terabytes
FRAMES_MAX = 1_000_000  # over two hours at 120 Hz: a higher id is a typing error
PARTS_MAX = 64  # of an EXR file: a raw frame has a handful; a forged header may claim millions
CHANNELS_MAX = 256  # of a part of an EXR file: a rendering has a few dozen
TEXT_MAX = 1 << 28  # 256 MB: a million lines of a pose, or raw frames of a capture
TOML_MAX = 1 << 20  # a table of keys has a few hundred
MESH_MAX = 1 << 28  # [bytes] a few million triangles: more takes the tracer minutes
DEPTH_MAX = 32  # nested lists and tables: our files have five
# .json and .mat calibration files hold a few numbers; a larger one is something else
SMALL_FILE_BYTES = 65_536
UNPACKED_MAX = 1 << 20  # [bytes] of a compressed matrix: calibration has a few hundred
PACKED_MAX = 1100  # bytes from one byte of a file: deflate packs at most 1032
# [bytes] that any file may claim, an image of float32: some codecs pack a constant one tighter
UNPACKED_LEAST = 4 * SIDE_MAX**2

ARCHIVES = {  # first bytes: name
    b"PK\3\4": "ZIP",
    b"PK\5\6": "ZIP",
    b"7z\xbc\xaf": "7-Zip",
    b"Rar!": "RAR",
    b"\xfd7zXZ": "xz",
    b"\x28\xb5\x2f\xfd": "zstd",
}
GZIP, BZIP2 = b"\x1f\x8b", b"BZh"  # so short that pixels may begin alike: the name decides too
TAR_AT, TAR = 257, b"ustar"


def refuse_archive(path: Path) -> None:
    """Refuse an archive in place of a recording: nothing is unpacked, so that none can fill the
    disk or write outside of its folder. NPZ files are arrays.

    Raises:
        InputError: If the path is one.
    """
    if not path.is_file() or path.suffix.lower() == ".npz":
        return
    try:
        with path.open("rb") as file:
            head = file.read(TAR_AT + len(TAR))
    except OSError as error:
        raise unreadable(path, error.strerror or str(error)) from error
    archive = next((name for magic, name in ARCHIVES.items() if head.startswith(magic)), None)
    if head[TAR_AT:] == TAR:
        archive = "tar"
    if head.startswith((GZIP, BZIP2)) and path.suffix.lower() in (".gz", ".tgz", ".bz2", ".tbz2"):
        archive = "gzip" if head.startswith(GZIP) else "bzip2"
    if archive is not None:
        why = f"expected the recording itself, found a {archive} archive: nothing is unpacked here"
        fix = "unpack it into a folder of its own and give that, or the file in it"
        raise InputError("an archive", where=path, why=why, fix=fix)


def check_unpacked(claimed: int, packed: int) -> None:
    """Check how many bytes a compressed file of ``packed`` bytes claims to hold.

    Raises:
        ValueError: If no file of that size can.
    """
    most = max(UNPACKED_LEAST, PACKED_MAX * packed)
    if claimed > most:
        raise ValueError(f"{claimed} bytes claimed by a file of {packed}")


def check_links(root: Path) -> None:
    """Check the links in a folder and in those below it: what lies outside is no part of it.

    Raises:
        InputError: If one leads out of the folder, or a folder cannot be listed.
    """
    home = os.path.realpath(root)
    for folder in (root, *(path for path in root.iterdir() if path.is_dir())):
        try:
            with os.scandir(folder) as entries:
                links = [entry.path for entry in entries if entry.is_symlink()]
        except OSError as error:
            raise unreadable(folder, error.strerror or str(error)) from error
        for link in links:
            target = os.path.realpath(link)
            if os.path.commonpath([home, target]) != home:
                why = f"expected files in this folder, found a link to {target}"
                fix = "copy what it leads to in its place, or remove it"
                raise InputError("a link out of the folder", where=link, why=why, fix=fix)


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The content of a file of at most so many bytes.

    Raises:
        InputError: If it is no file, too large, or cannot be read.
    """
    if not path.is_file():  # opening a pipe would block
        kind = "a folder" if path.is_dir() else "a pipe or a device" if path.exists() else "none"
        raise unreadable(path, f"expected a file, found {kind}")
    try:
        size = path.stat().st_size
        if most is not None and size > most:
            raise unreadable(path, f"expected at most {most} bytes, found {size}")
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error.strerror or str(error)) from error


def read_text(path: Path, most: int = TEXT_MAX) -> str:
    """The text of a file of at most so many bytes, UTF-8 or plain ASCII.

    Raises:
        InputError: As :func:`read_bytes`, or if it is no text.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(path, f"expected text, found {error}") from error


def unreadable(path: Path, why: str) -> InputError:
    """The error for a file that is not what its name says."""
    return InputError("unreadable", where=path, why=why, fix="copy or export the file again")
